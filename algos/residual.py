"""Residual actions for any algorithm: ``acceleration = clip(nominal(observation) + learned residual)``.

The nominal controller is glide (:mod:`izoo.algos.scripted`), so learning starts from it and corrects it (residual
policy learning for eco-driving: arXiv 2403.04232). To the algorithm, the residual *is* the action: it is what its
networks emit, what it computes log-probabilities of, and what its losses see. The environment sees the sum.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from izoo.algos import base
from izoo.algos.scripted import DEFER, Glide
from izoo.contexts.features import feature
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M, SPEED_SCALE_MPS

RESIDUAL = ("agents", "residual")


class NominalDriver(nn.Module):
    """Glide where it commands; where it leaves a CV alone, what the car-following model would do.

    A residual that brakes needs something to be subtracted from, so the simulator's intelligent driver model
    (Treiber et al., Phys. Rev. E 62, 1805) is estimated from the observation, with ``cv_vehicle=paper``'s parameters.
    The simulator never lets a command exceed its own safe speed, so the estimate matters where it is the lower of the
    two.

    Args:
        config: settings of the environment; what glide needs must be observed.
    """

    accel_mps2, decel_mps2, headway_s, min_gap_m = 2.6, 4.5, 1.0, 2.0

    def __init__(self, config: EnvConfig) -> None:
        super().__init__()
        self.glide = Glide(config)
        self.columns = {name: column for column, name in enumerate(observation_names(config))}

    def forward(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return accelerations in m/s^2, and which are estimates of the simulator's own, both ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            mask: ``[*B, A]``; what empty slots get does not matter.
        """
        advised, idle = self.glide.drive(observation, mask)
        return torch.where(idle, self.follow(observation), advised), idle

    def follow(self, observation: Tensor) -> Tensor:
        """Return the car-following model's acceleration, ``[*B, A]``, behind the leader or a red light ahead."""
        speed = self._column(observation, "speed", SPEED_SCALE_MPS)
        limit = self._column(observation, "context_speed_limit_mps", feature("speed_limit_mps").scale).clamp_min(1.0)
        leader = self._flag(observation, "leader_present")
        gap = self._column(observation, "leader_distance", DISTANCE_SCALE_M)
        closing = speed - self._column(observation, "leader_speed", SPEED_SCALE_MPS)
        behind = torch.where(leader, self._interaction(speed, closing, gap, self.min_gap_m), 0.0)
        distance = -self._column(observation, "stop_line_distance", DISTANCE_SCALE_M)
        # Near the line the simulator alone decides, since only it knows of turns on red.
        held = self._flag(observation, "signal_red") & self._flag(observation, "location_approaching")
        held &= distance > self.glide.settings.near_m
        stopping = torch.where(held, self._interaction(speed, speed, distance, 0.0), 0.0)
        free = 1.0 - (speed / limit) ** 4
        accel = self.accel_mps2 * (free - torch.maximum(behind, stopping))
        return accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2)

    def _interaction(self, speed: Tensor, closing: Tensor, gap: Tensor, min_gap_m: float) -> Tensor:
        dynamic = speed * self.headway_s + speed * closing / (2.0 * (self.accel_mps2 * self.decel_mps2) ** 0.5)
        return ((min_gap_m + dynamic.clamp_min(0.0)) / gap.clamp_min(0.1)) ** 2

    def _column(self, observation: Tensor, name: str, scale: float) -> Tensor:
        return observation[..., self.columns[name]] * scale

    def _flag(self, observation: Tensor, name: str) -> Tensor:
        return observation[..., self.columns[name]] > 0.5


class ResidualPolicy(TensorDictModuleBase):
    """A learned policy's action becomes ``("agents", "residual")``; the sum with the nominal one becomes the action.

    A CV that the nominal controller leaves alone stays with the simulator's driver, ``("agents", "defer")``, unless its
    residual brakes. So a policy of residuals near 0 is the nominal controller, and no estimate of it.

    Args:
        learned: writes ``("agents", "action")`` ``[*B, A, 1]``, in m/s^2, which may be negative.
        nominal: the controller that it corrects.
        threshold_mps2: residuals above minus this do not count as braking.
    """

    def __init__(self, learned: TensorDictModuleBase, nominal: NominalDriver, threshold_mps2: float) -> None:
        super().__init__()
        self.learned, self.nominal, self.threshold_mps2 = learned, nominal, threshold_mps2
        self.in_keys = list(dict.fromkeys([*learned.in_keys, base.OBSERVATION, base.MASK]))
        self.out_keys = [*learned.out_keys, RESIDUAL, DEFER]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write residual and acceleration, ``[*B, A, 1]`` each, ``defer``, and what else the learned policy writes."""
        residual = self.learned(tensordict).get(base.ACTION)
        nominal, idle = self.nominal(tensordict.get(base.OBSERVATION), tensordict.get(base.MASK))
        tensordict.set(RESIDUAL, residual)
        tensordict.set(DEFER, idle & (residual.squeeze(-1) > -self.threshold_mps2))
        return tensordict.set(base.ACTION, (nominal.unsqueeze(-1) + residual).clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2))


class Residual:
    """An algorithm whose actions are residuals; see :class:`izoo.algos.base.Algorithm`.

    Args:
        learned: the algorithm, built for residuals.
        nominal: the controller that its policy corrects.
        threshold_mps2: see :class:`ResidualPolicy`.
    """

    def __init__(self, learned: base.Algorithm, nominal: NominalDriver, threshold_mps2: float) -> None:
        self.learned = learned
        self.policy = ResidualPolicy(learned.policy, nominal, threshold_mps2)

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Hand the batch on with the residual in the place of the action; the batch itself stays as it is."""
        own = batch.copy()
        own.set(base.ACTION, batch.get(RESIDUAL))
        stats = self.learned.update(own, progress)
        mask = batch.get(base.MASK)
        if mask.any():
            stats["residual_abs"] = float(batch.get(RESIDUAL)[mask].abs().mean())
        return stats

    def state_dict(self) -> dict[str, Any]:
        """Return the learned algorithm's state: the nominal controller has none."""
        return self.learned.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.learned.load_state_dict(state)
