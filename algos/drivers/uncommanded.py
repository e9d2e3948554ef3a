"""The uncommanded driver: every CV is left to the simulator."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.drivers.base import DEFER
from izoo.algos.learners.base import ACTION, MASK
from izoo.envs.config import KEEP_LANE, SPEED, EnvConfig

LANE_CHANGE = ("agents", "lane_change")


class UncommandedDriver(TensorDictModuleBase):
    """Every CV is left to the simulator's car-following model: what the CVs' vehicle parameters do by themselves.

    With adoption 0 there are no CVs, and this is human driving.

    Args:
        config: settings of the environment; ``None``: it takes accelerations. Lane changes, where it takes them, are
            all "keep", and left to the simulator, too.
    """

    def __init__(self, config: EnvConfig | None = None) -> None:
        super().__init__()
        lane_change = config is not None and config.lane_change
        self.in_keys, self.out_keys = [MASK], [ACTION, DEFER, *([LANE_CHANGE] if lane_change else [])]
        self.size = 1 if config is None else config.action_size
        self.idle = 1.0 if config is not None and config.action == SPEED else 0.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write accelerations of 0, or desired speeds of 1, ``[*B, A, D]``, and ``defer``, all true, ``[*B, A]``."""
        mask = tensordict.get(MASK)
        tensordict.set(ACTION, torch.full((*mask.shape, self.size), self.idle))
        if LANE_CHANGE in self.out_keys:
            tensordict.set(LANE_CHANGE, torch.full_like(mask, KEEP_LANE, dtype=torch.int64))
        return tensordict.set(DEFER, torch.ones_like(mask))
