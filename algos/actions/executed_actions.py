"""What came of commands: the accelerations that vehicles had, for learners that replay them.

The simulator's own driver may brake harder than a command asks. All commands above what it does are then the same, and
a critic that is told what was asked for has to find that out.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.learners import base
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import SPEED_SCALE_MPS


class AppliedAcceleration:
    """Reads accelerations from the speeds that were observed before and after.

    Args:
        config: settings of the environment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.speed, self.decision_s = observation_names(config).index("speed"), config.decision_s

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Return the mean acceleration over each decision of a batch ``[N, T]``, ``[N, T, A, 1]`` m/s^2.

        Of a vehicle that has left, whose speed is not known, it is the command, and so it is in the last decision of an
        episode, which may be shorter than the others.
        """
        before, after = (part.get(base.OBSERVATION)[..., self.speed] for part in (batch, batch.get("next")))
        accel = (after - before) * (SPEED_SCALE_MPS / self.decision_s)
        accel = accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2).unsqueeze(-1)
        after_mask, done = (batch.get(("next", *key)) for key in (base.MASK, base.DONE))
        known = batch.get(base.MASK) & after_mask & ~done.squeeze(-1)
        return torch.where(known.unsqueeze(-1), accel, batch.get(base.ACTION))


class AsApplied:
    """An algorithm that commands accelerations, and learns from those that came of it; the rest is the algorithm's own.

    Args:
        learned: the algorithm; see :class:`izoo.algos.learners.base.Algorithm`.
        config: settings of the environment.
    """

    def __init__(self, learned: base.Algorithm, config: EnvConfig) -> None:
        self.learned, self.policy, self.applied = learned, learned.policy, AppliedAcceleration(config)

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Hand the batch on with what was applied in the place of the action; the batch itself stays as it is."""
        own = batch.copy()
        own.set(base.ACTION, self.applied(batch))
        return self.learned.update(own, progress)

    def state_dict(self) -> dict[str, Any]:
        """Return the algorithm's state."""
        return self.learned.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.learned.load_state_dict(state)
