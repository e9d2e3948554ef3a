"""Insertion of vehicles: which ones are due, enter, wait, or are dropped as in SUMO."""

from __future__ import annotations

from izoo.envs.twin.driving.car_following import brake_gap, free_speed, secure_gap, stop_speed
from izoo.envs.twin.driving.lane_queues import insert_into_lane, last_tail, last_vehicle, rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS
from izoo.envs.twin.driving.traffic_lights import ALLWAY_STOP, EQUAL, MINOR, PRIORITY_GREEN, STOP, is_major
from izoo.envs.twin.net.best_lanes import find_variant
from izoo.envs.twin.net.conflicts import CONFLICT_KIND, CONFLICT_LANE, DIVERGING
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACCEL,
    DECEL,
    DEPART_LANE,
    DEPART_MS,
    DEPART_SPEED,
    DRIVING,
    DROPPED,
    LANE_BACK,
    LANE_EDGE,
    LANE_FRONT,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_LIMIT,
    LANE_TAILS,
    LENGTH,
    LINK_ENTRY,
    LINK_FIRST_FOE,
    LINK_FOES,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_SIGNAL,
    MIN_GAP,
    NEXT_DEPARTURE,
    NOW_MS,
    ON_ROAD,
    PHASE_STATE,
    POSITION,
    PROGRAM_FIRST_PHASE,
    PROGRAM_PHASES,
    ROUTE,
    SPEED,
    STATUS,
    TAU,
    VARIANT,
    WAITING,
)

ENTER, WAIT, DROP = range(3)
ROOM_RIGHT_M, ROOM_LEFT_M = 20.0, 40.0
"""Room that SUMO reserves at the end of a lane for vehicles that must change by two lanes or more."""


