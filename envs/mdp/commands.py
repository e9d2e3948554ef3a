"""From actions to commands for the simulator, in compiled code."""

from __future__ import annotations

import numpy as np

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE
from izoo.envs.tables import compiled
from izoo.networks.road import APPROACHING, INSIDE

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV on a lane that does not lead to its exit is left to its driver in the next step if that driver wanted to brake
harder than this: it is slowed to find a gap, and a command would override that."""
TOP_SPEED_MPS = 200.0 / 3.6
"""Maximum speed of an uncommanded vehicle: the default of its class, above all limits that nets have."""
_CAP_BRAKING_MPS2 = 1.5


@compiled
def plan_commands(world, base):  # type: ignore[no-untyped-def]
    """Write speed commands from accelerations; the other agents are left to the simulator's own driver.

    A CV inside the junction is always left to its driver, because none of SUMO's checks keeps a vehicle that is made to
    stop there from being hit from the side. So is a CV that its driver slows for a lane change (``yielding``). A
    command holds until the next one, so a command that repeats the last one, as in a queue, is not sent again.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`. Actions ``[A, 1]`` are in m/s^2; NaN counts as defer. Agents
            with ``acting`` below 0 have come since they were chosen.
        base: first row of the sums (:func:`~izoo.envs.mdp.slots.first_sums`).

    Returns:
        How many rows have a new command, how many are released, and how many have a new maximum speed: none.
    """
    tables, work, rules = world.tables, world.work, world.rules
    action, defer = tables.decision, tables.deferred
    commands, releases = 0, 0
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r < 0:
            continue
        vehicle = tables.vehicles[r]
        sums = tables.sums[base + vehicle.approach]
        sums.agent_steps += 1
        is_new = tables.acting[a] < 0
        is_nan = not is_new and np.isnan(action[a, 0])
        deferred = is_new or defer[a] != 0
        if is_nan:
            sums.nan_actions += 1
        inside = vehicle.location == INSIDE
        if not deferred and not is_nan:
            sums.lane_change_deferred += vehicle.yielding
            sums.junction_deferred += inside
        if is_nan or deferred or vehicle.yielding or inside:
            sums.deferred_steps += 1
            vehicle.deferred = 1
            if vehicle.commanded:
                vehicle.commanded = 0
                work.release[releases] = r
                releases += 1
        else:
            vehicle.deferred = 0
            accel = min(max(action[a, 0], ACTION_LOW_MPS2), ACTION_HIGH_MPS2)
            speed = max(vehicle.speed_mps + accel * rules.step_s, 0.0)
            if vehicle.commanded and speed == vehicle.target_mps:
                continue
            vehicle.commanded = 1
            vehicle.target_mps = speed
            work.command[commands] = r
            work.target_mps[commands] = speed
            commands += 1
    return commands, releases, 0


@compiled
def plan_caps(world, base):  # type: ignore[no-untyped-def]
    """Write maximum speeds and speed commands from desired speeds, which are shares of the speed limit.

    A vehicle no faster than its desired speed gets it as its maximum speed, and its own car-following does the rest. A
    faster one is first commanded down to it, gently: the simulator would brake as hard as it can for a maximum below
    the present speed, so the maximum is never set below it. Inside the junction, and while the driver slows for a lane
    change, no speed is commanded, as with accelerations. The limit is that of the road; behind the stop line that of
    the exit, whatever the lanes inside the junction allow.

    Args:
        world, base: as for :func:`plan_commands`. Actions ``[A, D]`` are shares of the limit, one for the whole way or
            one each before and behind the stop line; from 1 on the vehicle is uncommanded, and NaN counts as 1.

    Returns:
        How many rows have a new command, how many are released, and how many have a new maximum speed.
    """
    tables, work, rules = world.tables, world.work, world.rules
    action, defer = tables.decision, tables.deferred
    commands, releases, caps = 0, 0, 0
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r < 0:
            continue
        vehicle = tables.vehicles[r]
        sums = tables.sums[base + vehicle.approach]
        sums.agent_steps += 1
        before_line = vehicle.location == APPROACHING
        share = action[a, 0 if before_line else action.shape[1] - 1]
        is_new = tables.acting[a] < 0
        if not is_new and np.isnan(share):
            sums.nan_actions += 1
        free = is_new or defer[a] != 0 or not share < 1.0
        vehicle.deferred = free
        speed, max_speed, slowing = vehicle.speed_mps, TOP_SPEED_MPS, False
        if free:
            sums.deferred_steps += 1
        else:
            limit = world.exit_limit_mps[vehicle.exit]
            if before_line:
                limit = world.road.lanes[vehicle.region_lane].limit_mps
            max_speed = max(share, MIN_SHARE) * limit
            slowing = speed > max_speed
        if slowing and not vehicle.yielding and vehicle.location != INSIDE:
            slower = max(max_speed, speed - _CAP_BRAKING_MPS2 * rules.step_s)
            if not (vehicle.commanded and slower == vehicle.target_mps):
                vehicle.commanded = 1
                vehicle.target_mps = slower
                work.command[commands], work.target_mps[commands] = r, slower
                commands += 1
        elif vehicle.commanded:
            vehicle.commanded = 0
            work.release[releases] = r
            releases += 1
        if not slowing and max_speed != vehicle.cap_mps and not (max_speed == TOP_SPEED_MPS and vehicle.cap_mps == 0.0):
            vehicle.cap_mps = max_speed
            work.capped[caps], work.cap_mps[caps] = r, max_speed
            caps += 1
    return commands, releases, caps
