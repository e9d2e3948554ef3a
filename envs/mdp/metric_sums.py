"""The sums and counts that an environment reports for an episode, and their update in a step, in compiled code.

An environment emits *sums and counts* (``("metrics", "approach", name)`` of shape ``[*B, P]``, one entry per incoming
approach), never means, so that they can be added over approaches and episodes without weights going wrong. Figures are
computed from them in one place, :mod:`izoo.metrics.figures`. Where an episode is played out after its horizon, sums
stop at the horizon, except those of the ``cohort``, which go on to the end.

A vehicle is *counted* unless it was in the controlled region during warm-up. It belongs to the approach it came from.
"""

from __future__ import annotations

import numpy as np

from izoo.envs.mdp.reward import TTC_CAP_S
from izoo.envs.tables import compiled
from izoo.networks.clock import RED
from izoo.networks.road import APPROACHING

MOVEMENTS = ("right", "straight", "left")
"""The movements of an approach, by the value of ``("vehicles", "movement")``."""
OF_COHORT = ("cohort", "cohort_region_delay_s", "cohort_blocked_s")
"""Sums over the cohort that are also kept by movement."""
MOVEMENT_METRICS: tuple[str, ...] = tuple(
    f"{movement}_{name}"
    for name in (
        *OF_COHORT,
        "queue",  # vehicles that stand on the approach, at the end: the residual queue
        "queue_max",  # the most that have stood there at once, which is not to be added over approaches
    )
    for movement in MOVEMENTS
)
"""Names of the sums and counts by movement, ``MOVEMENT_NAME``."""

APPROACH_METRICS: tuple[str, ...] = (
    "entered",  # counted vehicles that entered the controlled region
    "crossed",  # counted vehicles that crossed the stop line: the throughput
    "crossed_hdv",  # human-driven vehicles among them
    "emission_g",  # CO2 from entering to crossing, over counted vehicles that crossed
    "emission_hdv_g",  # the same over human-driven vehicles alone
    "region_emission_g",  # CO2 of all counted vehicles over the whole region, crossed or not
    "unfinished",  # counted vehicles that had not crossed at the end
    "unfinished_emission_g",  # their CO2
    "vehicle_steps",  # steps from entering to crossing, over counted vehicles that crossed
    "travel_time_s",  # the same in seconds
    "region_time_s",  # seconds in the region, over all counted vehicles
    "distance_m",  # metres driven from entering to crossing, over counted vehicles that crossed
    "stopped_time_s",  # seconds below 1 m/s from entering to crossing, over counted vehicles that crossed
    "abs_accel_sum",  # sum of |a| in m/s^2 over steps from entering to crossing (comfort)
    "abs_jerk_sum",  # sum of |a_t - a_{t-1}| / dt in m/s^3 over the same steps
    "min_ttc_sum_s",  # minimum time to collision, at most 10 s, summed over crossed vehicles that ever closed in
    "min_ttc_vehicles",  # number of these vehicles
    "waiting",  # vehicles of this approach that still wait to enter the network at the end (spill-back)
    "collisions_cv",  # collisions whose rear vehicle is a CV
    "collisions_hdv",  # collisions whose rear vehicle is human-driven
    "agent_steps",  # steps of CVs that held an agent slot
    "deferred_steps",  # those left to the driver: on request, NaN action, slowed for a lane change, or inside
    "nan_actions",  # those with a NaN action
    "lane_change_deferred",  # those left to the driver because it slowed for a lane change
    "junction_deferred",  # those left to the driver because the CV was inside the junction
    "unslotted_steps",  # steps of CVs that found no free agent slot and were driven by IDM
    "red_crossings_cv",  # CVs that crossed the stop line on red where turning right on red is not legal
    "red_crossings_hdv",  # human-driven vehicles that did
    "due",  # vehicles whose departure was due by the end: dropped + waiting + outside + early + entered
    "dropped",  # those dropped by the simulator because they could not enter the network safely
    "outside",  # those in the network, but not yet in the region at the end
    "early",  # those that were in the region, or had left it, when the warm-up ended
    "cohort",  # vehicles scheduled to depart between warm-up and horizon: the same under every policy
    "cohort_left",  # those that had left the region when the episode ended
    "cohort_region_co2_g",  # CO2 of the cohort in the region: approach, junction and exit
    "cohort_blocked_co2_g",  # CO2 of idling outside for the time for which it was blocked
    "cohort_region_delay_s",  # delay in the region against driving at the limit
    "cohort_blocked_s",  # time blocked outside: could have arrived at the limit, and had not
    *MOVEMENT_METRICS,
)
"""Names of the per-approach sums and counts, in the order in which the simulator core stores them."""

