"""Scripted drivers: policies without learning, usable wherever a policy is.

Each reads ``("agents", "mask")`` ``[*B, A]``, and some ``("agents", "observation")`` ``[*B, A, F]``; all write
``("agents", "action")`` ``[*B, A, 1]`` in m/s^2 and most ``("agents", "defer")`` ``[*B, A]``, where true leaves a CV to
the simulator's own driver for the step. Where the environment takes desired speeds, those that say them write these,
``[*B, A, D]``. :func:`make_driver` builds one by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from izoo.algos.learners.base import ACTION, MASK, OBSERVATION
from izoo.algos.learners.registry import CAP, cap_share
from izoo.contexts.features import feature
from izoo.envs.config import (
    ACCELERATION,
    ACTION_HIGH_MPS2,
    ACTION_LOW_MPS2,
    KEEP_LANE,
    MIN_SHARE,
    SPEED,
    EnvConfig,
)
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M, SPEED_SCALE_MPS, TIME_SCALE_S
from izoo.errors import IzooError, check_range, check_types, unknown_choice

DEFER, LANE_CHANGE = ("agents", "defer"), ("agents", "lane_change")


class UncommandedDriver(TensorDictModuleBase):
    """Every CV is left to the simulator's car-following model: what the CVs' vehicle parameters do by themselves.

    With adoption 0 there are no CVs, and this is human driving.

    Args:
        config: settings of the environment; ``None``: it takes accelerations. Lane changes, where it takes them, are
            all "keep", and left to the simulator, too.
    """

    def __init__(self, config: EnvConfig | None = None) -> None:
        super().__init__()
        lane_change = config is not None and config.lane_change
        self.in_keys, self.out_keys = [MASK], [ACTION, DEFER, *([LANE_CHANGE] if lane_change else [])]
        self.size = 1 if config is None else config.action_size
        self.idle = 1.0 if config is not None and config.action == SPEED else 0.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write accelerations of 0, or desired speeds of 1, ``[*B, A, D]``, and ``defer``, all true, ``[*B, A]``."""
        mask = tensordict.get(MASK)
        tensordict.set(ACTION, torch.full((*mask.shape, self.size), self.idle))
        if LANE_CHANGE in self.out_keys:
            tensordict.set(LANE_CHANGE, torch.full_like(mask, KEEP_LANE, dtype=torch.int64))
        return tensordict.set(DEFER, torch.ones_like(mask))


