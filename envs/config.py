"""Settings of an environment: simulation, decisions, observation, reward, emitted groups."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from types import MappingProxyType

from izoo.contexts.features import OBSERVED, check_observed
from izoo.envs.mdp.observation import NEIGHBOURS
from izoo.envs.mdp.reward import RewardConfig
from izoo.errors import IzooError, check_choice, check_range
from izoo.options import CheckedOptions

__all__ = ["EnvConfig", "RewardConfig"]
ACTION_LOW_MPS2, ACTION_HIGH_MPS2 = -4.5, 2.6
MIN_SHARE = 0.1
"""Lower bound of a desired speed, as a share of the limit."""
KEEP_LANE, LANE_CHANGES = 1, 3
"""Of the lane changes 0 right, 1 keep and 2 left: the middle one, and how many there are."""
MAX_WORKERS = 1024
MAX_AGENTS = 4096
EMIT_GROUPS = ("vehicles", "signal", "context", "metrics", "reward_vector", "team_reward", "number")
STEP, VEHICLE, VEHICLE_AND_LINE = "step", "vehicle", "vehicle_and_line"
SCOPES = (STEP, VEHICLE, VEHICLE_AND_LINE)
ACCELERATION, SPEED = "acceleration", "speed"
ACTIONS = (ACCELERATION, SPEED)
WHOLE_WAY, BEFORE, BEFORE_AND_BEHIND = ("speed",), ("speed_before",), ("speed_before", "speed_behind")
STOP, GLIDE = "stop", "glide"
FURTHER_PARTS = ((), (STOP,), (GLIDE,), (STOP, GLIDE))
BY_STEP = MappingProxyType({"decide": STEP, "action": ACCELERATION, "action_parts": WHOLE_WAY})
"""Settings with which accelerations are decided in every step."""


@dataclass(frozen=True)
class EnvConfig(CheckedOptions):
    """Everything about an environment that is not the context.

    Attributes:
        step_s: length of a simulation step, in whole milliseconds. Human drivers react once per step: at 1 s they
            collide now and then, in SUMO as on the twin (which does not count it); at 0.5 s no collision was seen.
        hold_s: how long a decision of the policy lasts, a whole multiple of ``step_s``; ``None``: one step. Its action
            is held, rewards are summed over its steps, and a CV that enters during it makes its first decision when it
            ends (uncommanded until then). The last decision of an episode may be shorter. A commanded lane change is
            repeated in every step, so one decision may cross several lanes; rows of vehicles, unlike agents' slots,
            may be reused within a decision, which ``vehicle_number`` shows. Where ``decide`` is not ``step``, the
            longest step of the environment; ``None``: until a CV must decide.
        decide: when a CV decides: in every ``step`` (of ``hold_s``); once per ``vehicle``, when it enters; or once per
            ``vehicle_and_line``, and once more when it has crossed the stop line. A decision holds until the next one,
            and a step of the environment lasts until a CV must decide, the horizon, or the end.
        action: kind of decision: an ``acceleration`` in m/s^2, or a desired ``speed`` as a share of the limit, which
            the vehicle's own car-following keeps to; 1 is uncommanded.
        action_parts: numbers of an action ``speed``: one for the whole way (``speed``), one for the way to the stop
            line alone (``speed_before``), or one each before and behind it (``speed_before``, ``speed_behind``). After
            these, or alone, ``stop`` says how gently a CV brakes for a red light that it cannot avoid, and ``glide``
            how slowly, as a share of the limit, it may approach to arrive when it can pass; 1 leaves either to its
            driver.
        horizon_s: length of an episode, warm-up included (500 s is the paper's "1000 steps"). This and the next two are
            rounded to whole steps.
        warmup_s: time at the start without control or measurement.
        drain_s: how long an episode is played out after the horizon at most: no further demand comes, and simulation
            and control go on until every vehicle has left. 0 (as in training): it ends at the horizon.
        num_agents: agent slots ``A``; surplus CVs are driven by IDM and counted.
        num_vehicles: vehicle slots ``V``; surplus vehicles are simulated and measured, but not emitted.
        num_approaches: rows ``P`` of the per-approach metrics.
        observed: context features in the observation, a subset of the observable ones, in their order.
        neighbours: which of the six neighbouring vehicles are observed.
        sensor_range_m: neighbours farther than this (bumper to bumper) count as absent; ``None``: the whole region.
        lane_change: whether the policy also commands lane changes (0 right, 1 keep, 2 left).
        reward: weights of the reward.
        emit: groups of keys that are emitted besides ``agents``: any of ``vehicles``, ``signal``, ``context``,
            ``metrics``, ``reward_vector``, ``team_reward`` (the reward's fleet part, also without any CV), ``number``
            (``("agents", "number")``, the vehicle's number in the demand, always emitted with a ``decide`` other than
            ``step``). Fewer groups make stepping and storage cheaper.
        recycle_episodes: a worker process is replaced after this many episodes, should SUMO leak memory.
        watchdog_s: a worker that does not answer for this long is replaced.
        gui: open sumo-gui (one environment, in this process).
        late_vehicle: this vehicle of every approach, counted from 1 in the order of departure, departs a step later
            than drawn; 0: none. The effect of such a change is the simulator's own spread, which
            ``izoo.benchmarks.twin`` measures.
    """

    step_s: float = 0.5
    hold_s: float | None = None
    decide: str = STEP
    action: str = ACCELERATION
    action_parts: tuple[str, ...] = WHOLE_WAY
    horizon_s: float = 1000.0
    warmup_s: float = 25.0
    drain_s: float = 0.0
    num_agents: int = 64
    num_vehicles: int = 256
    num_approaches: int = 6
    observed: tuple[str, ...] = OBSERVED
    neighbours: tuple[str, ...] = NEIGHBOURS
    sensor_range_m: float | None = None
    lane_change: bool = False
    reward: RewardConfig = field(default_factory=RewardConfig)
    emit: tuple[str, ...] = ("vehicles", "signal", "context", "metrics")
    recycle_episodes: int = 1000
    watchdog_s: float = 60.0
    gui: bool = False
    late_vehicle: int = 0

    group = "env"
    ranges = (
        ("step_s", 0.05, 1.0, "s"),
        ("horizon_s", 0.05, 86400.0, "s"),
        ("warmup_s drain_s", 0.0, 86400.0, "s"),
        ("num_agents", 1, MAX_AGENTS),
        ("num_vehicles", 1, 8192),
        ("num_approaches", 1, 26),
        ("recycle_episodes", 1, 10**9),
        ("late_vehicle", 0, 10**6),
        ("watchdog_s", 0.1, 86400.0, "s"),
        ("sensor_range_m", 1.0, 1e5, "m"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Hydra hands over lists; tuples keep the config hashable.
        for name in ("neighbours", "emit", "action_parts"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "observed", check_observed(self.observed))
        for name in self.neighbours:
            check_choice("neighbour", name, NEIGHBOURS)
        if len(set(self.neighbours)) != len(self.neighbours):
            raise IzooError(f"env.neighbours is {list(self.neighbours)}; name each once.")
        for name in self.emit:
            check_choice("emit group", name, EMIT_GROUPS)
        step_ms = 1000.0 * self.step_s
        if abs(step_ms - round(step_ms)) > 1e-6:
            near = " or ".join(f"{ms / 1000.0:g}" for ms in (int(step_ms), int(step_ms) + 1))
            raise IzooError(
                f"env.step_s is {self.step_s:g}, and simulators keep time in whole milliseconds. Give {near}."
            )
        self._check_hold()
        self._check_decisions()
        if self.control_steps < 1:
            raise IzooError(
                f"horizon_s is {self.horizon_s:g} and warmup_s {self.warmup_s:g}; the horizon must be the longer one, "
                f"by a step of {self.step_s:g} s at least."
            )

    def _check_hold(self) -> None:
        if self.hold_s is None:
            return
        check_range("hold_s", self.hold_s, self.step_s, 60.0, "s")
        ratio = self.hold_s / self.step_s
        if abs(ratio - round(ratio)) > 1e-6:
            near = sorted({max(int(ratio), 1) * self.step_s, (int(ratio) + 1) * self.step_s})
            raise IzooError(
                f"env.hold_s is {self.hold_s:g}, not a whole multiple of env.step_s={self.step_s:g}: a decision "
                f"lasts whole steps. Give {' or '.join(f'{value:g}' for value in near)}, or null for one step."
            )

    def _check_decisions(self) -> None:
        check_choice("env.decide", self.decide, SCOPES)
        check_choice("env.action", self.action, ACTIONS)
        speeds = tuple(part for part in self.action_parts if part not in (STOP, GLIDE))
        further = self.action_parts[len(speeds) :]
        known = speeds in ((), WHOLE_WAY, BEFORE, BEFORE_AND_BEHIND) and further in FURTHER_PARTS
        if not known or not self.action_parts:
            raise IzooError(
                f"env.action_parts is {list(self.action_parts)}; give {list(WHOLE_WAY)} for one speed all the way, "
                f"{list(BEFORE)} for one before the stop line, or {list(BEFORE_AND_BEHIND)} for one on either side; "
                f"{STOP}, {GLIDE} or both, in this order, may follow or stand alone."
            )
        if self.action != SPEED and self.action_parts != WHOLE_WAY:
            raise IzooError(
                f"env.action_parts is {list(self.action_parts)}, parts of a desired speed, and env.action is "
                f"{self.action}; set env.action=speed too."
            )
        if self.lane_change and (self.decide != STEP or self.action != ACCELERATION):
            raise IzooError(
                f"env.lane_change goes with accelerations in every step, and env.decide is {self.decide} and "
                f"env.action {self.action}; leave lane_change off, or set env.decide=step and env.action=acceleration."
            )

    def require_accelerations(self, what: str, instead: str = "") -> None:
        """Raise :class:`IzooError` unless decisions are accelerations in every step, or every ``hold_s``.

        Args:
            what: what needs them, the beginning of a sentence.
            instead: an alternative, its end.
        """
        if (self.decide, self.action) != (STEP, ACCELERATION):
            raise IzooError(
                f"{what} commands accelerations in every step, and env.decide is {self.decide} and env.action "
                f"{self.action}; set env.decide=step and env.action=acceleration{instead}."
            )

    def with_accelerations(self, hold_s: float | None = None) -> EnvConfig:
        """Return the same environment, in which accelerations are commanded in every step, or every ``hold_s``."""
        return dataclasses.replace(self, **BY_STEP, hold_s=hold_s)  # type: ignore[arg-type]

    @property
    def action_size(self) -> int:
        """Numbers of an action, ``D``."""
        return len(self.action_parts) if self.action == SPEED else 1

    def column(self, *parts: str) -> int:
        """Return which number of an action is one of these parts; -1: none, it is 1."""
        return next((k for k, part in enumerate(self.action_parts) if part in parts), -1)

    @property
    def hold_steps(self) -> int:
        """Simulation steps of a decision; the maximum where ``decide`` is not ``step``."""
        if self.hold_s is None:
            return 1 if self.decide == STEP else self.total_steps
        return round(self.hold_s / self.step_s)

    @property
    def decision_s(self) -> float:
        """Length of a decision."""
        return self.hold_steps * self.step_s

    @property
    def decisions(self) -> int:
        """Decisions of an episode up to its horizon, which are steps of the environment.

        Where ``decide`` is not ``step`` their number is not known beforehand; this is the number of simulation steps,
        an upper bound.
        """
        if self.decide != STEP:
            return self.control_steps
        return -(-self.control_steps // self.hold_steps)

    @property
    def warmup_steps(self) -> int:
        """Steps without control or measurement."""
        return round(self.warmup_s / self.step_s)

    @property
    def control_steps(self) -> int:
        """Simulation steps from the end of the warm-up to the horizon."""
        return round(self.horizon_s / self.step_s) - self.warmup_steps

    @property
    def drain_steps(self) -> int:
        """Simulation steps after the horizon in which an episode is played out, at most."""
        return round(self.drain_s / self.step_s)

    @property
    def total_steps(self) -> int:
        """Simulation steps of an episode from the end of the warm-up on, at most."""
        return self.control_steps + self.drain_steps


def checked_config(config: EnvConfig | None) -> EnvConfig:
    """Return a constructor's settings; ``None`` stands for the defaults.

    Raises:
        IzooError: it is something else.
    """
    if config is None:
        return EnvConfig()
    if not isinstance(config, EnvConfig):
        raise IzooError(f"config is a {type(config).__name__}; give an izoo.envs.EnvConfig, or None for the defaults.")
    return config
