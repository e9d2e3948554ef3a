"""From actions to commands for the simulator, in compiled code."""

from __future__ import annotations

import numpy as np

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE
from izoo.envs.tables import compiled
from izoo.networks.clock import GREEN, NEVER_S, RED
from izoo.networks.road import APPROACHING, INSIDE

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV on a lane that does not lead to its exit is left to its driver in the next step if that driver wanted to brake
harder than this: it is slowed to find a gap, and a command would override that."""
TOP_SPEED_MPS = 200.0 / 3.6
"""Maximum speed of an uncommanded vehicle: the default of its class, above all limits that nets have."""
_CAP_BRAKING_MPS2 = 1.5
"""Braking to a lower desired speed, and, times a share, for a red light that cannot be avoided."""
_QUEUE_SPEED_MPS, _QUEUE_GAP_M = 2.0, 3.0
"""A slower leader stands in a queue, and what is left free behind it."""
_GLIDE_BRAKING_MPS2 = 0.5
"""Braking to glide."""
_FOLLOWING_S, _NEAR_M, _LATE_S = 1.5, 20.0, 2.0
"""Gliding is for vehicles that are farther behind their leader and from the stop line, and early by more than this."""
_MOVING_FILL, _SPACING_M = 0.1, 7.5
"""Share of the road ahead of a moving leader that is taken to fill with a queue, and what a vehicle takes up in it."""
_START_LAG_S, _HEADWAY_S = 2.0, 2.4
"""When the first vehicle of a queue passes, and how far apart they pass."""
_LAST_METRES_M, _SLOW_MPS = 5.0, 3.0
"""The end of a stop is left to the driver."""


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
            one each before and behind the stop line; how gently to stop, a share of 1.5 m/s^2: from where it is enough,
            the vehicle brakes for a red light that lasts until it stands; and the least share of the limit at which it
            glides, to come to the line when it can pass. From 1 on the vehicle is uncommanded, and NaN counts as 1.

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
        share = _part(action, a, rules.before_column if before_line else rules.behind_column)
        gentle = _part(action, a, rules.stop_column if before_line else -1)
        slowest = _part(action, a, rules.glide_column if before_line else -1)
        is_new = tables.acting[a] < 0
        if not is_new and (np.isnan(share) or np.isnan(gentle) or np.isnan(slowest)):
            sums.nan_actions += 1
        free = is_new or defer[a] != 0 or not (share < 1.0 or gentle < 1.0 or slowest < 1.0)
        vehicle.deferred = free
        speed, max_speed, slower = vehicle.speed_mps, TOP_SPEED_MPS, vehicle.speed_mps
        if free:
            sums.deferred_steps += 1
        else:
            limit = world.exit_limit_mps[vehicle.exit]
            if before_line:
                limit = world.road.lanes[vehicle.region_lane].limit_mps
            if share < 1.0:
                max_speed = max(share, MIN_SHARE) * limit
                slower = min(speed, max(max_speed, speed - _CAP_BRAKING_MPS2 * rules.step_s))
            if slowest < 1.0:
                gliding_mps = _gliding_mps(vehicle, tables.signal, world.clock, min(limit, max_speed))
                gliding_mps = max(gliding_mps, max(slowest, MIN_SHARE) * limit)
                if gliding_mps < min(limit, max_speed):
                    max_speed = min(max_speed, gliding_mps)
                    slower = min(slower, max(gliding_mps, speed - _GLIDE_BRAKING_MPS2 * rules.step_s))
            if gentle < 1.0:
                least_mps2 = max(gentle, MIN_SHARE) * _CAP_BRAKING_MPS2
                braking = _stop_braking(vehicle, tables.signal, least_mps2, rules.step_s)
                slower = min(slower, speed - braking * rules.step_s)
        slowing = slower < speed
        if slowing and not vehicle.yielding and vehicle.location != INSIDE:
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


@compiled(forceinline=True)
def _part(action, a, column):  # type: ignore[no-untyped-def]
    return action[a, column] if column >= 0 else np.float32(1.0)


@compiled
def _stop_braking(vehicle, signal, least_mps2, step_s):  # type: ignore[no-untyped-def]
    """Return the even braking that ends where a vehicle must stand, in m/s^2; 0 where it is not to brake yet.

    It stands at the stop line, or behind a leader that stands before it. It must where the light is red, does not allow
    its movement, and stays so for as long as even braking takes. Stops that need more than 1.5 m/s^2 are the driver's.
    """
    shown = signal[vehicle.approach, vehicle.exit]
    ahead, speed = -vehicle.stop_line_distance_m, vehicle.speed_mps
    if vehicle.has_leader and vehicle.leader_speed_mps < _QUEUE_SPEED_MPS:
        ahead = min(ahead, vehicle.leader_gap_m - _QUEUE_GAP_M)
    if shown.colour != RED or shown.legal_on_red or ahead < _LAST_METRES_M or speed < _SLOW_MPS:
        return 0.0
    # In whole steps it stays the same throughout a stop, which rounding must not let go.
    needed = speed * speed / (2.0 * ahead + speed * step_s)
    certain = shown.change_s >= speed / needed
    return needed if certain and (1.0 - 1e-6) * least_mps2 <= needed <= _CAP_BRAKING_MPS2 else 0.0


@compiled
def _gliding_mps(vehicle, signal, clock, limit_mps):  # type: ignore[no-untyped-def]
    """Return the speed at which a vehicle comes to the stop line when it can pass it; the limit where it need not slow.

    As in :class:`~izoo.algos.drivers.glide.Glide`: the queue ahead on its lane, guessed from its leader, discharges
    from the beginning of a green, and a green that it uses up is skipped. Where turning on red is legal it waits for
    the green all the same, and no kind of road is left out: where gliding does not pay, the action has to say so.
    """
    distance = -vehicle.stop_line_distance_m
    follows = vehicle.has_leader and vehicle.leader_gap_m < _FOLLOWING_S * vehicle.speed_mps
    if follows or distance < _NEAR_M:
        return limit_mps
    shown, movement = signal[vehicle.approach, vehicle.exit], vehicle.approach * signal.shape[1] + vehicle.exit
    length_s, free_s, queue = clock.green_s[movement], distance / limit_mps, 0.0
    if vehicle.has_leader and distance > vehicle.leader_gap_m:
        fill = 1.0 if vehicle.leader_speed_mps < _QUEUE_SPEED_MPS else _MOVING_FILL
        queue = 1.0 + fill * (distance - vehicle.leader_gap_m) / _SPACING_M
    start_s = shown.change_s
    if shown.colour == GREEN:
        start_s = min(shown.change_s - length_s, 0.0)  # it may be green for ever
    elif shown.colour != RED:
        start_s = max(shown.second_green_s - clock.timing.cycle_s, 0.0)
    passes_s = shown.third_green_s + length_s
    for k in range(3):
        begins_s = max(start_s, 0.0)
        lag_s = _START_LAG_S if start_s >= 0.0 and shown.change_s < NEVER_S else 0.0
        passing_s = max(begins_s + lag_s + _HEADWAY_S * queue, free_s)
        if passing_s <= start_s + length_s:
            passes_s = passing_s
            break
        queue = max(queue - max(start_s + length_s - begins_s - lag_s, 0.0) / _HEADWAY_S, 0.0)
        start_s = shown.second_green_s if k == 0 else shown.third_green_s
    return distance / passes_s if passes_s - free_s >= _LATE_S else limit_mps
