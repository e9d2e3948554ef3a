"""From actions to what the simulator is told, in compiled code."""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE
from izoo.envs.mdp.columns import (
    APPROACH,
    CAP,
    COMMANDED,
    DEFERRED,
    EXIT,
    LOCATION,
    REGION_LANE,
    SPEED,
    TARGET,
    YIELDING,
)
from izoo.envs.mdp.metric_sums import METRIC
from izoo.networks.road import APPROACHING, INSIDE

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV is left to its driver while it is on a lane that does not lead to its exit and that driver itself braked it
harder than this in the last step: it is slowed to find a gap, and a command would override that."""
TOP_SPEED_MPS = 200.0 / 3.6
"""The maximum speed of every vehicle that is left alone: the default of its class, above all limits that nets have."""
_CAP_BRAKING_MPS2 = 1.5
_AGENT_STEPS = METRIC["agent_steps"]
_DEFERRED_STEPS = METRIC["deferred_steps"]
_NAN_ACTIONS = METRIC["nan_actions"]
_LANE_CHANGE_DEFERRED = METRIC["lane_change_deferred"]
_JUNCTION_DEFERRED = METRIC["junction_deferred"]


@compiled(borrows=True)
def plan_commands(agent_row, acting, action, defer, step_s, floats, ints, flags, sums, command, release, target):  # type: ignore[no-untyped-def]
    """Sort the agents into those whose speed is commanded and those left to the simulator's own driver.

    A CV inside the junction is always left to its driver: vehicles that are made to stand there are hit from the side,
    which none of SUMO's checks prevents. So is one that the driver slows for a lane change (``YIELDING``). A command
    holds until the next one, so one that would repeat the last, as in a queue, is left out.

    Args:
        agent_row: ``[A]`` rows of the agents, below 0 in empty slots.
        acting: ``[A]`` the same for those whom the actions are for; others have come since they were chosen.
        action: ``[A, 1]`` m/s^2; NaN counts as defer.
        defer: ``[A]`` asked to be left to their own driver.
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
        newcomer = acting[a] < 0
        lost = not newcomer and np.isnan(action[a, 0])
        asked = newcomer or defer[a] != 0
        if lost:
            sums[p, _NAN_ACTIONS] += 1
        inside = ints[r, LOCATION] == INSIDE
        if not asked and not lost:
            sums[p, _LANE_CHANGE_DEFERRED] += flags[r, YIELDING]
            sums[p, _JUNCTION_DEFERRED] += inside
        if lost or asked or flags[r, YIELDING] or inside:
            sums[p, _DEFERRED_STEPS] += 1
            flags[r, DEFERRED] = 1
            if flags[r, COMMANDED]:
                flags[r, COMMANDED] = 0
                release[releases] = r
                releases += 1
        else:
            flags[r, DEFERRED] = 0
            accel = min(max(action[a, 0], ACTION_LOW_MPS2), ACTION_HIGH_MPS2)
            speed = max(floats[r, SPEED] + accel * step_s, 0.0)
            if flags[r, COMMANDED] and speed == floats[r, TARGET]:
                continue
            flags[r, COMMANDED] = 1
            floats[r, TARGET] = speed
            command[commands] = r
            target[commands] = speed
            commands += 1
    return commands, releases


@compiled(borrows=True)
def plan_caps(  # type: ignore[no-untyped-def]
    agent_row, acting, action, defer, step_s, road, exit_limit, floats, ints, flags, sums, command, release, target,
    capped, cap,
):  # fmt: skip
    """Sort the agents by what their desired speeds, as shares of the limit, ask of the simulator.

    A vehicle that is no faster than its desired speed is given that as its maximum speed, and its own car-following
    does the rest; one that is faster is commanded down to it first, gently. It would brake by itself as hard as it can
    for a maximum speed below its own, so the maximum is never lowered below the speed. Inside the junction, and
    while it makes room for a lane change, it is left to its driver, as with accelerations. The limit is that of the
    road: behind the stop line that of the exit, whatever the lanes inside the junction allow.

    Args:
        agent_row, acting, defer, command, release, target: as for :func:`plan_commands`.
        action: ``[A, D]`` shares of the limit, one for all the way or one each before and behind the stop line; from 1
            on the vehicle is left alone, and NaN counts as 1.
        road: the region's lanes.
        exit_limit: ``[Q]`` m/s.
        capped, cap: ``[A]`` outputs: rows with a new maximum speed, and the speeds in m/s.

    Returns:
        How many rows have a new command, how many are released, and how many have a new maximum speed.
    """
    commands, releases, caps = 0, 0, 0
    for a in range(agent_row.shape[0]):
        r = agent_row[a]
        if r < 0:
            continue
        p = ints[r, APPROACH]
        sums[p, _AGENT_STEPS] += 1
        before = ints[r, LOCATION] == APPROACHING
        share = action[a, 0 if before else action.shape[1] - 1]
        newcomer = acting[a] < 0
        if not newcomer and np.isnan(share):
            sums[p, _NAN_ACTIONS] += 1
        free = newcomer or defer[a] != 0 or not share < 1.0
        flags[r, DEFERRED] = free
        speed, most, slowing = floats[r, SPEED], TOP_SPEED_MPS, False
        if free:
            sums[p, _DEFERRED_STEPS] += 1
        else:
            limit = road.lane_limit_mps[ints[r, REGION_LANE]] if before else exit_limit[ints[r, EXIT]]
            most = max(share, MIN_SHARE) * limit
            slowing = speed > most
        if slowing and not flags[r, YIELDING] and ints[r, LOCATION] != INSIDE:
            slower = max(most, speed - _CAP_BRAKING_MPS2 * step_s)
            if not (flags[r, COMMANDED] and slower == floats[r, TARGET]):
                flags[r, COMMANDED] = 1
                floats[r, TARGET] = slower
                command[commands], target[commands] = r, slower
                commands += 1
        elif flags[r, COMMANDED]:
            flags[r, COMMANDED] = 0
            release[releases] = r
            releases += 1
        if not slowing and most != floats[r, CAP] and not (most == TOP_SPEED_MPS and floats[r, CAP] == 0.0):
            floats[r, CAP] = most
            capped[caps], cap[caps] = r, most
            caps += 1
    return commands, releases, caps
