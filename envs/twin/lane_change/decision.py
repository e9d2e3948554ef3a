"""Whether a driver wants to change to a neighbouring lane, and why: SUMO's model LC2013 with its default parameters.

In this order: changes that the route needs soon, staying for the route's sake, commands, helping others, speed, keeping
right, and the route at leisure. The model: Erdmann, Lane-changing model in SUMO (2014); details by probing.
"""

from __future__ import annotations

import math

import numpy as np

from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, safe_stop_speed, secure_gap
from izoo.envs.twin.driving.tolerances import EPS, STANDING_MPS
from izoo.envs.twin.lane_change.cooperation import (
    add_advice,
    inform_follower,
    inform_leader,
    is_congested,
    reserve_room,
    slow_for_blocked,
)
from izoo.envs.twin.lane_change.downstream_occupancy import room_taken
from izoo.envs.twin.lane_change.flags import (
    BLOCKS_FOLLOWER,
    COMMANDED,
    COOPERATIVE,
    KEPT,
    LEFTWARD,
    RIGHT_KEEPING,
    RIGHTWARD,
    SPEED_GAINING,
    STAY,
    STRATEGIC,
    URGENT,
    WANTED_LEFTWARD,
    WANTED_RIGHTWARD,
    WANTS_CHANGE_OR_STAY,
)
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACCEL,
    BLOCKER_LENGTH,
    CHANGE_MODE,
    CHANGE_STATE,
    CHANGE_TARGET,
    CHANGE_UNTIL_MS,
    CHANGER_FIRST_BLOCKED,
    CHANGER_LAST_BLOCKED,
    DECEL,
    EDGE_LANES,
    KEEP_RIGHT,
    LANE,
    LANE_EDGE,
    LANE_INDEX,
    LANE_INSIDE,
    LANE_LIMIT,
    LEFT_SPACE,
    LENGTH,
    LOOK_AHEAD_SPEED,
    MAX_ACCEL,
    MIN_GAP,
    NOW_MS,
    POSITION,
    SPEED,
    SPEED_GAIN,
    SPEED_GAIN_RIGHT,
    TAU,
    VARIANT,
)

_FORGETTING = 0.1
_LOOK_AHEAD_S = 10.0
_LOOK_AHEAD_LEFT = 2.0
_URGENCY = 2.0
_CROSSING_ROOM_RIGHT_M, _CROSSING_ROOM_LEFT_M = 20.0, 40.0
_TURN_LANE_M = 200.0
_MOTORWAY_MPS = 80.0 / 3.6
_LEAST_GAIN_SPEED_MPS = 10.0
_RIGHT_DISCOUNT_MPS = 5.0 / 3.6
_LEFT_THRESHOLD, _RIGHT_THRESHOLD = 0.2, 2.0
_KEEP_RIGHT_S, _ACCEPTANCE_S = 5.0, 7.0
_REMAINING_S = 20.0
_FORESIGHT_S = 8.0
_MEMORY_UNIT = 1e-7
"""Memories of speed gain are cut to multiples of it, towards 0."""

DEFAULT_MODE, ROUTE_ONLY_MODE = 0, 1
"""Values of ``CHANGE_MODE``: as SUMO has it; what the route needs, and commands."""


@compiled
def obey(net, state, v, flags):  # type: ignore[no-untyped-def]
    """Let a commanded lane overrule the wishes in ``flags``, and the mode forbid some; return the new state bits."""
    request = 0
    if state.ints[v, CHANGE_UNTIL_MS] >= state.clock[NOW_MS]:
        lane, target = state.ints[v, LANE], state.ints[v, CHANGE_TARGET]
        if target < net.edge_ints[net.lane_ints[lane, LANE_EDGE], EDGE_LANES]:
            index = net.lane_ints[lane, LANE_INDEX]
            request = RIGHTWARD if index > target else LEFTWARD if index < target else STAY
    if flags & WANTS_CHANGE_OR_STAY:
        forbidden = state.ints[v, CHANGE_MODE] == ROUTE_ONLY_MODE and not flags & STRATEGIC
        if forbidden or (request and flags & (LEFTWARD | RIGHTWARD | STAY) & ~request):
            flags &= ~(WANTS_CHANGE_OR_STAY | URGENT)
    if request == 0:
        return flags
    flags |= COMMANDED | request
    return flags | URGENT if request != STAY else flags


