"""Which vehicles of the demand are measured, when each could have come to the region, and what blocking it costs.

CO2 is counted inside the region, so a policy that makes others wait before it would seem to save what they burn there.
Nobody sees these vehicles in detail; what they burn is counted as if they stood with their engines running.
"""

from __future__ import annotations

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.envs.config import EnvConfig
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

NEVER = -1
"""Step at which a vehicle came that has not come."""
_TICK_S = 1e-6


def cohort_of(config: EnvConfig, traffic: Traffic) -> np.ndarray:
    """Return which vehicles are scheduled to depart between warm-up and horizon, ``[N]`` bool, whatever a policy does.

    Simulators read times in whole milliseconds.
    """
    depart_s = np.round(traffic.depart_s, 3)
    begin_s, length_s = config.warmup_steps * config.step_s, config.control_steps * config.step_s
    return (depart_s >= begin_s - _TICK_S) & (depart_s < begin_s + length_s - _TICK_S)


def reach_times(road: RoadNet, traffic: Traffic) -> np.ndarray:
    """Return when each vehicle could have come to the region, at the limit, from two lengths of the approach away.

    Returns:
        ``[N]``, s.
    """
    reach_s = 2.0 * road.lane_length_m / road.speed_limit_mps
    return traffic.depart_s + reach_s[traffic.approach]


def blocked_s(came: np.ndarray, reach_s: np.ndarray, started_s: float, steps: int, step_s: float) -> np.ndarray:
    """Return how long each vehicle was blocked outside since control began, ``[N]`` s.

    A vehicle is blocked from when it could have come to the region until it does: on its way, waiting to enter the
    network, or dropped by the simulator. What the signals upstream take is part of it, and the same whoever drives.

    Args:
        came: ``[N]`` steps of control that had been played when the vehicle came, :data:`NEVER` if it did not.
        reach_s: ``[N]`` from :func:`reach_times`.
        started_s: simulated time at which control began.
        steps, step_s: how many steps were played, and how long they are.
    """
    until_s = np.where(came == NEVER, steps, came) * step_s
    return np.maximum(until_s - np.maximum(reach_s - started_s, 0.0), 0.0)


def idle_rates(context: Context, road: RoadNet, traffic: Traffic, weights: KernelWeights) -> np.ndarray:
    """Return what each vehicle burns standing on its approach, ``[N]`` g/s; electric CVs burn nothing."""
    still = np.zeros(len(traffic), np.float32)
    grade_pct = (100.0 * road.grade[traffic.approach]).astype(np.float32)
    burning = (~(traffic.is_cv.astype(bool) & (context.engine == "electric"))).astype(np.uint8)
    rates = np.empty(len(traffic), np.float32)
    weather = (context.temperature_c, context.humidity_pct)
    emission_rate_kernel(still, still, grade_pct, traffic.moves_class, burning, *weather, weights, rates)
    return rates.astype(np.float64)
