"""One environment's traffic as an object: what holds the arrays that compiled code reaches by their addresses."""

from __future__ import annotations

from typing import Any

from izoo.envs.tables import directory
from izoo.envs.twin.driving.step import new_state, step
from izoo.envs.twin.runtime.layout import NET, STATE, TRAFFIC, WORKING, TwinNet, TwinState, TwinTraffic
from izoo.envs.twin.runtime.prefetch import no_ranges
from izoo.envs.twin.runtime.scratch import Desk, zeros


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
        self.net, self.traffic, self.step_ms = net, traffic, step_ms
        self.state: TwinState = new_state(net, traffic, desk)
        self._find()

    def _find(self) -> None:
        """Note where the arrays are."""
        pairs = ((self.net, NET), (self.traffic, TRAFFIC), (self.state, STATE))
        self._directories = [directory(tables, kind) for tables, kind in pairs]
        self.addresses = [words.ctypes.data for words in self._directories]

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs: working memory and addresses are of one alone."""
        lasting = {name: array for name, array in self.state._asdict().items() if name not in WORKING}
        # In the order of memory, which prefetching relies on.
        lasting = dict(sorted(lasting.items(), key=lambda one: one[1].ctypes.data))
        working = {name: getattr(self.state, name).shape for name in WORKING}
        return {"net": self.net, "traffic": self.traffic, "step_ms": self.step_ms, "state": (lasting, working)}

    def __setstate__(self, given: dict[str, Any]) -> None:
        self.net, self.traffic, self.step_ms = given["net"], given["traffic"], given["step_ms"]
        lasting, working = given["state"]
        own = zeros(STATE, {name: array.shape for name, array in lasting.items()})
        for name, array in lasting.items():
            own[name][...] = array
        self.state = TwinState(**own, **Desk().spread(STATE, working))
        self._find()

    def move_to(self, desk: Desk) -> None:
        """Use the working memory of another thread from now on."""
        shapes = {name: getattr(self.state, name).shape for name in WORKING}
        self.state = self.state._replace(**desk.spread(STATE, shapes))
        self._directories[-1][:] = directory(self.state, STATE)

    def step(self) -> None:
        """Advance by one step."""
        step(*self.addresses, self.step_ms, no_ranges())
