"""What a step adds to the sums behind the metrics, in compiled code; see :mod:`izoo.metrics.definitions`."""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.frame import EPISODE_METRIC, METRIC
from izoo.envs.mdp.reward import TTC_CAP_S
from izoo.envs.mdp.state import (
    ACCEL,
    AGENT,
    APPROACH,
    COHORT,
    COUNTED,
    CROSSED,
    DELAY,
    EMISSION,
    ENTRY_M,
    EXIT,
    IS_CV,
    JUNCTION_M,
    LOCATION,
    MIN_TTC,
    PATH_POSITION,
    PREV_ACCEL,
    SPEED,
    SUM_ACCEL,
    SUM_EMISSION,
    SUM_JERK,
    SUM_STEPS,
    SUM_STOPPED,
    TTC,
)
from izoo.networks.clock import RED
from izoo.networks.road import APPROACHING

GRIDLOCK_S = 180.0
"""The region is in gridlock when none of its vehicles has moved for this long."""
MOVING_MPS = 0.1
STOPPED_MPS = 1.0
"""A vehicle slower than this is stopped, in the metrics (the reward has its own ``tau_mps``, equal by default)."""

_ENTERED = METRIC["entered"]
_CROSSED = METRIC["crossed"]
_CROSSED_HDV = METRIC["crossed_hdv"]
_EMISSION_G = METRIC["emission_g"]
_EMISSION_HDV_G = METRIC["emission_hdv_g"]
_REGION_EMISSION_G = METRIC["region_emission_g"]
_UNFINISHED = METRIC["unfinished"]
_UNFINISHED_EMISSION_G = METRIC["unfinished_emission_g"]
_VEHICLE_STEPS = METRIC["vehicle_steps"]
_TRAVEL_TIME_S = METRIC["travel_time_s"]
_REGION_TIME_S = METRIC["region_time_s"]
_DISTANCE_M = METRIC["distance_m"]
_STOPPED_TIME_S = METRIC["stopped_time_s"]
_ABS_ACCEL = METRIC["abs_accel_sum"]
_ABS_JERK = METRIC["abs_jerk_sum"]
_MIN_TTC_SUM_S = METRIC["min_ttc_sum_s"]
_MIN_TTC_VEHICLES = METRIC["min_ttc_vehicles"]
_RED_CROSSINGS_CV = METRIC["red_crossings_cv"]
_RED_CROSSINGS_HDV = METRIC["red_crossings_hdv"]
_UNSLOTTED_STEPS = METRIC["unslotted_steps"]
_COHORT_CO2_G = METRIC["cohort_region_co2_g"]
_COHORT_DELAY_S = METRIC["cohort_region_delay_s"]
_STEPS = EPISODE_METRIC["steps"]
_RETURN = EPISODE_METRIC["return"]
_REWARD_SUM = EPISODE_METRIC["reward_sum"]
_EPISODE_AGENT_STEPS = EPISODE_METRIC["agent_steps"]
_EPISODE_VEHICLE_STEPS = EPISODE_METRIC["vehicle_steps"]
_STILL_S = EPISODE_METRIC["still_s"]
_GRIDLOCK = EPISODE_METRIC["gridlock"]


@compiled(borrows=True)
def account(rows, floats, ints, flags, colour, legal, step_s, sums):  # type: ignore[no-untyped-def]
    """Add the step to every vehicle's sums; book a vehicle's sums to its approach when it crosses the stop line.

    ``colour`` and ``legal`` ``[P, Q]`` are the signal that vehicles drove by in the step.
    """
    for j in range(rows.shape[0]):
        r = rows[j]
        p = ints[r, APPROACH]
        counted = flags[r, COUNTED]
        if counted:
            sums[p, _REGION_EMISSION_G] += floats[r, EMISSION]
            sums[p, _REGION_TIME_S] += step_s
        if flags[r, CROSSED]:
            continue
        floats[r, SUM_EMISSION] += floats[r, EMISSION]
        floats[r, SUM_STEPS] += 1
        floats[r, SUM_STOPPED] += floats[r, SPEED] < STOPPED_MPS
        floats[r, SUM_ACCEL] += abs(floats[r, ACCEL])
        floats[r, SUM_JERK] += abs(floats[r, ACCEL] - floats[r, PREV_ACCEL]) / step_s
        floats[r, MIN_TTC] = min(floats[r, MIN_TTC], floats[r, TTC])
        if ints[r, LOCATION] == APPROACHING:
            continue
        flags[r, CROSSED] = 1
        on_red = colour[p, ints[r, EXIT]] == RED and not legal[p, ints[r, EXIT]]
        if counted:
            _book_crossing(r, p, floats, flags, step_s, on_red, sums)


