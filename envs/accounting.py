"""Compiled kernels for what a step costs and counts: commands, reward, and the sums behind the metrics.

Same tables and conventions as :mod:`izoo.envs.kernels`. The reward is a function of the vehicles' state after the step.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2
from izoo.envs.layout import (
    ACCEL,
    AGENT,
    APPROACH,
    COMMANDED,
    COUNTED,
    CROSSED,
    DEFERRED,
    EMISSION,
    ENTRY_M,
    EPISODE_METRIC,
    EXIT,
    IS_CV,
    JUNCTION_M,
    LOCATION,
    METRIC,
    MIN_TTC,
    PATH_POSITION,
    PREV_ACCEL,
    SPEED,
    SUM_ACCEL,
    SUM_EMISSION,
    SUM_JERK,
    SUM_STEPS,
    SUM_STOPPED,
    TARGET,
    TTC,
    TTC_CAP_S,
)
from izoo.networks.clock import RED
from izoo.networks.road import APPROACHING, INSIDE

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
_AGENT_STEPS = METRIC["agent_steps"]
_DEFERRED_STEPS = METRIC["deferred_steps"]
_NAN_ACTIONS = METRIC["nan_actions"]
_LANE_CHANGE_DEFERRED = METRIC["lane_change_deferred"]
_RED_CROSSINGS_CV = METRIC["red_crossings_cv"]
_RED_CROSSINGS_HDV = METRIC["red_crossings_hdv"]
_JUNCTION_DEFERRED = METRIC["junction_deferred"]
_UNSLOTTED_STEPS = METRIC["unslotted_steps"]
_STEPS = EPISODE_METRIC["steps"]
_RETURN = EPISODE_METRIC["return"]
_REWARD_SUM = EPISODE_METRIC["reward_sum"]
_EPISODE_AGENT_STEPS = EPISODE_METRIC["agent_steps"]
_EPISODE_VEHICLE_STEPS = EPISODE_METRIC["vehicle_steps"]
_STILL_S = EPISODE_METRIC["still_s"]
_GRIDLOCK = EPISODE_METRIC["gridlock"]


@njit(cache=True)
def plan_commands(agent_row, action, defer, yields, step_s, floats, ints, flags, sums, command, release, target):  # type: ignore[no-untyped-def]
    """Sort the agents into those whose speed is commanded and those left to SUMO.

    Inside the junction a CV always is left to SUMO: vehicles that are made to stand there are driven into from the
    side, which no check of SUMO's prevents. A command holds until the next one, so one that would repeat the last, as
    in a queue, is left out.

    Args:
        action: ``[A]`` m/s^2; NaN counts as defer.
        defer: ``[A]`` asked to be left to SUMO.
        yields: ``[C]`` rows that SUMO slows for a lane change.
        command, release: ``[A]`` outputs: rows with a new command, and rows that were commanded and no longer are.
        target: ``[A]`` output: speed in m/s for each commanded row.

    Returns:
        How many rows have a new command, and how many are released.
    """
    commands, releases = 0, 0
    for a in range(agent_row.shape[0]):
        r = agent_row[a]
        if r < 0:
            continue
        p = ints[r, APPROACH]
        sums[p, _AGENT_STEPS] += 1
        lost = np.isnan(action[a])
        asked = defer[a] != 0
        if lost:
            sums[p, _NAN_ACTIONS] += 1
        inside = ints[r, LOCATION] == INSIDE
        if not asked and not lost:
            sums[p, _LANE_CHANGE_DEFERRED] += yields[r]
            sums[p, _JUNCTION_DEFERRED] += inside
        if lost or asked or yields[r] or inside:
            sums[p, _DEFERRED_STEPS] += 1
            flags[r, DEFERRED] = 1
            if flags[r, COMMANDED]:
                flags[r, COMMANDED] = 0
                release[releases] = r
                releases += 1
        else:
            flags[r, DEFERRED] = 0
            accel = min(max(action[a], ACTION_LOW_MPS2), ACTION_HIGH_MPS2)
            speed = max(floats[r, SPEED] + accel * step_s, 0.0)
            if flags[r, COMMANDED] and speed == floats[r, TARGET]:
                continue
            flags[r, COMMANDED] = 1
            floats[r, TARGET] = speed
            command[commands] = r
            target[commands] = speed
            commands += 1
    return commands, releases


@njit(cache=True)
def account(rows, floats, ints, flags, colour_before, legal_before, step_s, sums):  # type: ignore[no-untyped-def]
    """Add the step to every vehicle's sums; book a vehicle's sums to its approach when it crosses the stop line.

    ``colour_before`` and ``legal_before`` ``[P, Q]`` are the signal in force during the step.
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
        on_red = colour_before[p, ints[r, EXIT]] == RED and not legal_before[p, ints[r, EXIT]]
        if counted:
            _book_crossing(r, p, floats, flags, step_s, on_red, sums)


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
def book_unfinished(rows, floats, ints, flags, sums):  # type: ignore[no-untyped-def]
    """Report, at the end, the counted vehicles that have not crossed."""
    for j in range(rows.shape[0]):
        r = rows[j]
        if flags[r, COUNTED] and not flags[r, CROSSED]:
            sums[ints[r, APPROACH], _UNFINISHED] += 1
            sums[ints[r, APPROACH], _UNFINISHED_EMISSION_G] += floats[r, SUM_EMISSION]


@njit(cache=True)
def reward_terms(rows, floats, tau_mps, soft_stop, terms, fleet):  # type: ignore[no-untyped-def]
    """Write the individual reward terms ``terms [C, 5]`` of ``rows`` and their mean ``fleet [5]``; return the TTC term.

    The columns are speed, stopped, emission, comfort and realism. The fleet means of an empty region are 0, and its
    time to collision is the cap.
    """
    fleet[:] = 0.0
    shortest = TTC_CAP_S
    n = rows.shape[0]
    for j in range(n):
        r = rows[j]
        v = floats[r, SPEED]
        stopped = 0.0
        if v < tau_mps:
            stopped = (tau_mps - v) / tau_mps if soft_stop else 1.0
        terms[r, 0] = v
        terms[r, 1] = stopped
        terms[r, 2] = floats[r, EMISSION]
        terms[r, 3] = -abs(floats[r, ACCEL])
        terms[r, 4] = -abs(floats[r, ACCEL] - floats[r, PREV_ACCEL])
        for c in range(5):
            fleet[c] += terms[r, c]
        shortest = min(shortest, floats[r, TTC])
    if n > 0:
        for c in range(5):
            fleet[c] /= n
    return shortest


@njit(cache=True)
def pay(acting_row, terms, fleet, shortest_ttc_s, weights, eta, safety, scale, reward, vector, empty):  # type: ignore[no-untyped-def]
    """Write ``reward [A]`` and ``vector [A, 11]`` for every slot that acted; slots that did not (row -1) get 0.

    A leaver's row still holds its last individual terms. In an empty region everybody's reward is 0.
    """
    for a in range(acting_row.shape[0]):
        r = acting_row[a]
        reward[a] = 0.0
        vector[a, :] = 0.0
        if r < 0 or empty:
            continue
        total = safety * shortest_ttc_s
        for c in range(5):
            total += weights[c] * (eta * fleet[c] + (1.0 - eta) * terms[r, c])
            vector[a, c] = terms[r, c]
            vector[a, 5 + c] = fleet[c]
        vector[a, 10] = shortest_ttc_s
        reward[a] = total / scale


@njit(cache=True)
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
