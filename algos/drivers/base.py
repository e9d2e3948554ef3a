"""What scripted drivers have in common: policies without learning, usable wherever a policy is.

Each reads ``("agents", "mask")`` ``[*B, A]``, and some ``("agents", "observation")`` ``[*B, A, F]``; all write
``("agents", "action")`` ``[*B, A, 1]`` in m/s^2 and most ``("agents", "defer")`` ``[*B, A]``, where true leaves a CV to
the simulator's own driver for the step. Where the environment takes desired speeds, drivers that choose speeds write
these, ``[*B, A, D]``.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from izoo.algos.learners.base import ACTION, MASK, OBSERVATION
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2

DEFER = ("agents", "defer")


class ScriptedDriver(TensorDictModuleBase):
    """A rule that turns observations into accelerations; subclasses say which in :meth:`drive`."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys = [OBSERVATION, MASK]
        self.out_keys = [ACTION, DEFER]

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``(acceleration [*B, A] in m/s^2, defer [*B, A] bool)``; empty slots may hold anything."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action keys; empty slots get acceleration 0."""
        mask = tensordict.get(MASK)
        accel, defer = self.drive(tensordict.get(OBSERVATION), mask)
        accel = torch.where(mask, accel, torch.zeros_like(accel)).clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2)
        tensordict.set(ACTION, accel.unsqueeze(-1))
        tensordict.set(DEFER, defer)
        return tensordict