@compiled(borrows=True)
def account_cohort(rows, floats, ints, flags, sums):  # type: ignore[no-untyped-def]
    """Add what the cohort burned and lost in the step, which is counted until an episode's end."""
    for j in range(rows.shape[0]):
        r = rows[j]
        if flags[r, COHORT]:
            sums[ints[r, APPROACH], _COHORT_CO2_G] += floats[r, EMISSION]
            sums[ints[r, APPROACH], _COHORT_DELAY_S] += floats[r, DELAY]


@compiled(borrows=True)
def _book_crossing(r, p, floats, flags, step_s, on_red, sums):  # type: ignore[no-untyped-def]
    sums[p, _CROSSED] += 1
    sums[p, _EMISSION_G] += floats[r, SUM_EMISSION]
    sums[p, _VEHICLE_STEPS] += floats[r, SUM_STEPS]
    sums[p, _TRAVEL_TIME_S] += floats[r, SUM_STEPS] * step_s
    sums[p, _DISTANCE_M] += floats[r, PATH_POSITION] - floats[r, ENTRY_M]
    sums[p, _STOPPED_TIME_S] += floats[r, SUM_STOPPED] * step_s
    sums[p, _ABS_ACCEL] += floats[r, SUM_ACCEL]
    sums[p, _ABS_JERK] += floats[r, SUM_JERK]
    if floats[r, MIN_TTC] < np.inf:
        sums[p, _MIN_TTC_SUM_S] += min(floats[r, MIN_TTC], TTC_CAP_S)
        sums[p, _MIN_TTC_VEHICLES] += 1
    if flags[r, IS_CV]:
        sums[p, _RED_CROSSINGS_CV] += on_red
    else:
        sums[p, _RED_CROSSINGS_HDV] += on_red
        sums[p, _CROSSED_HDV] += 1
        sums[p, _EMISSION_HDV_G] += floats[r, SUM_EMISSION]


@compiled(borrows=True)
def book_entry(r, floats, ints, flags, sums):  # type: ignore[no-untyped-def]
    """Start the sums of a vehicle that has just been given row ``r``."""
    floats[r, SUM_EMISSION] = 0.0
    floats[r, SUM_STEPS] = 0.0
    floats[r, SUM_STOPPED] = 0.0
    floats[r, SUM_ACCEL] = 0.0
    floats[r, SUM_JERK] = 0.0
    floats[r, JUNCTION_M] = 0.0
    floats[r, MIN_TTC] = np.inf
    if flags[r, COUNTED]:
        sums[ints[r, APPROACH], _ENTERED] += 1


@compiled(borrows=True)
def book_unfinished(rows, floats, ints, flags, sums):  # type: ignore[no-untyped-def]
    """Report, at the horizon, the counted vehicles that have not crossed."""
    for j in range(rows.shape[0]):
        r = rows[j]
        if flags[r, COUNTED] and not flags[r, CROSSED]:
            sums[ints[r, APPROACH], _UNFINISHED] += 1
            sums[ints[r, APPROACH], _UNFINISHED_EMISSION_G] += floats[r, SUM_EMISSION]


@compiled(borrows=True)
def sum_episode(rows, acting_row, floats, ints, flags, reward, step_s, sums, episode):  # type: ignore[no-untyped-def]
    """Add the step to the episode's numbers ``episode [E]``, and CVs without a slot to their approach."""
    agents, total, fastest = 0, 0.0, 0.0
    for a in range(acting_row.shape[0]):
        if acting_row[a] >= 0:
            agents += 1
            total += reward[a]
    for j in range(rows.shape[0]):
        r = rows[j]
        fastest = max(fastest, floats[r, SPEED])
        if flags[r, IS_CV] and ints[r, AGENT] < 0:
            sums[ints[r, APPROACH], _UNSLOTTED_STEPS] += 1
    episode[_STEPS] += 1
    episode[_REWARD_SUM] += total
    episode[_EPISODE_AGENT_STEPS] += agents
    episode[_EPISODE_VEHICLE_STEPS] += rows.shape[0]
    if agents:
        episode[_RETURN] += total / agents
    episode[_STILL_S] = episode[_STILL_S] + step_s if rows.shape[0] and fastest < MOVING_MPS else 0.0
    if episode[_STILL_S] >= GRIDLOCK_S:
        episode[_GRIDLOCK] = 1.0
