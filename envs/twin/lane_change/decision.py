"""The lane-change decision of SUMO's model LC2013, with its default parameters, for a vehicle and a neighbouring lane.

The model distinguishes four motivations (Erdmann, "Lane-changing model in SUMO", 2014), considered in this order:

1. *strategic*: the route needs the change soon, or forbids it;
2. *cooperative*: to make room for another vehicle;
3. *tactical*: to gain speed;
4. the *obligation to keep right*.

A commanded change comes between the first and the second. Details that the paper leaves open were found by probing.
The *target lane* is the neighbouring lane under consideration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from izoo.envs.tables import compiled
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
from izoo.envs.twin.lane_change.downstream_occupancy import downstream_occupancy
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

_LOOK_AHEAD_DECAY_PER_S = 0.1
_LOOK_AHEAD_S = 10.0
_LOOK_AHEAD_LEFT = 2.0
_URGENCY = 2.0
_CROSSING_ROOM_RIGHT_M, _CROSSING_ROOM_LEFT_M = 20.0, 40.0
_TURN_LANE_M = 200.0
_MOTORWAY_MPS = 80.0 / 3.6
_MIN_GAIN_SPEED_MPS = 10.0
_RIGHT_DISCOUNT_MPS = 5.0 / 3.6
_LEFT_THRESHOLD, _RIGHT_THRESHOLD = 0.2, 2.0
_KEEP_RIGHT_S, _ACCEPTANCE_S = 5.0, 7.0
_REMAINING_S = 20.0
_FORESIGHT_S = 8.0
_MEMORY_UNIT = 1e-7
"""Memories of speed gain are truncated to multiples of it."""

DEFAULT_MODE, ROUTE_ONLY_MODE = 0, 1
"""Values of ``change_mode``: SUMO's default; only strategic and commanded changes."""


class Change(NamedTuple):
    """A change under consideration.

    Attributes:
        side: -1 right, 1 left.
        offset: lanes from the own lane to the best lane (positive: to the left); ``side`` where both lanes are best.
        to_best: whether the change is towards the best lane.
        look_ahead_m: distance within which a strategic change is urgent, per lane to change.
        overtakes_left: whether to change left because a slower vehicle on the left must not be passed on the right.
        speed_cap_mps: speed that this rule leaves on the own lane.
    """

    side: int
    offset: int
    to_best: bool
    look_ahead_m: float
    overtakes_left: bool
    speed_cap_mps: float


@compiled
def apply_request(net, state, v, flags):  # type: ignore[no-untyped-def]
    """Let a commanded lane override the requests in ``flags``, and the mode forbid some; return the new state bits."""
    request = 0
    if state.vehicles[v].change_until_ms >= state.clock.now_ms:
        lane, target = state.vehicles[v].lane, state.vehicles[v].change_target
        if target < net.edges[net.lanes[lane].edge].lanes:
            index = net.lanes[lane].index
            request = RIGHTWARD if index > target else LEFTWARD if index < target else STAY
    if flags & WANTS_CHANGE_OR_STAY:
        forbidden = state.vehicles[v].change_mode == ROUTE_ONLY_MODE and not flags & STRATEGIC
        if forbidden or (request and flags & (LEFTWARD | RIGHTWARD | STAY) & ~request):
            flags &= ~(WANTS_CHANGE_OR_STAY | URGENT)
    if request == 0:
        return flags
    flags |= COMMANDED | request
    return flags | URGENT if request != STAY else flags


@compiled
def _is_permitted(net, state, v, request):  # type: ignore[no-untyped-def]
    return apply_request(net, state, v, request) == request


