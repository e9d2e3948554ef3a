"""The reward: its terms, each declared once, and their weights.

A term is a field of :class:`RewardConfig` made by :func:`term`: the field's name is the option of its weight, and from
its declaration follow that option with its default and help, the columns of ``("agents", "reward_vector")``, the specs,
and the compiled code (:mod:`izoo.envs.mdp.reward_kernel`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from izoo.errors import IzooError
from izoo.options import CheckedOptions

TTC_CAP_S = 10.0
_TERM = "reward term"


@dataclass(frozen=True)
class RewardTerm:
    """One term of the reward.

    Attributes:
        name: of its column in the reward vector, with its unit.
        unit: its unit.
        value: ``value(vehicle, config) -> float`` for a vehicle's record after the step
            (:data:`izoo.envs.mdp.columns.Vehicle`), where ``config`` holds the fields of :class:`RewardConfig` other
            than weights. It is compiled.
        upper: ``None``: an individual term, whose fleet mean is used too. A number: a term shared by all agents,
            the smallest value over all vehicles, at most this.
    """

    name: str
    unit: str
    value: Callable[[Any, Any], float]
    upper: float | None = None


def term(
    weight: float, name: str, unit: str, value: Callable[[Any, Any], float], help: str, upper: float | None = None
) -> Any:
    """Return a field of :class:`RewardConfig` that holds a term's weight.

    Args:
        weight: its default.
        name, unit, value, upper: see :class:`RewardTerm`.
        help: description of the weight in ``--help``.
    """
    return dataclasses.field(default=weight, metadata={_TERM: RewardTerm(name, unit, value, upper), "help": help})


def _stopped(vehicle: Any, config: Any) -> float:
    v = vehicle.speed_mps
    if v >= config.tau_mps:
        return 0.0
    return (config.tau_mps - v) / config.tau_mps if config.soft_stop else 1.0


@dataclass(frozen=True)
class RewardConfig(CheckedOptions):
    """Weights of the reward, ``r_i = (sum of w_k (eta mean_j(x_jk) + (1 - eta) x_ik) + sum of w_s y_s) / scale``.

    ``x_ik`` are the individual terms of vehicle ``i`` after the step: its speed in m/s, whether it is stopped, its CO2
    in g, comfort ``-|a_t|`` and kinematic realism ``-|a_t - a_{t-1}|`` in m/s^2. The mean is over all vehicles in the
    region, human-driven ones too. ``y_s`` are terms that all share: the smallest time to collision.

    With ``sums``, ``x_ik`` is a sum over the vehicle and those behind it up to the next CV, and the mean is replaced by
    the sum over all vehicles, the team's. Vehicles count over their whole way through the region, and vehicles blocked
    outside count as if they stood on the approach. Vehicles behind the stop line are credited only to CVs behind it.
    The sums are in units of human driving: the CO2 of a vehicle on its whole way, or of all vehicles that arrive during
    a step. So contexts weigh alike, and no CV gains by blocking others.

    Attributes:
        eta: share of the fleet; with 1 all CVs have the same reward.
        tau_mps: below this speed a vehicle counts as stopped.
        scale: the sum is divided by it.
        sums: reward sums in units of human driving instead of means.
        soft_stop: the released code's softened stop term ``(tau - v) / tau`` instead of the paper's indicator.
    """

    eta: float = 1.0
    speed: float = term(1.0, "speed_mps", "m/s", lambda vehicle, config: vehicle.speed_mps, "weight of speed.")
    alpha: float = term(-35.0, "stopped", "1", _stopped, "weight of stopping.")
    beta: float = term(-3.0, "emission_g", "g", lambda vehicle, config: vehicle.emission_g, "weight of emission.")
    tau_mps: float = 1.0
    scale: float = 15.0
    soft_stop: bool = False
    sums: bool = False
    comfort: float = term(
        0.0, "comfort", "m/s^2", lambda vehicle, config: -abs(vehicle.accel_mps2), "weight of the comfort term."
    )
    realism: float = term(
        0.0,
        "realism",
        "m/s^2",
        lambda vehicle, config: -abs(vehicle.accel_mps2 - vehicle.prev_accel_mps2),
        "weight of the kinematic-realism term.",
    )
    delay: float = term(
        0.0,
        "delay_s",
        "s",
        lambda vehicle, config: vehicle.delay_s,
        "weight of the time lost against driving at the limit, below 0 to avoid it.",
    )
    safety: float = term(
        0.0,
        "min_ttc_s",
        "s",
        lambda vehicle, config: vehicle.ttc_s,
        "weight of the smallest time to collision over all vehicles, capped at 10 s, shared by all.",
        upper=TTC_CAP_S,
    )

    group = "reward"
    ranges = (("eta", 0.0, 1.0), ("tau_mps", 1e-3, 100.0, "m/s"), ("scale", 1e-6, 1e9))

    @classmethod
    def paper(cls) -> RewardConfig:
        """Return the reward of the paper: the defaults."""
        return cls()

    @classmethod
    def fuel(cls) -> RewardConfig:
        """Return minus CO2 and delay of the CV and the vehicles behind it: the measure of an evaluation, per CV.

        A second of delay counts as half a gram, about the rate of an idling vehicle. CO2 and delay of vehicles blocked
        outside count too.
        """
        return cls(eta=0.0, speed=0.0, alpha=0.0, beta=-1.0, delay=-0.5, scale=1.0, sums=True)

    @classmethod
    def fuel_team(cls) -> RewardConfig:
        """Return the same for all vehicles together: every CV gets the team's reward."""
        return dataclasses.replace(cls.fuel(), eta=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sums and not (self.beta or self.delay):
            raise IzooError(
                "reward.sums=true is in units of human driving's CO2, but reward.beta and reward.delay are both 0: the "
                "reward has no CO2 and no delay. Choose env.reward=fuel, or set one of them below 0."
            )


PRESETS = ("paper", "fuel", "fuel_team")
"""What ``env.reward=`` may be: class methods of :class:`RewardConfig`."""
TERMS: dict[str, RewardTerm] = {
    field.name: field.metadata[_TERM] for field in dataclasses.fields(RewardConfig) if _TERM in field.metadata
}
"""All terms by the option of their weight, in the order in which they are added up."""
INDIVIDUAL = {option: declared for option, declared in TERMS.items() if declared.upper is None}
SHARED = {option: declared for option, declared in TERMS.items() if declared.upper is not None}
REWARD_COLUMNS = tuple(declared.name for declared in INDIVIDUAL.values())
"""Individual columns of ``("agents", "reward_vector")``."""
REWARD_VECTOR = (
    *REWARD_COLUMNS,
    *(f"fleet_{name}" for name in REWARD_COLUMNS),
    *(declared.name for declared in SHARED.values()),
)
"""All columns of ``("agents", "reward_vector")``: the individual ones, their fleet means, and the shared ones."""
