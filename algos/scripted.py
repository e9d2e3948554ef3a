"""Scripted drivers: policies without parameters, usable wherever a learned policy is."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos import base

DEFER = ("agents", "defer")


class RandomDriver(TensorDictModuleBase):
    """Every CV draws its acceleration uniformly, anew in each step.

    Args:
        low, high: bounds of the acceleration, m/s^2.
        seed: of the draws.
    """

    def __init__(self, low: float, high: float, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [base.MASK], [base.ACTION]
        self.low, self.high = low, high
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write accelerations ``[*B, A, 1]``."""
        shape = (*tensordict.get(base.MASK).shape, 1)
        uniform = torch.rand(shape, generator=self._generator)
        return tensordict.set(base.ACTION, self.low + (self.high - self.low) * uniform)


class UncommandedDriver(TensorDictModuleBase):
    """Every CV is left to the simulator's car-following model: what the CVs' vehicle parameters do by themselves."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [base.MASK], [base.ACTION, DEFER]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write accelerations of 0, ``[*B, A, 1]``, and ``defer``, all true, ``[*B, A]``."""
        mask = tensordict.get(base.MASK)
        tensordict.set(base.ACTION, torch.zeros(*mask.shape, 1))
        return tensordict.set(DEFER, torch.ones_like(mask))