@compiled
def _is_granted(net, state, v, request):  # type: ignore[no-untyped-def]
    return obey(net, state, v, request) == request


@compiled
def want(  # type: ignore[no-untyped-def]
    net, traffic, state, v, side, leader, gap, beside, beside_gap, follower, follower_gap, blocked, step_s
):
    """Return the state bits of the wish to change to ``side`` (-1 right, 1 left), ``blocked`` left out.

    Args:
        leader, gap: of the own lane (-1: none; m); beside, beside_gap and follower, follower_gap: of the other lane.
        blocked: bits of what stands against the change.
    """
    floats, ints, driver = state.floats, state.ints, traffic.floats[v]
    lane, variant = ints[v, LANE], ints[v, VARIANT]
    other = lane + side
    position, speed = floats[v, POSITION], floats[v, SPEED]
    limit = desired_speed(net, state, v, lane)
    right = side < 0
    own_offset = net.best_offset[variant, lane]
    offset = own_offset
    if offset == 0 and net.best_offset[variant, other] == 0:
        offset = side
    length, other_length = net.best_length[variant, lane], net.best_length[variant, other]
    toward = RIGHTWARD if right else LEFTWARD
    counter = LEFTWARD if right else RIGHTWARD
    to_best = offset * side > 0

    flags = ints[v, CHANGE_STATE] & KEPT
    last_blocked, first_blocked = state.changer[lane, CHANGER_LAST_BLOCKED], state.changer[lane, CHANGER_FIRST_BLOCKED]
    if last_blocked >= 0:
        flags = slow_for_blocked(net, traffic, state, v, last_blocked, flags, step_s)
    if first_blocked >= 0 and first_blocked != last_blocked:
        flags = slow_for_blocked(net, traffic, state, v, first_blocked, flags, step_s)

    if speed > floats[v, LOOK_AHEAD_SPEED]:
        floats[v, LOOK_AHEAD_SPEED] = speed
    else:
        memory = 1.0 - _FORGETTING * step_s
        floats[v, LOOK_AHEAD_SPEED] = max(0.0, memory * floats[v, LOOK_AHEAD_SPEED] + (1.0 - memory) * speed)
    ahead_speed = floats[v, LOOK_AHEAD_SPEED]
    needed = ahead_speed * _LOOK_AHEAD_S * (1.0 if right else _LOOK_AHEAD_LEFT)
    needed += 2.0 * (driver[LENGTH] + driver[MIN_GAP])

    own_jam = state.changer_density[lane] + room_taken(net, state, v, lane)
    other_jam = state.changer_density[other] + room_taken(net, state, v, other)
    best = lane + offset
    best_jam = (
        own_jam
        if offset == 0
        else other_jam
        if offset == side
        else state.changer_density[best] + room_taken(net, state, v, best)
    )
    usable = length - position - best_jam
    other_left = max(0.0, other_length - position - max(own_jam, other_jam))
    avoiding, cap = False, limit
    if to_best and offset == own_offset and usable / abs(offset) < needed:
        flags |= toward | STRATEGIC | URGENT
    else:
        if beside >= 0 and not right and not is_congested(state, v):
            avoiding, cap = _fall_behind(traffic, state, v, beside, beside_gap, limit, step_s)
        if (not to_best and other_left / (abs(offset) + 2) < needed) or (
            offset == 0
            and (other_left * 2.0 < needed or (net.best_open[variant, other] and other_length < _TURN_LANE_M))
        ):
            flags |= STAY | STRATEGIC

    flags = obey(net, state, v, flags)
    if flags & counter:
        flags &= ~(COMMANDED | counter | URGENT)
    if flags & STAY:
        return flags
    if flags & URGENT:
        _prepare_urgent(
            net, traffic, state, v, right, to_best, offset, length - position, beside, beside_gap, follower,
            follower_gap, blocked, flags, step_s,
        )  # fmt: skip
        return flags
    if right and offset == 0 and net.lane_floats[lane, LANE_LIMIT] > _MOTORWAY_MPS and ahead_speed > STANDING_MPS:
        return flags | STAY | STRATEGIC
    return _want_freely(
        net,
        traffic,
        state,
        v,
        side,
        flags,
        offset,
        to_best,
        leader,
        gap,
        beside,
        beside_gap,
        avoiding,
        cap,
        needed,
        step_s,
    )


