"""Who is held up outside of the region, for how long, and what that costs: so that a policy gains nothing by it.

CO2 is counted inside the region, so whoever makes others wait before it would seem to save what they burn there. Nobody
sees these vehicles in detail; what they burn is counted as if they stood with their engines running.
"""

from __future__ import annotations

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.envs.mdp.units import reach_times
from izoo.envs.mdp.world import NEVER
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic


def held_up_s(
    came: np.ndarray, road: RoadNet, traffic: Traffic, started_s: float, steps: int, step_s: float
) -> np.ndarray:
    """Return how long each vehicle was held up since control began, ``[N]`` s.

    Held up is who could have come to the region, at the limit, and has not: on its way, waiting to enter the network,
    or dropped by the simulator. What the signals upstream take is part of it, and the same whoever drives.

    Args:
        came: ``[N]`` steps of control that had been played when the vehicle came, :data:`NEVER` if it did not.
        started_s: simulated time at which control began.
        steps, step_s: how many steps were played, and how long they are.
    """
    until_s = np.where(came == NEVER, steps, came) * step_s
    return np.maximum(until_s - np.maximum(reach_times(road, traffic) - started_s, 0.0), 0.0)


def idle_rates(context: Context, road: RoadNet, traffic: Traffic, weights: KernelWeights) -> np.ndarray:
    """Return what each vehicle burns standing on its approach, ``[N]`` g/s; electric CVs burn nothing."""
    still = np.zeros(len(traffic), np.float32)
    grade_pct = (100.0 * road.grade[traffic.approach]).astype(np.float32)
    burning = (~(traffic.is_cv.astype(bool) & (context.engine == "electric"))).astype(np.uint8)
    rates = np.empty(len(traffic), np.float32)
    weather = (context.temperature_c, context.humidity_pct)
    emission_rate_kernel(still, still, grade_pct, traffic.moves_class, burning, *weather, weights, rates)
    return rates.astype(np.float64)
