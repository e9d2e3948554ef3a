"""Glide: queue-aware green-light speed advice."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from izoo.algos.drivers.base import ScriptedDriver
from izoo.algos.drivers.observed import Observed
from izoo.envs.config import ACTION_LOW_MPS2, EnvConfig
from izoo.options import CheckedOptions


@dataclass(frozen=True)
class GlideConfig(CheckedOptions):
    """Settings of :class:`Glide`; tuned by hand on measured training intersections.

    Attributes:
        max_lanes: on approaches with more lanes no CV glides. Where vehicles choose among lanes the queue ahead cannot
            be guessed from the leader, others overtake and merge in front, and the rule costs more than it gains.
        min_green_share: nor for movements with a smaller share of green: there CVs would glide through most of a long
            red, which burns twice what standing does, for a short discharge.
        stop_decel_mps2: in both cases, CVs that must stop in any case brake from where this is enough; 0: they
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

    group = "glide"
    ranges = (
        ("headway_s spacing_m response_s floor_mps", 0.1, 1000.0),
        ("max_lanes", 0, 100),
        ("min_green_share moving_fill", 0.0, 1.0),
        ("stop_decel_mps2", 0.0, -ACTION_LOW_MPS2, "m/s^2"),
        ("stop_margin", 0.1, 10.0),
    )


class Glide(ScriptedDriver):
    """Queue-aware green-light speed advice.

    Each CV estimates when it can pass: the start of a green of its movement, plus the time that the queue ahead on its
    lane needs to discharge, skipping greens that the queue uses up; and slows gently, early, to arrive then. What it
    cannot observe, the vehicles ahead of its leader, it guesses from where the leader is and whether it moves. On
    approaches with more lanes than ``max_lanes``, and before short greens, a CV that has to stop in any case brakes
    early and gently instead: braking burns as little as standing, cruising twice as much. A CV that need
    not slow, is near the stop line, or follows closely is left to IDM.

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
        features = ("green_s", "red_s", "speed_limit_mps", "lane_count")
        self.seen = Observed(config, ("leader_present", *(f"context_{name}" for name in features)), "glide")

    def drive(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        s = self.settings
        distance = -self.seen(observation, "stop_line_distance")
        speed = self.seen(observation, "speed")
        limit = self.seen(observation, "context_speed_limit_mps").clamp_min(1.0)
        gap = self.seen(observation, "leader_distance")
        leader = self.seen.flag(observation, "leader_present")
        approaching = self.seen.flag(observation, "location_approaching")
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
        lanes = self.seen(observation, "context_lane_count")
        green = self.seen(observation, "context_green_s")
        red = self.seen(observation, "context_red_s")
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
        gap = self.seen(observation, "leader_distance")
        queued = self.seen.flag(observation, "leader_present")
        queued &= self.seen(observation, "leader_speed") < s.queue_speed_mps
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
        red = self.seen.flag(observation, "signal_red")
        left = self.seen(observation, "signal_time_left")
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
        starts, length = self.seen.greens(observation)
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
        leader = self.seen.flag(observation, "leader_present")
        gap = self.seen(observation, "leader_distance")
        ahead_m = distance - gap
        standing = self.seen(observation, "leader_speed") < s.queue_speed_mps
        fill = torch.where(standing, 1.0, s.moving_fill)
        count = 1.0 + fill * ahead_m.clamp_min(0.0) / s.spacing_m
        return torch.where(leader & (ahead_m > 0.0), count, torch.zeros_like(count))
