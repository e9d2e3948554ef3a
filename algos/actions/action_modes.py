"""Action modes, what the action of a learned policy means: ``action=direct``, ``speed``, ``arrive`` and others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from izoo.envs.config import (
    ACTION_HIGH_MPS2,
    ACTION_LOW_MPS2,
    BEFORE_AND_BEHIND,
    BY_STEP,
    MIN_SHARE,
    SPEED,
    STOP,
    EnvConfig,
)
from izoo.errors import check_range
from izoo.options import CheckedOptions

if TYPE_CHECKING:
    from izoo.algos.actions.action_wrappers import ActionTransform

SPREADS = (0.02, 10.0)
"""Least and most standard deviation of an untrained normal policy. Networks keep theirs above 0.01
(:func:`izoo.algos.networks.gaussian.normal_parameters`), and the band of the point mass follows from it."""


@dataclass(frozen=True)
class PointMass(CheckedOptions):
    """Zero action is a no-op; this is the initial probability of acting.

    Attributes:
        act_share: share of the decisions in which an untrained policy acts, to each side that differs from 0.
        spread: standard deviation of an untrained normal policy before censoring and tanh.
        two_sided: whether there are agents whose actions below 0 differ from 0; which, the policy is told with each
            observation. For all others actions below 0 are no-ops, too.
    """

    act_share: float = 0.08
    spread: float = 0.35
    two_sided: bool = False
    group = "action"
    ranges = (("act_share", 1e-6, 0.5), ("spread", *SPREADS))

    @property
    def half_band(self) -> float:
        """Half the width of the band of an untrained normal policy, whose median is 0."""
        return self.band(self.spread)

    def band(self, spread: float) -> float:
        """Return the value that normal noise of this ``spread`` exceeds with probability ``act_share``."""
        return spread * NormalDist().inv_cdf(1.0 - self.act_share)


@dataclass(frozen=True)
class ActionSpace:
    """What the actions of an algorithm may be.

    Attributes:
        low, high: bounds: of an acceleration in m/s^2, a share of the speed limit, or a raw action.
        point_mass: at the action 0, which leaves a vehicle alone; ``None``: there is none.
        size: numbers of an action.
    """

    low: float
    high: float
    point_mass: PointMass | None = None
    size: int = 1

    @property
    def middle(self) -> float:
        """The middle of the range."""
        return (self.high + self.low) / 2

    @property
    def half_width(self) -> float:
        """Half the width of the range."""
        return (self.high - self.low) / 2


class ActionMode(CheckedOptions):
    """What the action of a policy means, and what that asks of other options.

    Attributes:
        sets: settings of the environment that go with it.
        every_step: whether its policy has to decide in every step.
        initial, spread: of the untrained policy; in place of ``algo.initial_accel_mps2`` and ``algo.initial_spread``
            where the mode has both.
    """

    group = "action"
    sets: ClassVar[Mapping[str, Any]] = {}
    every_step: ClassVar[bool] = False

    @property
    def commands(self) -> Mapping[str, Any]:
        """What the environment must take as actions."""
        return {}

    def space(self, env: EnvConfig) -> ActionSpace:
        """Return what the learned policy's actions may be."""
        raise NotImplementedError

    def transform(self, env: EnvConfig) -> ActionTransform | None:
        """Return what turns them into commands; ``None``: they are commands."""
        return None


@dataclass(frozen=True)
class DirectAction(ActionMode):
    """The policy's action is the acceleration.

    Attributes:
        name: the action mode.
        low_mps2, high_mps2: range of the policy's action, in m/s^2. The environment clips it to -4.5 and 2.6, so in a
            wider range, such as the paper's, a policy that explores brakes and accelerates fully more often.
    """

    name: Literal["direct"] = "direct"
    low_mps2: float = ACTION_LOW_MPS2
    high_mps2: float = ACTION_HIGH_MPS2
    sets = BY_STEP
    ranges = (("low_mps2", -100.0, -0.01, "m/s^2"), ("high_mps2", 0.01, 100.0, "m/s^2"))

    def space(self, env: EnvConfig) -> ActionSpace:
        return ActionSpace(self.low_mps2, self.high_mps2)


@dataclass(frozen=True)
class SpeedAction(ActionMode):
    """The policy's action is a desired speed, as a share of the limit, which the vehicle's own car-following keeps to.

    It may be one number or one each before and behind the stop line; further numbers, or these alone, say how gently
    to stop and how slowly to glide (``env.action_parts``). It takes the place of ``algo.initial_accel_mps2`` and
    ``algo.initial_spread``.

    Attributes:
        name: the action mode.
        slowest: the least share that can be chosen.
        initial: the untrained policy's median.
        spread: standard deviation of an untrained normal policy before the tanh.
    """

    name: Literal["speed"] = "speed"
    slowest: float = 0.2
    initial: float = 0.85
    spread: float = 0.6
    ranges = (("slowest", MIN_SHARE, 0.9), ("spread", *SPREADS))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("action.initial", self.initial, self.slowest + 0.01, 0.99)

    @property
    def commands(self) -> Mapping[str, Any]:
        """What the environment must take as actions."""
        return {"action": SPEED}

    def space(self, env: EnvConfig) -> ActionSpace:
        return ActionSpace(self.slowest, 1.0, size=env.action_size)