EPISODE_METRICS: tuple[str, ...] = (
    "steps",  # control steps since warm-up
    "return",  # mean over agent-steps of the reward, summed over the episode (see the environment's docstring)
    "reward_sum",  # sum of the reward over all valid agent-steps
    "agent_steps",  # valid agent-steps
    "unslotted",  # CVs that found no free agent slot
    "collisions",  # all collisions in the controlled region
    "still_s",  # for how long, until now, no vehicle of a non-empty region has moved
    "gridlock",  # 1 if no vehicle of a non-empty region moved for 180 s or longer
    "vehicle_steps",  # vehicles in the region, summed over steps
)
"""Names of the per-episode numbers ``("metrics", "episode", name)`` of shape ``[*B, 1]``."""

METRIC = {name: column for column, name in enumerate(APPROACH_METRICS)}
EPISODE_METRIC = {name: column for column, name in enumerate(EPISODE_METRICS)}

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
_MOVEMENT_DELAY_S = METRIC["right_cohort_region_delay_s"]
_QUEUE, _QUEUE_MAX = METRIC["right_queue"], METRIC["right_queue_max"]
_NUM_MOVEMENTS = len(MOVEMENTS)
_STEPS = EPISODE_METRIC["steps"]
_RETURN = EPISODE_METRIC["return"]
_REWARD_SUM = EPISODE_METRIC["reward_sum"]
_EPISODE_AGENT_STEPS = EPISODE_METRIC["agent_steps"]
_EPISODE_VEHICLE_STEPS = EPISODE_METRIC["vehicle_steps"]
_STILL_S = EPISODE_METRIC["still_s"]
_GRIDLOCK = EPISODE_METRIC["gridlock"]


@compiled
def accumulate_step(world, phase, base):  # type: ignore[no-untyped-def]
    """Add the step to every vehicle's sums, and a vehicle's sums to its approach's when it crosses the stop line.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        phase: of the signal, in force during the step.
        base: first row of the sums (:func:`~izoo.envs.mdp.slots.first_sums`).
    """
    tables, step_s = world.tables, world.rules.step_s
    sums = tables.sums
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        p = base + vehicle.approach
        counted = vehicle.counted
        if counted:
            sums[p, _REGION_EMISSION_G] += vehicle.emission_g
            sums[p, _REGION_TIME_S] += step_s
        if vehicle.crossed:
            continue
        vehicle.sum_emission_g += vehicle.emission_g
        vehicle.sum_steps += 1
        vehicle.sum_stopped_steps += vehicle.speed_mps < STOPPED_MPS
        vehicle.sum_abs_accel += abs(vehicle.accel_mps2)
        vehicle.sum_abs_jerk += abs(vehicle.accel_mps2 - vehicle.prev_accel_mps2) / step_s
        vehicle.min_ttc_s = min(vehicle.min_ttc_s, vehicle.ttc_s)
        if vehicle.location == APPROACHING:
            continue
        vehicle.crossed = 1
        shown = world.clock.shown[vehicle.approach * tables.signal.shape[1] + vehicle.exit, phase]
        if counted:
            _record_crossing(vehicle, p, step_s, shown.colour == RED and not shown.legal_on_red, sums)


@compiled
def accumulate_cohort(tables):  # type: ignore[no-untyped-def]
    """Add the cohort's CO2 and delay of the step, which are counted until the episode ends."""
    sums = tables.sums
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.cohort:
            sums[vehicle.approach, _COHORT_CO2_G] += vehicle.emission_g
            sums[vehicle.approach, _COHORT_DELAY_S] += vehicle.delay_s
            sums[vehicle.approach, _MOVEMENT_DELAY_S + vehicle.movement] += vehicle.delay_s


