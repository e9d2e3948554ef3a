"""What a human-driven vehicle burns on an approach, roughly: the unit of a reward that is a sum.

An estimate from the context and the episode's demand alone, so that rewards need no simulation of human driving. It
only has to weigh contexts alike: one and the same number divides everything that is paid on an approach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

SATURATION_VPS_PER_LANE = 0.5
ACCEL_MPS2 = 1.5
MOST_SAMPLED = 64
GRACE_S = 60.0
"""A reward counts a vehicle as held up outside if it has not come so long after it could have: a cycle of the signals
that feed its approach may pass before it does."""


class Units(NamedTuple):
    """Of each approach, ``[P]``: what a human-driven vehicle burns on it, g, and what a vehicle burns standing, g/s,
    electric CVs nothing; and of all.

    Attributes:
        unit_g, idle_gps: by approach.
        fleet_g_per_step: what the vehicles that come during a step will burn in all, g.
    """

    unit_g: np.ndarray
    idle_gps: np.ndarray
    fleet_g_per_step: float


def units_of(
    context: Context, road: RoadNet, traffic: Traffic, weights: KernelWeights, horizon_s: float, step_s: float
) -> Units:
    """Return the units of an episode.

    A vehicle crosses the approach at the limit, waits as long as uniform arrivals at a fixed-time signal do (Webster,
    Road Research Technical Paper 39, first term), and of those who wait each accelerates once, half of it before the
    stop line.
    """
    approaches = len(road.approaches)
    unit_g, idle_gps = np.ones(approaches), np.ones(approaches)
    arrivals = np.bincount(traffic.approach, minlength=approaches)
    for p in np.flatnonzero(arrivals):
        own = np.flatnonzero(traffic.approach == p)
        sampled = own[:: max(len(own) // MOST_SAMPLED, 1)]
        classes, burning = traffic.moves_class[sampled], np.ones(len(sampled), bool)
        limit, length = float(road.speed_limit_mps[p]), float(road.lane_length_m[p])
        ways = road.movement_turn[p] >= 0
        cycle, green = road.clock.cycle_s, float(road.clock.green_s[p][ways].max(initial=1.0))
        red_share = 1.0 - min(green / cycle, 1.0)
        capacity = SATURATION_VPS_PER_LANE * float(road.lane_count[p])
        load = min(arrivals[p] / horizon_s / capacity, 0.95 * (1.0 - red_share), 0.9)
        stop_share = min(red_share / (1.0 - load), 1.0)
        wait_s = 0.5 * cycle * red_share**2 / (1.0 - load)
        grade = 100.0 * float(road.grade[p])
        cruise, idle = (_rate(classes, burning, v, 0.0, grade, context, weights) for v in (limit, 0.0))
        launch_g = limit / ACCEL_MPS2 * _rate(classes, burning, 0.5 * limit, ACCEL_MPS2, grade, context, weights)
        unit_g[p] = cruise * length / limit + idle * wait_s + 0.5 * stop_share * launch_g
        if context.engine == "electric":
            burning = ~traffic.is_cv[sampled].astype(bool)
        idle_gps[p] = _rate(classes, burning, 0.0, 0.0, grade, context, weights)
    per_step = float(unit_g @ arrivals) / horizon_s * step_s
    return Units(unit_g, idle_gps, per_step if per_step > 0.0 else 1.0)


def _rate(
    classes: np.ndarray,
    burning: np.ndarray,
    speed: float,
    accel: float,
    grade: float,
    context: Context,
    weights: KernelWeights,
) -> float:
    """Return the mean CO2 rate of vehicles of these classes, g/s; those whose engine does not burn emit nothing."""
    same = np.ones(len(classes), np.float32)
    out = np.empty(len(classes), np.float32)
    motion = (np.float32(speed) * same, np.float32(accel) * same, np.float32(grade) * same)
    weather = (context.temperature_c, context.humidity_pct)
    emission_rate_kernel(*motion, classes, burning.astype(np.uint8), *weather, weights, out)
    return float(out.mean())


def reach_times(road: RoadNet, traffic: Traffic) -> np.ndarray:
    """Return when each vehicle could have come to the region, at the limit, from two lengths of the approach away.

    Returns:
        ``[N]``, s.
    """
    reach_s = 2.0 * road.lane_length_m / road.speed_limit_mps
    return traffic.depart_s + reach_s[traffic.approach]


def due_times(road: RoadNet, traffic: Traffic) -> np.ndarray:
    """Return when each vehicle counts as held up, for a reward that is a sum, if it has not come; ``[N]`` s."""
    return reach_times(road, traffic) + GRACE_S