@compiled
def _fall_behind(traffic, state, v, beside, gap, limit, step_s):  # type: ignore[no-untyped-def]
    """Do not pass a slower vehicle on its right where that is forbidden.

    Returns:
        Whether to go left instead, and the speed (m/s) that is left on the own lane.
    """
    driver, speed, other = traffic.floats[v], state.floats[v, SPEED], state.floats[beside, SPEED]
    slower = speed - other
    if slower <= 0.0:
        return False, limit
    safe = max(follow_speed(driver, gap, speed, other, limit, step_s), speed - driver[DECEL] * step_s)
    if state.floats[v, SPEED_GAIN] < _LEFT_THRESHOLD:
        # It brakes hard only once it would rather go left.
        safe = max(safe, other)
    add_advice(state, v, safe)
    later = follow_speed(driver, gap - slower * _FORESIGHT_S, speed, other, limit, step_s)
    if later >= safe:
        return False, safe
    state.floats[v, SPEED_GAIN] += step_s * slower / max(limit, _LEAST_GAIN_SPEED_MPS)
    return True, safe


@compiled
def _prepare_urgent(  # type: ignore[no-untyped-def]
    net, traffic, state, v, right, to_best, offset, left_m, beside, beside_gap, follower, follower_gap, blocked, flags,
    step_s,
):  # fmt: skip
    """Make room for an urgent change: reserve some for those who cross over, and tell leader and follower."""
    floats, lane = state.floats, state.ints[v, LANE]
    is_open = net.best_open[state.ints[v, VARIANT], lane]
    if to_best and abs(offset) > 1 and is_open and not net.lane_ints[lane, LANE_INSIDE]:
        reserve = _CROSSING_ROOM_RIGHT_M if right else _CROSSING_ROOM_LEFT_M
        floats[v, BLOCKER_LENGTH] = max(reserve, floats[v, BLOCKER_LENGTH])
    floats[v, LEFT_SPACE] = left_m
    counter = LEFTWARD if right else RIGHTWARD
    first_blocked = state.changer[lane, CHANGER_FIRST_BLOCKED]
    if first_blocked != beside:
        reserve_room(net, traffic, state, v, first_blocked, counter, step_s)
    reserve_room(net, traffic, state, v, beside, counter, step_s)
    if flags & COMMANDED:
        remaining_s = (state.ints[v, CHANGE_UNTIL_MS] - state.clock[NOW_MS]) / 1000.0
    else:
        remaining_s = max(step_s, left_m / max(floats[v, LOOK_AHEAD_SPEED], EPS) / abs(offset) / _URGENCY)
    planned = inform_leader(net, traffic, state, v, beside, beside_gap, blocked, not right, remaining_s, step_s)
    if planned >= 0.0:
        inform_follower(
            net, traffic, state, v, follower, follower_gap, blocked, not right, remaining_s, planned, step_s
        )


