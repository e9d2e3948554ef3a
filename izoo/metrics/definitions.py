"""The numbers that an environment reports for an episode, and the scores derived from them.

An environment emits *sums and counts* (``("metrics", "approach", name)`` of shape ``[*B, P]``, one entry per incoming
approach), never means, so that they can be added over approaches and episodes without weights going wrong. Where an
episode is played out after its horizon, they are those of the horizon, but for the ``cohort`` ones, which go on to the
end. Means are
taken in one place, :mod:`izoo.metrics.scores`, and are NaN-free: a mean over nothing is reported as missing by its
mask.

A vehicle is *counted* unless it was in the controlled region during warm-up. It belongs to the approach it came from.
"""

from __future__ import annotations

APPROACH_METRICS: tuple[str, ...] = (
    "entered",  # counted vehicles that entered the controlled region
    "crossed",  # counted vehicles that crossed the stop line: the throughput
    "crossed_hdv",  # those of them that were human-driven
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
    "min_ttc_vehicles",  # how many those are
    "waiting",  # vehicles of this approach that still wait to enter the network at the end (spill-back)
    "collisions_cv",  # collisions whose rear vehicle is a CV
    "collisions_hdv",  # collisions whose rear vehicle is human-driven
    "agent_steps",  # steps of CVs that held an agent slot
    "deferred_steps",  # those of them left to SUMO: asked for, NaN action, slowed for a lane change, or inside
    "nan_actions",  # those of them whose action was NaN
    "lane_change_deferred",  # those of them left to SUMO because it slowed the CV for a lane change
    "junction_deferred",  # those of them left to SUMO because the CV was inside the junction
    "unslotted_steps",  # steps of CVs that found no free agent slot and were driven by IDM
    "red_crossings_cv",  # CVs that crossed the stop line on red where turning right on red is not legal
    "red_crossings_hdv",  # human-driven vehicles that did
    "due",  # vehicles whose departure was due by the end: dropped + waiting + outside + early + entered
    "dropped",  # those that the simulator dropped because they could not enter the network safely
    "outside",  # those under way to the region at the end
    "early",  # those that were in the region, or had left it, when the warm-up ended
    "cohort",  # vehicles that are scheduled to depart between warm-up and horizon: the same ones under every policy
    "cohort_left",  # those of them that had left the region when the episode ended
    "cohort_region_co2_g",  # what the cohort burned in the region: approach, junction and exit
    "cohort_blocked_co2_g",  # what it would have burned standing outside, while blocked
    "cohort_region_delay_s",  # time that it lost in the region against driving at the limit
    "cohort_blocked_s",  # time for which it was blocked outside: it could have come, at the limit, and had not
)
"""Names of the per-approach sums and counts, in the order in which the simulator core stores them."""

DEMAND: tuple[str, ...] = ("dropped", "waiting", "outside", "entered")
"""The parts of the demand of the measured time, by approach: every vehicle that was due, but for the early ones."""

KEPT_OUT: tuple[str, ...] = ("waiting", "outside")
"""Those of them that have not come to the region yet: what they burn is not counted."""

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
