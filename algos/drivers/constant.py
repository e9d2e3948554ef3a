"""Drivers that aim for one speed, one acceleration, or one share of the speed limit."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.drivers.base import DEFER, ScriptedDriver
from izoo.algos.drivers.observed import Observed
from izoo.algos.learners.base import ACTION, MASK
from izoo.algos.learners.registry import CAP
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, GLIDE, MIN_SHARE, SPEED, STOP, EnvConfig
from izoo.errors import IzooError, check_range


class ConstantSpeed(ScriptedDriver):
    """Every CV aims for one speed, wherever it is; the simulator's safety checks hold it back.

    Args:
        config: settings of the environment.
        speed_mps: the speed.
    """

    def __init__(self, config: EnvConfig, speed_mps: float = 10.0) -> None:
        super().__init__()
        check_range("speed_mps", speed_mps, 0.0, 60.0, "m/s")
        self.speed_mps, self.decision_s = speed_mps, config.decision_s
        self.seen = Observed(config)

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        return (self.speed_mps - self.seen(observation, "speed")) / self.decision_s, torch.zeros_like(mask)


class ConstantAcceleration(ScriptedDriver):
    """Every CV asks for one acceleration all the time; its speed limit and the simulator's safety checks hold it back.

    What a policy that has learned nothing does: no benchmark should mistake it for a result.

    Args:
        accel_mps2: the acceleration.
    """

    def __init__(self, accel_mps2: float = 2.0) -> None:
        super().__init__()
        check_range("accel_mps2", accel_mps2, ACTION_LOW_MPS2, ACTION_HIGH_MPS2, "m/s^2")
        self.accel_mps2 = accel_mps2

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full(mask.shape, self.accel_mps2), torch.zeros_like(mask)


class CappedSpeed(ScriptedDriver):
    """No CV exceeds a share of the speed limit, before and behind the stop line; below it, all are left alone.

    The bar for every policy that slows vehicles: it saves CO2 without looking at signals or queues, and costs time.

    Args:
        config: settings of the environment; the feature ``speed_limit_mps`` must be observed.
        share: of the limit, above 0 and up to 1. Where the environment takes desired speeds, they are this, and each
            vehicle's own car-following keeps to it; accelerations do so nearly.
    """

    brake_mps2 = 1.5
    near_mps = 1.3
    """Below the cap by more than this, a CV accelerates as its own driver does."""

    def __init__(self, config: EnvConfig, share: float) -> None:
        super().__init__()
        self.share, self.speeds = share, config.action == SPEED
        self.parts = [1.0 if part in (STOP, GLIDE) else share for part in config.action_parts]
        if self.speeds:
            if share < MIN_SHARE:
                raise IzooError(
                    f"{CAP}{share:g} is below the least desired speed of env.action=speed; give {MIN_SHARE:g} or more."
                )
            if share not in self.parts:
                raise IzooError(
                    f"{CAP}{share:g} caps a speed, and env.action_parts={list(config.action_parts)} has none; "
                    "add speed_before."
                )
            return
        self.seen = Observed(config, ("context_speed_limit_mps",), "a speed cap")
        self.response_s = max(1.0, config.decision_s)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action keys."""
        if not self.speeds:
            return super().forward(tensordict)
        mask = tensordict.get(MASK)
        tensordict.set(ACTION, torch.tensor(self.parts, device=mask.device).expand(*mask.shape, -1).clone())
        return tensordict.set(DEFER, torch.zeros_like(mask))

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = self.seen.columns["context_speed_limit_mps"]
        above = self.seen(observation, "speed") - self.share * observation[..., place] * scale
        free = (above < -self.near_mps) | torch.full_like(mask, self.share >= 1.0)
        return (-above / self.response_s).clamp_min(-self.brake_mps2), free
