"""What the action of a learned policy stands for: ``action=direct``, ``speed``, ``arrive`` and others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, BY_STEP, MIN_SHARE, EnvConfig
from izoo.errors import check_range, check_types

if TYPE_CHECKING:
    from izoo.algos.actions.executed_actions import AppliedAcceleration
    from izoo.algos.learners.base import Algorithm

Build = Callable[..., "Algorithm"]
"""What builds an algorithm from its options, the length of an observation, the bounds of its action and, where an
action of 0 is doing nothing, ``rest=``, a :class:`Rest`, or, where an action is several numbers, ``size=``."""

SPREADS = (0.02, 10.0)
"""Least and most standard deviation of an untrained normal policy. Networks keep theirs above 0.01
(:func:`izoo.algos.networks.gaussian.normal_parameters`), and the band of doing nothing is reckoned from it."""


@dataclass(frozen=True)
class Rest:
    """That an action of 0 is doing nothing, and how often an untrained policy does something else.

    Attributes:
        act_share: share of the decisions in which an untrained policy acts, to either side that means something.
        spread: standard deviation of an untrained normal policy before censoring and tanh.
        two_sided: whether there are agents for whom both signs mean something; which, the policy is told with each
            observation. For all others values below 0 are doing nothing, too.
    """

    act_share: float = 0.08
    spread: float = 0.35
    two_sided: bool = False

    def __post_init__(self) -> None:
        check_types("action", self)
        check_range("action.act_share", self.act_share, 1e-6, 0.5)
        check_range("action.spread", self.spread, *SPREADS)

    @property
    def dead(self) -> float:
        """Half the width of the band of a normal policy that is untrained, and so has median 0."""
        return self.band(self.spread)

    def band(self, spread: float) -> float:
        """Return what normal noise with this ``spread`` exceeds with probability ``act_share``."""
        return spread * NormalDist().inv_cdf(1.0 - self.act_share)


@dataclass(frozen=True)
class DirectAction:
    """The policy's action is the acceleration.

    Attributes:
        name: the action mode.
    """

    name: Literal["direct"] = "direct"
    sets: ClassVar[Mapping[str, Any]] = BY_STEP

    def __post_init__(self) -> None:
        check_types("action", self)

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes."""
        learned = build(config, features, ACTION_LOW_MPS2, ACTION_HIGH_MPS2)
        if not _stores_applied(config):
            return learned
        from izoo.algos.actions.executed_actions import AsApplied

        return AsApplied(learned, env)


@dataclass(frozen=True)
class SpeedAction:
    """The policy's action is a desired speed, as a share of the limit, which the vehicle's own car-following keeps to.

    It may be one number or one each before and behind the stop line (``env.action_parts``). It takes the place of
    ``algo.initial_accel_mps2`` and ``algo.initial_spread``.

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

    def __post_init__(self) -> None:
        check_types("action", self)
        check_range("action.slowest", self.slowest, MIN_SHARE, 0.9)
        check_range("action.initial", self.initial, self.slowest + 0.01, 0.99)
        check_range("action.spread", self.spread, *SPREADS)

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes."""
        begun = _begun(config, self.initial, self.spread)
        return build(begun, features, self.slowest, 1.0, size=env.action_size)


@dataclass(frozen=True)
class ArriveAction:
    """The policy's action says how late in a green the vehicle is to arrive, and how slowly it is to drive behind it.

    That is carried out as two desired speeds (``env.action=speed env.action_parts=[speed_before,speed_behind]``). It
    takes the place of ``algo.initial_accel_mps2`` and ``algo.initial_spread``.

    Attributes:
        name: the action mode.
        slowest: no desired speed is a smaller share of the limit.
        initial: the untrained policy's median of both numbers; 0 is early and at the limit, 1 late and slow.
        spread: standard deviation of an untrained normal policy before the tanh.
    """

    name: Literal["arrive"] = "arrive"
    slowest: float = 0.2
    initial: float = 0.25
    spread: float = 0.6

    def __post_init__(self) -> None:
        check_types("action", self)
        check_range("action.slowest", self.slowest, MIN_SHARE, 0.9)
        check_range("action.initial", self.initial, 0.01, 0.99)
        check_range("action.spread", self.spread, *SPREADS)

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes."""
        from izoo.algos.actions.arrival import Arrival, Arriving

        learned = build(_begun(config, self.initial, self.spread), features, 0.0, 1.0, size=2)
        return Arriving(learned, Arrival(env, self.slowest))


def _begun(config: Any, initial: float, spread: float) -> Any:
    """Return an algorithm's options with the median and the spread of its untrained policy."""
    values = {"initial_accel_mps2": initial, "initial_spread": spread}
    return dataclasses.replace(config, **{name: value for name, value in values.items() if hasattr(config, name)})


