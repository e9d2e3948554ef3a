"""The random driver: uniform actions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.base import ACTION, MASK
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE, SPEED, EnvConfig


class RandomDriver(TensorDictModuleBase):
    """Every CV draws its acceleration, or its desired speeds, uniformly, anew in each step.

    It draws from torch's default generator, which evaluation seeds for each episode.

    Args:
        config: settings of the environment; ``None``: it takes accelerations.
    """

    def __init__(self, config: EnvConfig | None = None) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION]
        speeds = config is not None and config.action == SPEED
        self.size = 1 if config is None else config.action_size
        self.low, self.high = (MIN_SHARE, 1.0) if speeds else (ACTION_LOW_MPS2, ACTION_HIGH_MPS2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, D]``."""
        uniform = torch.rand((*tensordict.get(MASK).shape, self.size))
        return tensordict.set(ACTION, self.low + (self.high - self.low) * uniform)
