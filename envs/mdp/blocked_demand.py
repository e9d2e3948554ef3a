"""Which vehicles of the demand are measured, when each could have reached the region, and what blocking it costs.

CO2 is counted inside the region, so a policy that keeps traffic outside would seem to save it. Blocked vehicles are
therefore counted too, as if they idled.
"""

from __future__ import annotations

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.envs.config import EnvConfig
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

NEVER = -1
"""Arrival step of a vehicle that has not arrived."""
_TICK_S = 1e-6


def cohort_of(config: EnvConfig, traffic: Traffic) -> np.ndarray:
    """Return which vehicles are scheduled to depart between warm-up and horizon, ``[N]`` bool, under any policy.

    Simulators read times in whole milliseconds.
    """
    depart_s = np.round(traffic.depart_s, 3)
    begin_s, length_s = config.warmup_steps * config.step_s, config.control_steps * config.step_s
    return (depart_s >= begin_s - _TICK_S) & (depart_s < begin_s + length_s - _TICK_S)


def earliest_arrivals(road: RoadNet, traffic: Traffic) -> np.ndarray:
    """Return when each vehicle would reach the region at the speed limit, from two lengths of the approach away.

    Returns:
        ``[N]``, s.
    """
    earliest_s = 2.0 * road.lane_length_m / road.speed_limit_mps
    return traffic.depart_s + earliest_s[traffic.approach]


def blocked_s(
    arrival_step: np.ndarray, earliest_s: np.ndarray, started_s: float, steps: int, step_s: float
) -> np.ndarray:
    """Return how long each vehicle was blocked outside since control began, ``[N]`` s.

    A vehicle is blocked from its earliest possible arrival until it arrives: on its way, waiting to enter the network,
    or dropped by the simulator. Delay at upstream signals is included, and is the same for every policy.

    Args:
        arrival_step: ``[N]`` control step in which the vehicle arrived, :data:`NEVER` if it did not.
        earliest_s: ``[N]`` from :func:`earliest_arrivals`.
        started_s: simulated time at which control began.
        steps, step_s: how many steps were played, and how long they are.
    """
    until_s = np.where(arrival_step == NEVER, steps, arrival_step) * step_s
    return np.maximum(until_s - np.maximum(earliest_s - started_s, 0.0), 0.0)


def idle_rates(context: Context, road: RoadNet, traffic: Traffic, weights: KernelWeights) -> np.ndarray:
    """Return each vehicle's CO2 rate when idling on its approach, ``[N]`` g/s; 0 for electric CVs."""
    still = np.zeros(len(traffic), np.float32)
    grade_pct = (100.0 * road.grade[traffic.approach]).astype(np.float32)
    burning = (~(traffic.is_cv.astype(bool) & (context.engine == "electric"))).astype(np.uint8)
    rates = np.empty(len(traffic), np.float32)
    weather = (context.temperature_c, context.humidity_pct)
    emission_rate_kernel(still, still, grade_pct, traffic.moves_class, burning, *weather, weights, rates)
    return rates.astype(np.float64)