@dataclass(frozen=True)
class AdviseAction:
    """The policy's action is advice to the simulator's own driver: at or below 0 none, above it a lower speed limit.

    So an untrained policy is, but for its exploration, the uncommanded CV. Advice is heard before the stop line alone.

    Attributes:
        name: the action mode.
        depth: advice caps the speed at no less than 1 minus this, in units of the limit.
        brake_mps2: it never brakes harder than this.
        act_share: share of decisions in which an untrained policy that explores advises anything.
        spread: standard deviation of an untrained policy before censoring and tanh: how strong such advice is.
    """

    name: Literal["advise"] = "advise"
    sets: ClassVar[Mapping[str, Any]] = BY_STEP
    depth: float = 0.8
    brake_mps2: float = 1.5
    act_share: float = 0.06
    spread: float = 0.35

    def __post_init__(self) -> None:
        check_types("action", self)
        check_range("action.depth", self.depth, 0.01, 1.0)
        check_range("action.brake_mps2", self.brake_mps2, 0.1, -ACTION_LOW_MPS2, "m/s^2")
        _ = self.rest

    @property
    def rest(self) -> Rest:
        """What doing nothing is."""
        return Rest(self.act_share, self.spread)

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes for advice."""
        from izoo.algos.actions.action_wrappers import Advised, SpeedCap
        from izoo.algos.drivers.scripted import make_driver

        learned = build(config, features, -self.depth, self.depth, rest=self.rest)
        name = getattr(config, "warm_start", "none")
        expert = None if name == "none" else make_driver(name, env)
        applied = _applied(config, env)
        return Advised(learned, SpeedCap(env, self.brake_mps2), self.depth, expert=expert, applied=applied)


@dataclass(frozen=True)
class ResidualAction:
    """The policy's action is taken from the acceleration of the nominal controller, glide; 0 leaves that as it is.

    A CV that glide leaves alone stays with the simulator's driver unless its action is above 0.

    Attributes:
        name: the action mode.
        half_width_mps2: the action lies between plus and minus this. 1 m/s^2 is as much as glide itself commands, so
            that it can be overruled where it brakes for nothing, and no more.
        act_share: share of decisions in which an untrained policy that explores holds a CV back (and, where glide
            commands, as often lets it go).
        spread: standard deviation of an untrained policy before censoring and tanh: how strong that is.
    """

    name: Literal["residual"] = "residual"
    sets: ClassVar[Mapping[str, Any]] = BY_STEP
    half_width_mps2: float = 1.0
    act_share: float = 0.08
    spread: float = 0.35

    def __post_init__(self) -> None:
        check_types("action", self)
        check_range("action.half_width_mps2", self.half_width_mps2, 0.01, ACTION_HIGH_MPS2 - ACTION_LOW_MPS2, "m/s^2")
        _ = self.rest

    @property
    def rest(self) -> Rest:
        """What doing nothing is."""
        return Rest(self.act_share, self.spread, two_sided=True)

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes for corrections."""
        from izoo.algos.actions.action_wrappers import Advised
        from izoo.algos.actions.residual import Correction, NominalDriver

        learned = build(config, features, -self.half_width_mps2, self.half_width_mps2, rest=self.rest)
        applied = _applied(config, env)
        return Advised(learned, Correction(NominalDriver(env)), self.half_width_mps2, applied=applied)


def _stores_applied(config: Any) -> bool:
    """Whether an algorithm replays what came of its actions."""
    return getattr(config, "stores", "commanded") == "applied"


def _applied(config: Any, env: EnvConfig) -> AppliedAcceleration | None:
    """Return what tells the algorithm what came of its actions, if it wants to know."""
    from izoo.algos.actions.executed_actions import AppliedAcceleration

    return AppliedAcceleration(env) if _stores_applied(config) else None


ActionConfig = DirectAction | SpeedAction | ArriveAction | AdviseAction | ResidualAction