@compiled
def decide_lane_change(net, traffic, state, v, side, around, blocked, step_s):  # type: ignore[no-untyped-def]
    """Return the state bits of the request to change to ``side`` (-1 right, 1 left), without the blocking bits.

    Args:
        around: the :class:`~izoo.envs.twin.lane_change.neighbours.Neighbours` for this change.
        blocked: bits of the vehicles that block the change.
    """
    vehicles, driver = state.vehicles, traffic.drivers[v]
    lane, variant = vehicles[v].lane, vehicles[v].variant
    target = lane + side
    position, speed = vehicles[v].position, vehicles[v].speed
    limit = desired_speed(net, state, v, lane)
    right = side < 0
    best_offset = net.best[variant, lane].offset
    offset = best_offset
    if offset == 0 and net.best[variant, target].offset == 0:
        offset = side
    length, target_length = net.best[variant, lane].length, net.best[variant, target].length
    toward = RIGHTWARD if right else LEFTWARD
    opposite = LEFTWARD if right else RIGHTWARD
    to_best = offset * side > 0

    flags = vehicles[v].change_state & KEPT
    last_blocked, first_blocked = state.changer[lane].last_blocked, state.changer[lane].first_blocked
    if last_blocked >= 0:
        flags = slow_for_blocked(net, traffic, state, v, last_blocked, flags, step_s)
    if first_blocked >= 0 and first_blocked != last_blocked:
        flags = slow_for_blocked(net, traffic, state, v, first_blocked, flags, step_s)

    # The look-ahead speed rises at once and decays slowly, so that a short stop does not shorten the look-ahead.
    if speed > vehicles[v].look_ahead_speed:
        vehicles[v].look_ahead_speed = speed
    else:
        memory = 1.0 - _LOOK_AHEAD_DECAY_PER_S * step_s
        vehicles[v].look_ahead_speed = max(0.0, memory * vehicles[v].look_ahead_speed + (1.0 - memory) * speed)
    look_ahead_speed = vehicles[v].look_ahead_speed
    look_ahead_m = look_ahead_speed * _LOOK_AHEAD_S * (1.0 if right else _LOOK_AHEAD_LEFT)
    look_ahead_m += 2.0 * (driver.length + driver.min_gap)

    own_occupation = state.changer_density[lane] + downstream_occupancy(net, state, v, lane)
    target_occupation = state.changer_density[target] + downstream_occupancy(net, state, v, target)
    best = lane + offset
    best_occupation = (
        own_occupation
        if offset == 0
        else target_occupation
        if offset == side
        else state.changer_density[best] + downstream_occupancy(net, state, v, best)
    )
    usable_m = length - position - best_occupation
    target_left_m = max(0.0, target_length - position - max(own_occupation, target_occupation))
    overtakes_left, speed_cap = False, limit
    if to_best and offset == best_offset and usable_m / abs(offset) < look_ahead_m:
        flags |= toward | STRATEGIC | URGENT
    else:
        if around.target_leader >= 0 and not right and not is_congested(state, v):
            overtakes_left, speed_cap = _stay_behind_left_leader(
                traffic, state, v, around.target_leader, around.target_leader_gap, limit, step_s
            )
        if (not to_best and target_left_m / (abs(offset) + 2) < look_ahead_m) or (
            offset == 0
            and (
                target_left_m * 2.0 < look_ahead_m or (net.best[variant, target].open and target_length < _TURN_LANE_M)
            )
        ):
            flags |= STAY | STRATEGIC

    flags = apply_request(net, state, v, flags)
    if flags & opposite:
        flags &= ~(COMMANDED | opposite | URGENT)
    if flags & STAY:
        return flags
    change = Change(side, offset, to_best, look_ahead_m, overtakes_left, speed_cap)
    if flags & URGENT:
        _prepare_urgent_change(net, traffic, state, v, change, around, blocked, flags, step_s)
        return flags
    if right and offset == 0 and net.lanes[lane].limit > _MOTORWAY_MPS and look_ahead_speed > STANDING_MPS:
        return flags | STAY | STRATEGIC
    return _discretionary_change(net, traffic, state, v, change, around, flags, step_s)