@compiled
def count_queues(tables, base):  # type: ignore[no-untyped-def]
    """Count the vehicles that stand before the stop line, by movement."""
    sums = tables.sums
    rows = range(base, base + sums.shape[0] // 2)
    for p in rows:
        for m in range(_NUM_MOVEMENTS):
            sums[p, _QUEUE + m] = 0.0
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.location == APPROACHING and vehicle.speed_mps < STOPPED_MPS:
            sums[base + vehicle.approach, _QUEUE + vehicle.movement] += 1
    for p in rows:
        for m in range(_NUM_MOVEMENTS):
            sums[p, _QUEUE_MAX + m] = max(sums[p, _QUEUE_MAX + m], sums[p, _QUEUE + m])


@compiled
def _record_crossing(vehicle, p, step_s, on_red, sums):  # type: ignore[no-untyped-def]
    sums[p, _CROSSED] += 1
    sums[p, _EMISSION_G] += vehicle.sum_emission_g
    sums[p, _VEHICLE_STEPS] += vehicle.sum_steps
    sums[p, _TRAVEL_TIME_S] += vehicle.sum_steps * step_s
    sums[p, _DISTANCE_M] += vehicle.path_position_m - vehicle.entry_m
    sums[p, _STOPPED_TIME_S] += vehicle.sum_stopped_steps * step_s
    sums[p, _ABS_ACCEL] += vehicle.sum_abs_accel
    sums[p, _ABS_JERK] += vehicle.sum_abs_jerk
    if vehicle.min_ttc_s < np.inf:
        sums[p, _MIN_TTC_SUM_S] += min(vehicle.min_ttc_s, TTC_CAP_S)
        sums[p, _MIN_TTC_VEHICLES] += 1
    if vehicle.is_cv:
        sums[p, _RED_CROSSINGS_CV] += on_red
    else:
        sums[p, _RED_CROSSINGS_HDV] += on_red
        sums[p, _CROSSED_HDV] += 1
        sums[p, _EMISSION_HDV_G] += vehicle.sum_emission_g


@compiled
def record_entry(vehicle, base, sums):  # type: ignore[no-untyped-def]
    """Reset the sums of a vehicle that has just been given its row, and count its entry."""
    vehicle.sum_emission_g = 0.0
    vehicle.sum_steps = 0.0
    vehicle.sum_stopped_steps = 0.0
    vehicle.sum_abs_accel = 0.0
    vehicle.sum_abs_jerk = 0.0
    vehicle.junction_m = 0.0
    vehicle.min_ttc_s = np.inf
    if vehicle.counted:
        sums[base + vehicle.approach, _ENTERED] += 1


@compiled
def record_unfinished(tables):  # type: ignore[no-untyped-def]
    """Add the counted vehicles that have not crossed by the horizon."""
    sums = tables.sums
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.counted and not vehicle.crossed:
            sums[vehicle.approach, _UNFINISHED] += 1
            sums[vehicle.approach, _UNFINISHED_EMISSION_G] += vehicle.sum_emission_g


@compiled
def accumulate_episode(tables, reward, step_s, base):  # type: ignore[no-untyped-def]
    """Add the step to the episode's sums ``tables.episode``, and CVs without a slot to those of their approach."""
    episode, sums, count = tables.episode, tables.sums, tables.cursor.members
    agents, total, fastest = 0, 0.0, 0.0
    for a in range(tables.acting.shape[0]):
        if tables.acting[a] >= 0:
            agents += 1
            total += reward[a]
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        fastest = max(fastest, vehicle.speed_mps)
        if vehicle.is_cv and vehicle.agent < 0:
            sums[base + vehicle.approach, _UNSLOTTED_STEPS] += 1
    episode[_STEPS] += 1
    episode[_REWARD_SUM] += total
    episode[_EPISODE_AGENT_STEPS] += agents
    episode[_EPISODE_VEHICLE_STEPS] += count
    if agents:
        episode[_RETURN] += total / agents
    episode[_STILL_S] = episode[_STILL_S] + step_s if count and fastest < MOVING_MPS else 0.0
    if episode[_STILL_S] >= GRIDLOCK_S:
        episode[_GRIDLOCK] = 1.0