@compiled
def _want_freely(  # type: ignore[no-untyped-def]
    net, traffic, state, v, side, flags, offset, to_best, leader, gap, beside, beside_gap, avoiding, cap, needed,
    step_s,
):  # fmt: skip
    """Return the state bits of a wish that the route does not press for."""
    floats = state.floats
    lane, variant = state.ints[v, LANE], state.ints[v, VARIANT]
    other, right = lane + side, side < 0
    toward = RIGHTWARD if right else LEFTWARD
    speed = floats[v, SPEED]
    limit, other_limit = desired_speed(net, state, v, lane), desired_speed(net, state, v, other)
    other_length = net.best_length[variant, other]
    allowed = other_length / (abs(offset) + 1) > needed

    wanted = WANTED_RIGHTWARD if right else WANTED_LEFTWARD
    own = state.ints[v, CHANGE_STATE]
    if own & BLOCKS_FOLLOWER and own & wanted and (to_best or allowed):
        request = flags | toward | COOPERATIVE | URGENT
        if _is_granted(net, state, v, request):
            return request

    chasing = _accelerates(state, leader) or _accelerates(state, beside)
    length = net.best_length[variant, lane]
    here = min(limit, cap, _anticipate(traffic, state, v, leader, gap, length, limit, chasing, step_s))
    there = min(other_limit, _anticipate(traffic, state, v, beside, beside_gap, other_length, limit, chasing, step_s))
    gain = (there - here) / max(there, _LEAST_GAIN_SPEED_MPS)
    lasting = other_length / max(0.1, speed) > _REMAINING_S
    if right:
        if here - _RIGHT_DISCOUNT_MPS > there:
            floats[v, SPEED_GAIN_RIGHT] = _cut(floats[v, SPEED_GAIN_RIGHT] * math.pow(0.5, step_s))
        else:
            floats[v, SPEED_GAIN_RIGHT] = _cut(floats[v, SPEED_GAIN_RIGHT] + step_s * gain)
            share = limit / net.lane_floats[lane, LANE_LIMIT]
            _grow_keep_right(traffic, state, v, limit, share, other_length, beside, beside_gap, step_s)
            if floats[v, KEEP_RIGHT] < -_RIGHT_THRESHOLD:
                request = flags | toward | RIGHT_KEEPING
                if _is_granted(net, state, v, request):
                    return request
        if floats[v, SPEED_GAIN_RIGHT] > _RIGHT_THRESHOLD and lasting:
            request = flags | toward | SPEED_GAINING
            if _is_granted(net, state, v, request):
                return request
    else:
        if here > there:
            floats[v, SPEED_GAIN] = _cut(floats[v, SPEED_GAIN] * math.pow(0.5, step_s))
        elif here == there:
            floats[v, SPEED_GAIN] = _cut(floats[v, SPEED_GAIN] * math.pow(0.8, step_s))
        else:
            floats[v, SPEED_GAIN] = _cut(floats[v, SPEED_GAIN] + step_s * gain)
        if floats[v, SPEED_GAIN] > _LEFT_THRESHOLD and (gain > EPS or avoiding) and lasting:
            request = flags | toward | SPEED_GAINING
            if _is_granted(net, state, v, request):
                return request
    if (
        to_best
        and offset == net.best_offset[variant, lane]
        and gain >= 0.0
        and (floats[v, SPEED_GAIN_RIGHT] if right else floats[v, SPEED_GAIN]) > 0.0
    ):
        request = flags | toward | STRATEGIC
        if _is_granted(net, state, v, request):
            return request
    return flags


@compiled
def _cut(memory):  # type: ignore[no-untyped-def]
    """Return a memory of speed gain as it is kept."""
    return np.trunc(memory * (1.0 / _MEMORY_UNIT)) * _MEMORY_UNIT


@compiled
def _accelerates(state, leader):  # type: ignore[no-untyped-def]
    return leader >= 0 and state.floats[leader, ACCEL] > 0.0


@compiled
def _anticipate(traffic, state, v, leader, gap, length, limit, chasing, step_s):  # type: ignore[no-untyped-def]
    """Return the speed (m/s) that a lane allows, behind a leader or to stop at its end.

    Safe even if the leader brakes hard; where one of the leaders accelerates (``chasing``), what the own model of car
    following makes of it within a second.
    """
    driver = traffic.floats[v]
    if chasing:
        speed = state.floats[v, SPEED] + driver[MAX_ACCEL] * (1.0 - step_s)
        if leader < 0:
            return follow_speed(driver, length, speed, 0.0, limit, step_s)
        return follow_speed(driver, gap, speed, state.floats[leader, SPEED], limit, step_s)
    if leader < 0:
        return safe_stop_speed(length, driver[DECEL], driver[TAU], step_s)
    decel = max(driver[DECEL], traffic.floats[leader, DECEL])
    room = gap + brake_gap(state.floats[leader, SPEED], decel, 0.0, step_s)
    return safe_stop_speed(room, driver[DECEL], driver[TAU], step_s)


@compiled
def _grow_keep_right(traffic, state, v, limit, share, other_length, beside, gap, step_s):  # type: ignore[no-untyped-def]
    """Grow the wish to keep right by the share of time for which one could go there at full speed."""
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    acceptance_s = _ACCEPTANCE_S * share * max(1.0, speed)
    full = max(0.0, other_length - brake_gap(limit, driver[DECEL], driver[TAU], step_s))
    full_s = min(acceptance_s, full / limit)
    if beside >= 0 and state.floats[beside, SPEED] < limit:
        other = state.floats[beside, SPEED]
        full = max(0.0, min(full, gap - secure_gap(driver, limit, other)))
        full_s = min(full_s, full / (limit - other))
    state.floats[v, KEEP_RIGHT] -= _RIGHT_THRESHOLD * step_s * (full_s / acceptance_s) / _KEEP_RIGHT_S
