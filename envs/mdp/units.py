"""Roughly the CO2 of a human-driven vehicle in the region: the unit of a reward that is a sum.

It is estimated from the context and the episode's demand alone, so that rewards need no simulation of human driving.
It only has to weigh contexts alike: the same number divides all rewards of an approach's vehicles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.networks.road import INSIDE, LEAVING, RoadNet
from izoo.traffic.sampling import Traffic

SATURATION_VPS_PER_LANE = 0.5
ACCEL_MPS2 = 1.5
MAX_SAMPLED = 64


class Units(NamedTuple):
    """CO2 of human-driven vehicles over their way through the region.

    Attributes:
        unit_g: ``[P]`` of a vehicle of each approach, g.
        fleet_g_per_step: of all vehicles that arrive during a step, g.
    """

    unit_g: np.ndarray
    fleet_g_per_step: float


def human_units(
    context: Context, road: RoadNet, traffic: Traffic, weights: KernelWeights, horizon_s: float, step_s: float
) -> Units:
    """Return the units of an episode.

    A vehicle drives through the region at the limit, waits as long as uniform arrivals at a fixed-time signal do
    (Webster, Road Research Technical Paper 39, first term), and each of those that wait accelerates once.
    """
    approaches = len(road.approaches)
    unit_g = np.ones(approaches)
    arrivals = np.bincount(traffic.approach, minlength=approaches)
    for p in np.flatnonzero(arrivals).tolist():
        own = np.flatnonzero(traffic.approach == p)
        classes = traffic.moves_class[own[:: max(len(own) // MAX_SAMPLED, 1)]]
        limit, length = float(road.speed_limit_mps[p]), float(road.lane_length_m[p])
        ways = road.movement_turn[p] >= 0
        cycle, green = road.clock.cycle_s, float(road.clock.green_s[p][ways].max(initial=1.0))
        red_share = 1.0 - min(green / cycle, 1.0)
        capacity = SATURATION_VPS_PER_LANE * float(road.lane_count[p])
        load = min(arrivals[p] / horizon_s / capacity, 0.95 * (1.0 - red_share), 0.9)
        stop_share = min(red_share / (1.0 - load), 1.0)
        wait_s = 0.5 * cycle * red_share**2 / (1.0 - load)
        grade = 100.0 * float(road.grade[p])
        cruise, idle = (_mean_rate_gps(classes, v, 0.0, grade, context, weights) for v in (limit, 0.0))
        level = _mean_rate_gps(classes, limit, 0.0, 0.0, context, weights)
        launch_g = limit / ACCEL_MPS2 * _mean_rate_gps(classes, 0.5 * limit, ACCEL_MPS2, grade, context, weights)
        way_g = (cruise * length + level * _beyond_line_m(road, p)) / limit
        unit_g[p] = way_g + idle * wait_s + stop_share * launch_g
    per_step = float(unit_g @ arrivals) / horizon_s * step_s
    return Units(unit_g, per_step if per_step > 0.0 else 1.0)


def _beyond_line_m(road: RoadNet, p: int) -> float:
    """Return the mean length of the ways behind the stop line of an approach, over its exits."""
    lengths = []
    for q in np.flatnonzero(road.movement_turn[p] >= 0):
        inside = (road.lane_location == INSIDE) & (road.lane_approach == p) & (road.lane_exit == q)
        leaving = (road.lane_location == LEAVING) & (road.lane_exit == q)
        lengths.append(road.inside_length_m[inside].max(initial=0.0) + road.lane_length[leaving].max(initial=0.0))
    return float(np.mean(lengths)) if lengths else 0.0


def _mean_rate_gps(
    classes: np.ndarray, speed: float, accel: float, grade: float, context: Context, weights: KernelWeights
) -> float:
    """Return the mean CO2 rate of vehicles of these classes, g/s."""
    same = np.ones(len(classes), np.float32)
    out = np.empty(len(classes), np.float32)
    motion = (np.float32(speed) * same, np.float32(accel) * same, np.float32(grade) * same)
    weather = (context.temperature_c, context.humidity_pct)
    emission_rate_kernel(*motion, classes, np.ones(len(classes), np.uint8), *weather, weights, out)
    return float(out.mean())
