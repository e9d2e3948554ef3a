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
from izoo.networks.turning import LEFT, RIGHT, STRAIGHT

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

Sums = np.dtype([(name, "f8") for name in APPROACH_METRICS])
EpisodeSums = np.dtype([("episode_return" if name == "return" else name, "f8") for name in EPISODE_METRICS])
"""The same as records: ``sums[p].crossed`` of approach ``p``, and ``episode.steps``."""

GRIDLOCK_S = 180.0
"""The region is in gridlock when none of its vehicles has moved for this long."""
MOVING_MPS = 0.1
STOPPED_MPS = 1.0
"""A vehicle slower than this is stopped, in the metrics (the reward has its own ``tau_mps``, equal by default)."""


@compiled
def accumulate_step(world, phase, base):  # type: ignore[no-untyped-def]
    """Add the step to every vehicle's sums, and a vehicle's sums to its approach's when it crosses the stop line.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        phase: of the signal, in force during the step.
        base: first row of the sums (:func:`~izoo.envs.mdp.slots.first_sums`).
    """
    tables, step_s = world.tables, world.rules.step_s
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        sums = tables.sums[base + vehicle.approach]
        counted = vehicle.counted
        if counted:
            sums.region_emission_g += vehicle.emission_g
            sums.region_time_s += step_s
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
            _record_crossing(vehicle, sums, step_s, shown.colour == RED and not shown.legal_on_red)


@compiled
def accumulate_cohort(tables):  # type: ignore[no-untyped-def]
    """Add the cohort's CO2 and delay of the step, which are counted until the episode ends."""
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.cohort:
            sums = tables.sums[vehicle.approach]
            sums.cohort_region_co2_g += vehicle.emission_g
            sums.cohort_region_delay_s += vehicle.delay_s
            if vehicle.movement == RIGHT:
                sums.right_cohort_region_delay_s += vehicle.delay_s
            elif vehicle.movement == STRAIGHT:
                sums.straight_cohort_region_delay_s += vehicle.delay_s
            else:
                sums.left_cohort_region_delay_s += vehicle.delay_s


@compiled
def count_queues(tables, base):  # type: ignore[no-untyped-def]
    """Count the vehicles that stand before the stop line, by movement."""
    rows = range(base, base + tables.sums.shape[0] // 2)
    for p in rows:
        tables.sums[p].right_queue = tables.sums[p].straight_queue = tables.sums[p].left_queue = 0.0
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.location == APPROACHING and vehicle.speed_mps < STOPPED_MPS:
            sums = tables.sums[base + vehicle.approach]
            sums.right_queue += vehicle.movement == RIGHT
            sums.straight_queue += vehicle.movement == STRAIGHT
            sums.left_queue += vehicle.movement == LEFT
    for p in rows:
        sums = tables.sums[p]
        sums.right_queue_max = max(sums.right_queue_max, sums.right_queue)
        sums.straight_queue_max = max(sums.straight_queue_max, sums.straight_queue)
        sums.left_queue_max = max(sums.left_queue_max, sums.left_queue)


@compiled
def _record_crossing(vehicle, sums, step_s, on_red):  # type: ignore[no-untyped-def]
    sums.crossed += 1
    sums.emission_g += vehicle.sum_emission_g
    sums.vehicle_steps += vehicle.sum_steps
    sums.travel_time_s += vehicle.sum_steps * step_s
    sums.distance_m += vehicle.path_position_m - vehicle.entry_m
    sums.stopped_time_s += vehicle.sum_stopped_steps * step_s
    sums.abs_accel_sum += vehicle.sum_abs_accel
    sums.abs_jerk_sum += vehicle.sum_abs_jerk
    if vehicle.min_ttc_s < np.inf:
        sums.min_ttc_sum_s += min(vehicle.min_ttc_s, TTC_CAP_S)
        sums.min_ttc_vehicles += 1
    if vehicle.is_cv:
        sums.red_crossings_cv += on_red
    else:
        sums.red_crossings_hdv += on_red
        sums.crossed_hdv += 1
        sums.emission_hdv_g += vehicle.sum_emission_g


@compiled
def record_entry(vehicle, sums):  # type: ignore[no-untyped-def]
    """Reset the sums of a vehicle that has just been given its row, and count its entry."""
    vehicle.sum_emission_g = 0.0
    vehicle.sum_steps = 0.0
    vehicle.sum_stopped_steps = 0.0
    vehicle.sum_abs_accel = 0.0
    vehicle.sum_abs_jerk = 0.0
    vehicle.junction_m = 0.0
    vehicle.min_ttc_s = np.inf
    if vehicle.counted:
        sums.entered += 1


@compiled
def record_unfinished(tables):  # type: ignore[no-untyped-def]
    """Add the counted vehicles that have not crossed by the horizon."""
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.counted and not vehicle.crossed:
            tables.sums[vehicle.approach].unfinished += 1
            tables.sums[vehicle.approach].unfinished_emission_g += vehicle.sum_emission_g


@compiled
def accumulate_episode(tables, reward, step_s, base):  # type: ignore[no-untyped-def]
    """Add the step to the episode's sums ``tables.episode``, and CVs without a slot to those of their approach."""
    episode, count = tables.episode, tables.cursor.members
    agents, total, fastest = 0, 0.0, 0.0
    for a in range(tables.acting.shape[0]):
        if tables.acting[a] >= 0:
            agents += 1
            total += reward[a]
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        fastest = max(fastest, vehicle.speed_mps)
        if vehicle.is_cv and vehicle.agent < 0:
            tables.sums[base + vehicle.approach].unslotted_steps += 1
    episode.steps += 1
    episode.reward_sum += total
    episode.agent_steps += agents
    episode.vehicle_steps += count
    if agents:
        episode.episode_return += total / agents
    episode.still_s = episode.still_s + step_s if count and fastest < MOVING_MPS else 0.0
    if episode.still_s >= GRIDLOCK_S:
        episode.gridlock = 1.0
