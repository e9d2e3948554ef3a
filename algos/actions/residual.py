"""The action mode ``action=residual``: ``acceleration = clip(nominal(observation) - raw action)``.

The nominal controller is glide (:mod:`izoo.algos.drivers.glide`), so learning starts from it and corrects it (residual
policy learning for eco-driving: arXiv 2403.04232).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from izoo.algos.actions.action_wrappers import ActionTransform
from izoo.algos.drivers.glide import Glide
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig


class NominalDriver(nn.Module):
    """Glide where it commands; elsewhere an estimate of what the car-following model would do.

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

    def forward(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return accelerations in m/s^2, and which of them are such estimates, both ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            mask: ``[*B, A]``; results in empty slots do not matter.
        """
        advised, idle = self.glide.drive(observation, mask)
        return torch.where(idle, self.follow(observation), advised), idle

    def follow(self, observation: Tensor) -> Tensor:
        """Return the car-following model's acceleration, ``[*B, A]``, behind the leader or a red light ahead."""
        seen = self.glide.seen
        speed, limit = seen(observation, "speed"), seen(observation, "context_speed_limit_mps").clamp_min(1.0)
        closing = speed - seen(observation, "leader_speed")
        following = self._interaction(speed, closing, seen(observation, "leader_distance"), self.min_gap_m)
        behind = torch.where(seen.flag(observation, "leader_present"), following, 0.0)
        distance = -seen(observation, "stop_line_distance")
        # Near the line the simulator alone decides, since only it knows of turns on red.
        held = seen.flag(observation, "signal_red") & seen.flag(observation, "location_approaching")
        held &= distance > self.glide.settings.near_m
        stopping = torch.where(held, self._interaction(speed, speed, distance, 0.0), 0.0)
        free = 1.0 - (speed / limit) ** 4
        accel = self.accel_mps2 * (free - torch.maximum(behind, stopping))
        return accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2)

    def _interaction(self, speed: Tensor, closing: Tensor, gap: Tensor, min_gap_m: float) -> Tensor:
        dynamic = speed * self.headway_s + speed * closing / (2.0 * (self.accel_mps2 * self.decel_mps2) ** 0.5)
        return ((min_gap_m + dynamic.clamp_min(0.0)) / gap.clamp_min(0.1)) ** 2


class Correction(ActionTransform):
    """A raw action holds a vehicle back by so many m/s^2 against the nominal controller; below 0 it speeds it up.

    A CV that the nominal controller leaves alone can only be held back: it stays with the simulator's driver unless its
    raw action is above 0. So a raw action of 0 is the nominal controller, not an estimate of it.

    Args:
        nominal: the controller that is corrected.
    """

    two_sided = True

    def __init__(self, nominal: NominalDriver) -> None:
        super().__init__()
        self.nominal = nominal

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        accel, idle = self.nominal(observation, mask)
        return accel, ~idle

    def command(self, seen: tuple[Tensor, ...], raw: Tensor) -> tuple[Tensor, Tensor]:
        accel, guided = seen
        return (accel - raw).clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2), ~guided & (raw <= 0.0)

    def carried_out(self, seen: tuple[Tensor, ...], raw: Tensor, executed: Tensor) -> Tensor:
        """Return how much the vehicle was held back; 0 where it was left to the simulator's driver."""
        accel, guided = seen
        return torch.where(guided | (raw > 0.0), accel - executed, torch.zeros_like(raw))