@compiled
def insert_vehicles(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Insert the vehicles that are due where there is room, per lane in the order of departure."""
    ints, clock = state.ints, state.clock
    now_ms = clock[NOW_MS]
    count = traffic.ints.shape[0]
    while clock[NEXT_DEPARTURE] < count and traffic.ints[clock[NEXT_DEPARTURE], DEPART_MS] <= now_ms:
        v = clock[NEXT_DEPARTURE]
        ints[v, STATUS] = WAITING
        lane = traffic.ints[v, DEPART_LANE]
        last = state.waiting_last[lane]
        if last < 0:
            state.waiting_first[lane] = v
        else:
            state.waiting_next[last] = v
        state.waiting_last[lane] = v
        state.waiting_next[v] = -1
        clock[NEXT_DEPARTURE] += 1
    for k in range(net.source_lanes.shape[0]):
        lane = net.source_lanes[k]
        v = state.waiting_first[lane]
        while v >= 0:
            verdict = departure_verdict(net, traffic, state, v, lane, step_ms)
            if verdict == WAIT:
                break
            state.waiting_first[lane] = state.waiting_next[v]
            if state.waiting_next[v] < 0:
                state.waiting_last[lane] = -1
            if verdict == DROP:
                # As in SUMO, no other vehicle enters on this lane in this step.
                ints[v, STATUS] = DROPPED
                break
            insert_vehicle(net, traffic, state, v, lane)
            v = state.waiting_first[lane]


@compiled
def departure_verdict(net, traffic, state, v, lane, step_ms):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` enters ``lane`` at its departure speed, waits or is dropped.

    It looks ahead within its braking distance. It waits for vehicles and red lights that are too close; SUMO drops it
    for obstacles that stay: a lane that does not continue the route, a link that never has priority, a slow lane.
    """
    step_s = step_ms / 1000.0
    driver = traffic.floats[v]
    start, speed = lane, driver[DEPART_SPEED]
    if state.ints[v, VARIANT] < 0:
        # Set once, although the signals may change while it waits.
        state.ints[v, VARIANT] = find_variant(net, state, traffic.ints[v, ROUTE])
    desired = net.lane_floats[lane, LANE_LIMIT]
    position = min(net.lane_floats[lane, LANE_LENGTH], driver[LENGTH] + POSITION_EPS)
    seen = -position
    leader = state.lanes[lane, LANE_BACK]
    if leader < 0:
        leader = last_tail(net, traffic, state, lane, v)
    reach = brake_gap(speed, driver[DECEL], driver[TAU], step_s) + driver[MIN_GAP]
    verdict = ENTER
    while True:
        if leader >= 0:
            gap = seen + rear_position(net, traffic, state, leader, lane) - driver[MIN_GAP]
            if gap < 0.0 or gap < secure_gap(driver, speed, state.floats[leader, SPEED]):
                verdict = WAIT
                break
        seen += net.lane_floats[lane, LANE_LENGTH]
        if seen >= reach:
            break
        link = net.route_link[traffic.ints[v, ROUTE], lane]
        stops = stop_speed(driver, seen, speed, desired, driver[DECEL], step_s) >= speed
        if link < 0:
            if net.lane_ints[lane, LANE_EDGE] != net.route_exit_edge[traffic.ints[v, ROUTE]] and not stops:
                verdict = DROP
            break
        letter = state.link_letter[link]
        if not is_major(letter):
            if not stops:
                verdict = DROP if _never_has_priority(net, link, letter) else WAIT
            break
        lane = net.link_ints[link, LINK_NEXT]
        if free_speed(driver, seen, speed, net.lane_floats[lane, LANE_LIMIT], desired, step_s) < speed:
            verdict = DROP
            break
        onward = net.route_link[traffic.ints[v, ROUTE], lane]
        if net.lane_ints[lane, LANE_INSIDE] and _is_crossed(net, state, onward):
            verdict = WAIT
            break
        leader = last_vehicle(net, traffic, state, lane, v)
    if verdict == ENTER and _too_fast_for_lane_changes(net, traffic, state, v, start, position, step_s):
        verdict = DROP
    return verdict


@compiled
def _is_crossed(net, state, link):  # type: ignore[no-untyped-def]
    """Return whether a vehicle is on a way that crosses or merges with the one that ``link`` ends.

    Ways of mutually exclusive links count as well, even if they lie side by side.
    """
    first = net.conflict_first[link]
    for row in range(first, first + net.conflict_count[link]):
        kind, lane = net.conflict_ints[row, CONFLICT_KIND], net.conflict_ints[row, CONFLICT_LANE]
        if kind != DIVERGING and _is_busy(state, lane):
            return True
    entry = net.link_ints[link, LINK_ENTRY]
    first = net.link_ints[entry, LINK_FIRST_FOE]
    for k in range(first, first + net.link_ints[entry, LINK_FOES]):
        lane = net.link_ints[net.foes[k], LINK_NEXT]
        if net.lane_ints[lane, LANE_INSIDE] and _is_busy(state, lane):
            return True
    return False


@compiled
def _is_busy(state, lane):  # type: ignore[no-untyped-def]
    return state.lanes[lane, LANE_FRONT] >= 0 or state.lanes[lane, LANE_TAILS] > 0


@compiled
def _too_fast_for_lane_changes(net, traffic, state, v, lane, position, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` would be too fast on ``lane`` to change by two lanes or more before its end.

    SUMO checks this at the position after one step. If the reserved room has begun by then, it does not check, and the
    vehicle enters.
    """
    variant = state.ints[v, VARIANT]
    offset = net.best_offset[variant, lane]
    if -2 < offset < 2:
        return False
    driver = traffic.floats[v]
    speed = driver[DEPART_SPEED]
    room = ROOM_RIGHT_M if offset < 0 else ROOM_LEFT_M
    left = net.best_length[variant, lane] - position - room - speed * step_s
    if left < 0.0:
        return False
    return stop_speed(driver, left, speed, net.lane_floats[lane, LANE_LIMIT], driver[DECEL], step_s) < speed


@compiled
def _never_has_priority(net, link, letter):  # type: ignore[no-untyped-def]
    """Return whether ``link``, which shows ``letter`` now, never has priority."""
    if letter in (MINOR, EQUAL, STOP, ALLWAY_STOP):
        return True
    program = net.link_ints[link, LINK_PROGRAM]
    if program < 0:
        return False
    first = net.program_ints[program, PROGRAM_FIRST_PHASE]
    for phase in range(first, first + net.program_ints[program, PROGRAM_PHASES]):
        if net.phase_letters[net.phase_ints[phase, PHASE_STATE] + net.link_ints[link, LINK_SIGNAL]] == PRIORITY_GREEN:
            return False
    return True


@compiled
def insert_vehicle(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Put vehicle ``v`` on the road."""
    floats, driver = state.floats, traffic.floats[v]
    floats[v, POSITION] = min(net.lane_floats[lane, LANE_LENGTH], driver[LENGTH] + POSITION_EPS)
    floats[v, SPEED], floats[v, ACCEL] = driver[DEPART_SPEED], 0.0
    state.ints[v, STATUS] = DRIVING
    insert_into_lane(state, v, lane)
    state.clock[ON_ROAD] += 1
