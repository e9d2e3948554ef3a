"""Many intersections on the twin as one TorchRL environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from tensordict import TensorDictBase

from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig, checked_config
from izoo.envs.env import Contexts, EcoDrivingBase
from izoo.envs.mdp.scene import Scene
from izoo.envs.picture import draw
from izoo.envs.sumo.worker import usable_cores
from izoo.envs.twin.twin_backend import TwinBackend


class TwinEnv(EcoDrivingBase):
    """``N`` intersections on the twin, all in this process; batch size ``[N]``, and else what ``SumoParallelEnv`` is.

    A context and a seed give the same trajectory whatever the number of environments and threads, and whatever was
    played before. While episodes run, another thread prepares those that come next.

    Args:
        num_envs: ``N``.
        contexts, config, seed: as for :class:`~izoo.envs.EcoDrivingEnv`; the ``N`` environments share the schedule.
        threads: how many threads share the environments out among them; by default one per core that is usable.
        surrogate: what computes CO2: ``torch``, the module :class:`~izoo.emissions.moves.MovesSurrogate` in one call
            for all vehicles, or ``compiled``, the same function without torch.
    """

    backend: TwinBackend

    def __init__(
        self,
        num_envs: int = 64,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig | None = None,
        seed: int = 0,
        threads: int | None = None,
        surrogate: str = "torch",
    ) -> None:
        config = checked_config(config)
        backend = TwinBackend(config, num_envs, usable_cores() if threads is None else threads, surrogate)
        super().__init__(contexts, config, seed, [num_envs], backend.frames, backend, 0, num_envs)
        self.num_envs = num_envs

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        frame = super()._reset(tensordict, **options)
        for index in range(self.num_envs):
            self._look_ahead(index)
        return frame

    def _look_ahead(self, index: int) -> None:
        """Let the next episode of an environment be prepared."""
        number, schedule = int(self._next_episode[index]), self.schedule
        self.backend.expect(index, number, lambda: Play(*schedule(number), number))

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment, whether or not it is emitted.

        Raises:
            IzooError: no episode has begun.
        """
        return self.backend.scene(index)

    def render(self, *_: Any, index: int = 0, span_m: float = 120.0, size_px: int = 640, **__: Any) -> np.ndarray:
        """Return a top view ``[size_px, size_px, 3]`` uint8 of the present state of an environment."""
        self.require_started("render")
        return draw(self.scene(index), span_m=span_m, size_px=size_px)