@compiled
def _stay_behind_left_leader(traffic, state, v, leader, gap, limit, step_s):  # type: ignore[no-untyped-def]
    """Do not pass a slower vehicle on its right where that is forbidden.

    Returns:
        Whether to overtake it on the left instead, and the speed (m/s) that is left on the own lane.
    """
    driver, speed, leader_speed = traffic.drivers[v], state.vehicles[v].speed, state.vehicles[leader].speed
    slower = speed - leader_speed
    if slower <= 0.0:
        return False, limit
    safe = max(follow_speed(driver, gap, speed, leader_speed, limit, step_s), speed - driver.decel * step_s)
    if state.vehicles[v].speed_gain < _LEFT_THRESHOLD:
        # It brakes hard only once it would rather change left.
        safe = max(safe, leader_speed)
    add_advice(state, v, safe)
    later = follow_speed(driver, gap - slower * _FORESIGHT_S, speed, leader_speed, limit, step_s)
    if later >= safe:
        return False, safe
    state.vehicles[v].speed_gain += step_s * slower / max(limit, _MIN_GAIN_SPEED_MPS)
    return True, safe


@compiled
def _prepare_urgent_change(net, traffic, state, v, change, around, blocked, flags, step_s):  # type: ignore[no-untyped-def]
    """Reserve room for vehicles that cross over, and inform the target lane's leader and follower."""
    vehicles, lane, right = state.vehicles, state.vehicles[v].lane, change.side < 0
    variant = state.vehicles[v].variant
    left_m = net.best[variant, lane].length - vehicles[v].position
    is_open = net.best[variant, lane].open
    if change.to_best and abs(change.offset) > 1 and is_open and not net.lanes[lane].inside:
        reserve = _CROSSING_ROOM_RIGHT_M if right else _CROSSING_ROOM_LEFT_M
        vehicles[v].blocker_length = max(reserve, vehicles[v].blocker_length)
    vehicles[v].left_space = left_m
    opposite = LEFTWARD if right else RIGHTWARD
    first_blocked = state.changer[lane].first_blocked
    if first_blocked != around.target_leader:
        reserve_room(traffic, state, v, first_blocked, opposite, step_s)
    reserve_room(traffic, state, v, around.target_leader, opposite, step_s)
    if flags & COMMANDED:
        remaining_s = (state.vehicles[v].change_until_ms - state.clock.now_ms) / 1000.0
    else:
        remaining_s = max(step_s, left_m / max(vehicles[v].look_ahead_speed, EPS) / abs(change.offset) / _URGENCY)
    planned = inform_leader(net, traffic, state, v, around, blocked, not right, remaining_s, step_s)
    if planned >= 0.0:
        inform_follower(net, traffic, state, v, around, blocked, not right, remaining_s, planned, step_s)


@compiled
def _discretionary_change(net, traffic, state, v, change, around, flags, step_s):  # type: ignore[no-untyped-def]
    """Return the state bits of a request that the route does not press for: cooperation, speed gain, keeping right."""
    vehicles, driver = state.vehicles, traffic.drivers[v]
    lane, variant = vehicles[v].lane, vehicles[v].variant
    target, right = lane + change.side, change.side < 0
    toward = RIGHTWARD if right else LEFTWARD
    speed = vehicles[v].speed
    limit, target_limit = desired_speed(net, state, v, lane), desired_speed(net, state, v, target)
    target_length = net.best[variant, target].length
    allowed = target_length / (abs(change.offset) + 1) > change.look_ahead_m

    wanted = WANTED_RIGHTWARD if right else WANTED_LEFTWARD
    own = vehicles[v].change_state
    if own & BLOCKS_FOLLOWER and own & wanted and (change.to_best or allowed):
        request = flags | toward | COOPERATIVE | URGENT
        if _is_permitted(net, state, v, request):
            return request

    leader, leader_gap = around.leader, around.leader_gap
    target_leader, target_gap = around.target_leader, around.target_leader_gap
    chasing = _accelerates(state, leader) or _accelerates(state, target_leader)
    length = net.best[variant, lane].length
    here = _anticipated_speed(traffic, state, v, leader, leader_gap, length, limit, chasing, step_s)
    here = min(limit, change.speed_cap_mps, here)
    there = _anticipated_speed(traffic, state, v, target_leader, target_gap, target_length, limit, chasing, step_s)
    there = min(target_limit, there)
    gain = (there - here) / max(there, _MIN_GAIN_SPEED_MPS)
    lasting = target_length / max(0.1, speed) > _REMAINING_S
    if right:
        if here - _RIGHT_DISCOUNT_MPS > there:
            vehicles[v].speed_gain_right = _truncate(vehicles[v].speed_gain_right * math.pow(0.5, step_s))
        else:
            vehicles[v].speed_gain_right = _truncate(vehicles[v].speed_gain_right + step_s * gain)
            share = limit / net.lanes[lane].limit
            vehicles[v].keep_right -= _keep_right_growth(
                driver, state, speed, limit, share, target_length, target_leader, target_gap, step_s
            )
            if vehicles[v].keep_right < -_RIGHT_THRESHOLD:
                request = flags | toward | RIGHT_KEEPING
                if _is_permitted(net, state, v, request):
                    return request
        if vehicles[v].speed_gain_right > _RIGHT_THRESHOLD and lasting:
            request = flags | toward | SPEED_GAINING
            if _is_permitted(net, state, v, request):
                return request
    else:
        if here > there:
            vehicles[v].speed_gain = _truncate(vehicles[v].speed_gain * math.pow(0.5, step_s))
        elif here == there:
            vehicles[v].speed_gain = _truncate(vehicles[v].speed_gain * math.pow(0.8, step_s))
        else:
            vehicles[v].speed_gain = _truncate(vehicles[v].speed_gain + step_s * gain)
        if vehicles[v].speed_gain > _LEFT_THRESHOLD and (gain > EPS or change.overtakes_left) and lasting:
            request = flags | toward | SPEED_GAINING
            if _is_permitted(net, state, v, request):
                return request
    if (
        change.to_best
        and change.offset == net.best[variant, lane].offset
        and gain >= 0.0
        and (vehicles[v].speed_gain_right if right else vehicles[v].speed_gain) > 0.0
    ):
        request = flags | toward | STRATEGIC
        if _is_permitted(net, state, v, request):
            return request
    return flags