class RandomDriver(TensorDictModuleBase):
    """Every CV draws its acceleration, or its desired speeds, uniformly, anew in each step.

    Args:
        config: settings of the environment; ``None``: it takes accelerations.
        low, high: bounds of the acceleration, m/s^2.
        seed: of the draws; ``None`` takes torch's default generator, which evaluation seeds for each episode. A copy,
            such as one that is sent to another process, begins to draw anew.
    """

    def __init__(
        self,
        low: float = ACTION_LOW_MPS2,
        high: float = ACTION_HIGH_MPS2,
        seed: int | None = 0,
        config: EnvConfig | None = None,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION]
        self.size = 1 if config is None else config.action_size
        self.low, self.high = (MIN_SHARE, 1.0) if config is not None and config.action == SPEED else (low, high)
        self._seed = seed
        self._generator: torch.Generator | None = None  # made at the first draw: PyTorch cannot send it to a process

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, D]``."""
        shape = (*tensordict.get(MASK).shape, self.size)
        if self._generator is None and self._seed is not None:
            self._generator = torch.Generator().manual_seed(self._seed)
        uniform = torch.rand(shape, generator=self._generator)
        return tensordict.set(ACTION, self.low + (self.high - self.low) * uniform)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of."""
        return {**self.__dict__, "_generator": None}


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
        self.column = observation_names(config).index("speed")

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        speed = observation[..., self.column] * SPEED_SCALE_MPS
        return (self.speed_mps - speed) / self.decision_s, torch.zeros_like(mask)


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
        self.share, self.speeds = share, config.action_size if config.action == SPEED else 0
        if self.speeds:
            if share < MIN_SHARE:
                raise IzooError(
                    f"{CAP}{share:g} is below the least desired speed of env.action=speed; give {MIN_SHARE:g} or more."
                )
            return
        names = observation_names(config)
        if "context_speed_limit_mps" not in names:
            raise IzooError("a speed cap needs the limit in the observation; add speed_limit_mps to env.observed.")
        self.response_s = max(1.0, config.decision_s)
        self.speed, self.limit = names.index("speed"), names.index("context_speed_limit_mps")
        self.limit_scale = feature("speed_limit_mps").scale

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action keys."""
        if not self.speeds:
            return super().forward(tensordict)
        mask = tensordict.get(MASK)
        tensordict.set(ACTION, torch.full((*mask.shape, self.speeds), self.share))
        return tensordict.set(DEFER, torch.zeros_like(mask))

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        speed = observation[..., self.speed] * SPEED_SCALE_MPS
        above = speed - self.share * observation[..., self.limit] * self.limit_scale
        free = (above < -self.near_mps) | torch.full_like(mask, self.share >= 1.0)
        return (-above / self.response_s).clamp_min(-self.brake_mps2), free


def greens(observation: Tensor, columns: Mapping[str, int]) -> tuple[list[Tensor], Tensor]:
    """Return in how many seconds the next three greens of each CV's movement begin, and how long they last, ``[*B, A]``
    each; one that has begun counts from below 0.

    Args:
        observation: ``[*B, A, F]``.
        columns: places of its features; ``green_s`` and ``red_s`` must be among them.
    """

    def column(name: str, scale: float = 1.0) -> Tensor:
        return observation[..., columns[name]] * scale

    left, second, third = (
        column(f"signal_{name}", TIME_SCALE_S) for name in ("time_left", "second_green", "third_green")
    )
    length = column("context_green_s", feature("green_s").scale)
    cycle = length + column("context_red_s", feature("red_s").scale)
    # On yellow the time left is that of the yellow, so the first green follows from the second.
    late = torch.where(column("signal_red") > 0.5, left, (second - cycle).clamp_min(0.0))
    return [torch.where(column("signal_green") > 0.5, left - length, late), second, third], length


@dataclass(frozen=True)
class GlideConfig:
    """Settings of :class:`Glide`; tuned by hand on measured training intersections.

    Attributes:
        max_lanes: on approaches with more lanes nobody glides. Where vehicles choose among lanes the queue ahead cannot
            be guessed from the leader, others overtake and merge in front, and the rule costs more than it gains.
        min_green_share: nor for movements with a smaller share of green: there CVs would glide through most of a long
            red, which burns twice what standing does, for a short discharge.
        stop_decel_mps2: in both cases, whoever must stop in any case brakes from where this is enough; 0: they
            are left alone.
        stop_margin: a stop is certain where the red light lasts this many times as long as the way to the stop takes
            at the present speed; 2: until a vehicle that brakes evenly stands.
        start_lag_s: time from green until the first vehicle of a queue crosses.
        headway_s: time between two vehicles of a discharging queue.
        spacing_m: road that a queued vehicle takes up.
        standing_gap_m: what is left free behind a standing leader.
        moving_fill: share of the road ahead of a moving leader that is assumed to fill with a queue.
        queue_speed_mps: a leader slower than this stands in a queue that reaches back to it.
        margin_s: a green is used only if this much of it is left on arrival.
        late_s: vehicles that would be early by less than this are left alone.
        floor_mps: never slower than this.
        near_m: within this distance of the stop line a CV is left alone.
        headway_gap_s: a CV closer than this behind its leader is left alone: it is following, not leading.
        response_s: time in which the advised speed is approached; not less than a decision lasts.
        brake_mps2, push_mps2: bounds on the commanded braking and acceleration.
    """

    max_lanes: int = 1
    min_green_share: float = 0.22
    stop_decel_mps2: float = 0.6
    stop_margin: float = 2.0
    start_lag_s: float = 2.0
    headway_s: float = 2.2
    spacing_m: float = 7.5
    standing_gap_m: float = 3.0
    moving_fill: float = 0.15
    queue_speed_mps: float = 2.0
    margin_s: float = 2.0
    late_s: float = 2.0
    floor_mps: float = 4.0
    near_m: float = 15.0
    headway_gap_s: float = 1.5
    response_s: float = 2.0
    brake_mps2: float = 1.0
    push_mps2: float = 1.0

    def __post_init__(self) -> None:
        check_types("glide", self)
        for name in ("headway_s", "spacing_m", "response_s", "floor_mps"):
            check_range(f"glide.{name}", getattr(self, name), 0.1, 1000.0)
        check_range("glide.max_lanes", self.max_lanes, 0, 100)
        check_range("glide.min_green_share", self.min_green_share, 0.0, 1.0)
        check_range("glide.stop_decel_mps2", self.stop_decel_mps2, 0.0, -ACTION_LOW_MPS2, "m/s^2")
        check_range("glide.stop_margin", self.stop_margin, 0.1, 10.0)
        check_range("glide.moving_fill", self.moving_fill, 0.0, 1.0)


class Glide(ScriptedDriver):
    """Queue-aware green-light speed advice.

    Each CV estimates when it can pass: the start of a green of its movement, plus the time that the queue ahead on its
    lane needs to discharge, skipping greens that the queue uses up; and slows gently, early, to arrive then. What it
    cannot observe, the vehicles ahead of its leader, it guesses from where the leader is and whether it moves. On
    approaches with more lanes than ``max_lanes``, and before short greens, a CV that has to stop in any case brakes
    early and gently instead: braking burns as little as standing, cruising twice as much. Whoever need not slow, is
    near the stop line, or follows closely is left to IDM.

    Args:
        config: settings of the environment; the leader and the features ``green_s``, ``red_s``, ``speed_limit_mps``
            and ``lane_count`` must be observed.
        settings: of the rule.
    """

    followers_stop = False
    """Whether a CV that follows closely brakes early for a stop, too."""

    def __init__(self, config: EnvConfig, settings: GlideConfig | None = None) -> None:
        super().__init__()
        self.settings = settings or GlideConfig()
        self.response_s = max(self.settings.response_s, config.decision_s)
        self.columns = {name: column for column, name in enumerate(observation_names(config))}
        needed = (
            "leader_present",
            *(f"context_{name}" for name in ("green_s", "red_s", "speed_limit_mps", "lane_count")),
        )
        missing = [name for name in needed if name not in self.columns]
        if missing:
            raise IzooError(
                f"glide needs {', '.join(missing)} in the observation; observe the leader (env.neighbours) and the "
                "features green_s, red_s, speed_limit_mps and lane_count (env.observed)."
            )

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        s = self.settings
        distance = -self._column(observation, "stop_line_distance", DISTANCE_SCALE_M)
        speed = self._column(observation, "speed", SPEED_SCALE_MPS)
        limit = self._column(observation, "context_speed_limit_mps", feature("speed_limit_mps").scale).clamp_min(1.0)
        gap = self._column(observation, "leader_distance", DISTANCE_SCALE_M)
        leader = observation[..., self.columns["leader_present"]] > 0.5
        approaching = observation[..., self.columns["location_approaching"]] > 0.5
        free_s = distance / limit
        arrival_s = self.passing_time(observation, distance, free_s)
        advised = torch.maximum(distance / arrival_s.clamp_min(0.1), torch.zeros_like(limit) + s.floor_mps)
        leads = approaching & ~(leader & (gap < s.headway_gap_s * speed))
        early = (arrival_s - free_s >= s.late_s) & (advised < limit) & (distance >= s.near_m)
        pays = self.gliding_pays(observation)
        glides = leads & pays & early
        glide = ((advised - speed) / self.response_s).clamp(-s.brake_mps2, s.push_mps2)
        decel, must_stop = self.stop(observation, distance, speed)
        stops = (approaching if self.followers_stop else leads) & ~pays & must_stop
        return torch.where(stops, -decel, glide), ~(glides | stops)

    def gliding_pays(self, observation: Tensor) -> Tensor:
        """Return whether the approach has few enough lanes and the movement green for long enough, ``[*B, A]``."""
        s = self.settings
        lanes = self._column(observation, "context_lane_count", feature("lane_count").scale)
        green = self._column(observation, "context_green_s", feature("green_s").scale)
        red = self._column(observation, "context_red_s", feature("red_s").scale)
        return (lanes < s.max_lanes + 0.5) & (green >= s.min_green_share * (green + red))

    def stop(self, observation: Tensor, distance: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the deceleration that ends in each CV's stop, ``[*B, A]`` in m/s^2, and whether it is time for it.

        It is at the line, or behind a leader that stands before it.

        Args:
            observation: ``[*B, A, F]``.
            distance: ``[*B, A]`` metres to the stop line.
            speed: ``[*B, A]`` m/s.
        """
        s = self.settings
        gap = self._column(observation, "leader_distance", DISTANCE_SCALE_M)
        queued = observation[..., self.columns["leader_present"]] > 0.5
        queued &= self._column(observation, "leader_speed", SPEED_SCALE_MPS) < s.queue_speed_mps
        ahead = torch.where(queued, torch.minimum(gap - s.standing_gap_m, distance), distance)
        decel = 0.5 * speed**2 / ahead.clamp_min(1.0)
        certain = self.stop_is_certain(observation, distance, ahead, speed)
        # Harder braking, and the last moment before standing, are left to the simulator.
        possible = (decel >= s.stop_decel_mps2) & (decel < 4.0) & (ahead > 5.0) & (speed > 3.0)
        return decel, certain & possible & (s.stop_decel_mps2 > 0.0)

    def stop_is_certain(self, observation: Tensor, distance: Tensor, ahead: Tensor, speed: Tensor) -> Tensor:
        """Return whether a red light keeps each CV from passing, ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            distance: ``[*B, A]`` metres to the stop line.
            ahead: ``[*B, A]`` metres to where it would stand.
            speed: ``[*B, A]`` m/s.
        """
        red = observation[..., self.columns["signal_red"]] > 0.5
        left = self._column(observation, "signal_time_left", TIME_SCALE_S)
        return red & (left > self.settings.stop_margin * ahead / speed.clamp_min(0.5))

    def passing_time(self, observation: Tensor, distance: Tensor, free_s: Tensor) -> Tensor:
        """Return in how many seconds each CV can pass the stop line, ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            distance: ``[*B, A]`` metres to the stop line.
            free_s: ``[*B, A]`` seconds to get there at the speed limit.
        """
        s = self.settings
        queue = self.queue_ahead(observation, distance)
        starts, length = greens(observation, self.columns)
        best = torch.full_like(distance, torch.inf)
        for start, end in ((start, start + length) for start in starts):
            # A green that has begun has already discharged a part of the queue; what is seen is what is left.
            discharged = start.clamp_min(0.0) + torch.where(start < 0, 0.0, s.start_lag_s) + s.headway_s * queue
            passing = torch.maximum(discharged, free_s)
            fits = (passing <= end - s.margin_s) & torch.isinf(best)
            best = torch.where(fits, passing, best)
            served = (end - start.clamp_min(0.0) - s.start_lag_s).clamp_min(0.0) / s.headway_s
            queue = torch.where(fits, queue, (queue - served).clamp_min(0.0))
        return torch.where(torch.isinf(best), starts[-1] + length, best)

    def queue_ahead(self, observation: Tensor, distance: Tensor) -> Tensor:
        """Return how many vehicles each CV expects to pass before it, on its lane, ``[*B, A]``."""
        s = self.settings
        leader = observation[..., self.columns["leader_present"]] > 0.5
        gap = self._column(observation, "leader_distance", DISTANCE_SCALE_M)
        ahead_m = distance - gap
        standing = self._column(observation, "leader_speed", SPEED_SCALE_MPS) < s.queue_speed_mps
        fill = torch.where(standing, 1.0, s.moving_fill)
        count = 1.0 + fill * ahead_m.clamp_min(0.0) / s.spacing_m
        return torch.where(leader & (ahead_m > 0.0), count, torch.zeros_like(count))

    def _column(self, observation: Tensor, name: str, scale: float) -> Tensor:
        return observation[..., self.columns[name]] * scale


DRIVERS: dict[str, Callable[[EnvConfig], TensorDictModuleBase]] = {
    "human": UncommandedDriver,
    "uncommanded": UncommandedDriver,
    "constant": ConstantSpeed,
    "constant_2.0": lambda config: ConstantAcceleration(2.0),
    "random": lambda config: RandomDriver(seed=None, config=config),
    "glide": Glide,
}
"""Scripted drivers by name. ``human`` is human driving only where the adoption is 0, which evaluation sees to."""
COMMANDING = ("constant", "constant_2.0", "glide")
"""Those of them that command accelerations in every step."""


def make_driver(name: str, config: EnvConfig) -> TensorDictModuleBase:
    """Return the scripted driver ``name`` for environments with ``config``.

    Raises:
        IzooError: there is none, or it commands accelerations anew in every step and the environment takes none.
    """
    share = cap_share(name)
    if name in COMMANDING or (share is not None and config.action == ACCELERATION):
        config.require_accelerations(name, ", or choose uncommanded, random or, with env.action=speed, cap_SHARE")
    if share is not None:
        return CappedSpeed(config, share)
    if name not in DRIVERS:
        raise unknown_choice("scripted driver", name, [*DRIVERS, "cap_SHARE"])
    return DRIVERS[name](config)
