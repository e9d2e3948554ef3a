"""The random driver: uniform actions."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.base import ACTION, MASK
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE, SPEED, EnvConfig


class RandomDriver(TensorDictModuleBase):
    """Every CV draws its acceleration, or its desired speeds, uniformly, anew in each step.

    Args:
        config: settings of the environment; ``None``: it takes accelerations.
        low, high: bounds of the acceleration, m/s^2.
        seed: of the draws; ``None`` takes torch's default generator, which evaluation seeds for each episode. A copy,
            such as one that is sent to another process, begins to draw anew.
    """

    def __init__(
        self,
        low: float = ACTION_LOW_MPS2,
        high: float = ACTION_HIGH_MPS2,
        seed: int | None = 0,
        config: EnvConfig | None = None,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION]
        self.size = 1 if config is None else config.action_size
        self.low, self.high = (MIN_SHARE, 1.0) if config is not None and config.action == SPEED else (low, high)
        self._seed = seed
        self._generator: torch.Generator | None = None  # made at the first draw: PyTorch cannot send it to a process

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, D]``."""
        shape = (*tensordict.get(MASK).shape, self.size)
        if self._generator is None and self._seed is not None:
            self._generator = torch.Generator().manual_seed(self._seed)
        uniform = torch.rand(shape, generator=self._generator)
        return tensordict.set(ACTION, self.low + (self.high - self.low) * uniform)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of."""
        return {**self.__dict__, "_generator": None}
