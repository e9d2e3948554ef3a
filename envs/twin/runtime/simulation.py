"""One environment's traffic as an object: what holds the arrays that compiled code reaches by their addresses."""

from __future__ import annotations

from typing import Any

import numpy as np

from izoo.envs.tables import directory
from izoo.envs.twin.driving.step import new_state, state_shapes, step
from izoo.envs.twin.runtime.layout import NET, STATE, TRAFFIC, WORKING, TwinNet, TwinState, TwinTraffic
from izoo.envs.twin.runtime.prefetch import no_ranges
from izoo.envs.twin.runtime.scratch import Desk, memory_of, zeros

_ABSENT = np.empty(0)


class TwinEpisode:
    """An episode on the twin, from its first second.

    Attributes:
        net, traffic, state: the arrays; values may be changed, arrays never replaced.
        addresses: where compiled code finds them (:mod:`izoo.envs.tables`), in this order.

    Args:
        step_ms: length of a step, 50 to 1000.
        desk: working memory of the thread that steps it; by default its own.
    """

    def __init__(self, net: TwinNet, traffic: TwinTraffic, step_ms: int = 500, desk: Desk | None = None) -> None:
        self._begin(net, traffic, step_ms)
        self.state: TwinState = new_state(net, traffic, desk or Desk())
        self._find()

    def _begin(self, net: TwinNet, traffic: TwinTraffic, step_ms: int) -> None:
        self.net, self.traffic, self.step_ms = net, traffic, step_ms
        self._constant = [directory(net, NET), directory(traffic, TRAFFIC)]

    def _find(self) -> None:
        """Note where the arrays are."""
        self._changing = directory(self.state, STATE)
        self.addresses = [words.ctypes.data for words in (*self._constant, self._changing)]

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs: working memory and addresses are of one alone."""
        return {"of": (self.net, self.traffic, self.step_ms), "state": memory_of(self.state.clock)}

    def __setstate__(self, given: dict[str, Any]) -> None:
        """Take what :meth:`__getstate__` returned; :meth:`move_to` must follow."""
        self._begin(*given["of"])
        arrays = zeros(STATE, state_shapes(self.net, self.traffic)[0])
        memory_of(arrays["clock"])[:] = given["state"]
        self.state = TwinState(**arrays, **dict.fromkeys(WORKING, _ABSENT))

    def move_to(self, desk: Desk) -> None:
        """Use the working memory of another thread from now on."""
        self.state = self.state._replace(**desk.spread(STATE, state_shapes(self.net, self.traffic)[1]))
        self._find()

    def step(self) -> None:
        """Advance by one step."""
        step(*self.addresses, self.step_ms, no_ranges())
