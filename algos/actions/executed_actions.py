"""Accelerations that were actually executed, for learners that replay them.

The simulator's own driver may brake harder than a command asks. All commands above that are then equivalent, which a
critic that sees the commands would have to learn.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.learners import base
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import SPEED_SCALE_MPS


class ExecutedAcceleration:
    """Reads accelerations from the speeds that were observed before and after.

    Args:
        config: settings of the environment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.speed, self.decision_s = observation_names(config).index("speed"), config.decision_s

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Return the mean acceleration over each decision of a batch ``[N, T]``, ``[N, T, A, 1]`` m/s^2.

        It is the command where the next speed is unknown, because the vehicle has left, and in the last decision of an
        episode, which may be shorter than the others.
        """
        before, after = (part.get(base.OBSERVATION)[..., self.speed] for part in (batch, batch.get("next")))
        accel = (after - before) * (SPEED_SCALE_MPS / self.decision_s)
        accel = accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2).unsqueeze(-1)
        after_mask, done = (batch.get(("next", *key)) for key in (base.MASK, base.DONE))
        known = batch.get(base.MASK) & after_mask & ~done.squeeze(-1)
        return torch.where(known.unsqueeze(-1), accel, batch.get(base.ACTION))


class ExecutedActions(base.AlgorithmWrapper):
    """An algorithm that commands accelerations and learns from those that were executed.

    Args:
        learned: the algorithm; see :class:`izoo.algos.learners.base.Algorithm`.
        config: settings of the environment.
    """

    def __init__(self, learned: base.Algorithm, config: EnvConfig) -> None:
        super().__init__(learned)
        self.executed = ExecutedAcceleration(config)

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from the batch with executed accelerations as its actions; the batch itself is not changed."""
        own = batch.copy()
        own.set(base.ACTION, self.executed(batch))
        return self.learned.update(own, progress)