@dataclass(frozen=True)
class ArriveAction(ActionMode):
    """The policy's action: how late in a green a vehicle should arrive, and how slowly it should drive behind the line.

    Both become desired speeds (``env.action=speed env.action_parts=[speed_before,speed_behind]``); a third number may
    say how gently to stop. It takes the place of ``algo.initial_accel_mps2`` and ``algo.initial_spread``.

    Attributes:
        name: the action mode.
        slowest: no desired speed is a smaller share of the limit.
        stop: whether a third number says how gently to stop (the part ``stop`` of ``env.action_parts``).
        initial: the untrained policy's median of all numbers; 0 is early, at the limit and left alone, 1 late, slow and
            gentle.
        spread: standard deviation of an untrained normal policy before the tanh.
    """

    name: Literal["arrive"] = "arrive"
    slowest: float = 0.2
    stop: bool = False
    initial: float = 0.25
    spread: float = 0.6
    ranges = (("slowest", MIN_SHARE, 0.9), ("initial", 0.01, 0.99), ("spread", *SPREADS))

    @property
    def commands(self) -> Mapping[str, Any]:
        """What the environment must take as actions."""
        return {"action": SPEED, "action_parts": (*BEFORE_AND_BEHIND, STOP) if self.stop else BEFORE_AND_BEHIND}

    def space(self, env: EnvConfig) -> ActionSpace:
        return ActionSpace(0.0, 1.0, size=env.action_size)

    def transform(self, env: EnvConfig) -> ActionTransform:
        from izoo.algos.actions.arrival import Arrival

        return Arrival(env, self.slowest)


@dataclass(frozen=True)
class AdviseAction(ActionMode):
    """The policy's action is speed advice to the simulator's own driver: above 0 a lower speed limit, else none.

    Apart from its exploration, an untrained policy is therefore the uncommanded CV. Advice acts before the stop line.

    Attributes:
        name: the action mode.
        depth: the speed is capped at no less than 1 minus this, in units of the limit.
        brake_mps2: bound on the braking.
        act_share: share of decisions in which an untrained policy that explores acts.
        spread: standard deviation of an untrained policy before censoring and tanh: how strong such actions are.
    """

    name: Literal["advise"] = "advise"
    sets = BY_STEP
    every_step = True
    depth: float = 0.8
    brake_mps2: float = 1.5
    act_share: float = 0.06
    spread: float = 0.35
    ranges = (("depth", 0.01, 1.0), ("brake_mps2", 0.1, -ACTION_LOW_MPS2, "m/s^2"), *PointMass.ranges)

    def space(self, env: EnvConfig) -> ActionSpace:
        return ActionSpace(-self.depth, self.depth, PointMass(self.act_share, self.spread))

    def transform(self, env: EnvConfig) -> ActionTransform:
        from izoo.algos.actions.action_wrappers import SpeedCap

        return SpeedCap(env, self.brake_mps2)


@dataclass(frozen=True)
class ResidualAction(ActionMode):
    """The policy's action is subtracted from the acceleration of the nominal controller, glide.

    A CV that glide leaves alone stays with the simulator's driver unless its action is above 0.

    Attributes:
        name: the action mode.
        half_width_mps2: the action lies between plus and minus this. 1 m/s^2 is as much as glide itself commands, so
            that glide can be overruled where it brakes for nothing, and no more.
        act_share: share of decisions in which an untrained policy that explores holds a CV back (and, where glide
            commands, as often lets it go).
        spread: standard deviation of an untrained policy before censoring and tanh: how strong such actions are.
    """

    name: Literal["residual"] = "residual"
    sets = BY_STEP
    every_step = True
    half_width_mps2: float = 1.0
    act_share: float = 0.08
    spread: float = 0.35
    ranges = (("half_width_mps2", 0.01, ACTION_HIGH_MPS2 - ACTION_LOW_MPS2, "m/s^2"), *PointMass.ranges)

    def space(self, env: EnvConfig) -> ActionSpace:
        still = PointMass(self.act_share, self.spread, two_sided=True)
        return ActionSpace(-self.half_width_mps2, self.half_width_mps2, still)

    def transform(self, env: EnvConfig) -> ActionTransform:
        from izoo.algos.actions.residual import Correction, NominalDriver

        return Correction(NominalDriver(env))


ActionConfig = DirectAction | SpeedAction | ArriveAction | AdviseAction | ResidualAction