@compiled
def _truncate(memory):  # type: ignore[no-untyped-def]
    """Return a memory of speed gain in whole units."""
    return np.trunc(memory * (1.0 / _MEMORY_UNIT)) * _MEMORY_UNIT


@compiled
def _accelerates(state, leader):  # type: ignore[no-untyped-def]
    return leader >= 0 and state.vehicles[leader].accel > 0.0


@compiled
def _anticipated_speed(traffic, state, v, leader, gap, length, limit, chasing, step_s):  # type: ignore[no-untyped-def]
    """Return the speed (m/s) that a lane allows, behind a leader or to stop at its end.

    It is safe even if the leader brakes hard; where one of the leaders accelerates (``chasing``), it is the speed of
    the car-following model within a second.
    """
    driver = traffic.drivers[v]
    if chasing:
        speed = state.vehicles[v].speed + driver.max_accel * (1.0 - step_s)
        if leader < 0:
            return follow_speed(driver, length, speed, 0.0, limit, step_s)
        return follow_speed(driver, gap, speed, state.vehicles[leader].speed, limit, step_s)
    if leader < 0:
        return safe_stop_speed(length, driver.decel, driver.tau, step_s)
    decel = max(driver.decel, traffic.drivers[leader].decel)
    room = gap + brake_gap(state.vehicles[leader].speed, decel, 0.0, step_s)
    return safe_stop_speed(room, driver.decel, driver.tau, step_s)


@compiled
def _keep_right_growth(driver, state, speed, limit, share, target_length, leader, gap, step_s):  # type: ignore[no-untyped-def]
    """Return the growth of the obligation to keep right: by the time at full speed that the target lane offers."""
    acceptance_s = _ACCEPTANCE_S * share * max(1.0, speed)
    full_m = max(0.0, target_length - brake_gap(limit, driver.decel, driver.tau, step_s))
    full_s = min(acceptance_s, full_m / limit)
    if leader >= 0 and state.vehicles[leader].speed < limit:
        leader_speed = state.vehicles[leader].speed
        full_m = max(0.0, min(full_m, gap - secure_gap(driver, limit, leader_speed)))
        full_s = min(full_s, full_m / (limit - leader_speed))
    return _RIGHT_THRESHOLD * step_s * (full_s / acceptance_s) / _KEEP_RIGHT_S
