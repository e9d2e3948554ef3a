"""Vehicles that enter: who is due, who finds room, who waits."""

from __future__ import annotations

from izoo.envs.twin.arrays import (
    ACCEL,
    DECEL,
    DEPART_LANE,
    DEPART_MS,
    DEPART_SPEED,
    DRIVING,
    LANE_BACK,
    LANE_LENGTH,
    LENGTH,
    LINK_NEXT,
    MIN_GAP,
    NEXT_DEPARTURE,
    NOW_MS,
    ON_ROAD,
    POSITION,
    ROUTE,
    SPEED,
    STATUS,
    VARIANT,
    WAITING,
)
from izoo.envs.twin.best_lanes import find_variant
from izoo.envs.twin.compiled import compiled
from izoo.envs.twin.following import brake_gap, secure_gap
from izoo.envs.twin.order import back_on, last_on, place, tail_on
from izoo.envs.twin.planning import POSITION_EPS


@compiled
def insert_vehicles(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Insert whoever is due and finds room, per lane in the order of departure."""
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
        while v >= 0 and has_room(net, traffic, state, v, lane, step_ms):
            enter(net, traffic, state, v, lane)
            v = state.waiting_next[v]
            state.waiting_first[lane] = v
            if v < 0:
                state.waiting_last[lane] = -1


@compiled
def has_room(net, traffic, state, v, lane, step_ms):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` can enter ``lane`` with its speed of departure."""
    driver = traffic.floats[v]
    speed = driver[DEPART_SPEED]
    position = min(net.lane_floats[lane, LANE_LENGTH], driver[LENGTH] + POSITION_EPS)
    seen = -position
    leader = state.lanes[lane, LANE_BACK]
    if leader < 0:
        leader = tail_on(net, traffic, state, lane, v)
    reach = brake_gap(speed, driver[DECEL], 0.0, step_ms / 1000.0) + driver[MIN_GAP]
    while True:
        if leader >= 0:
            gap = seen + back_on(net, traffic, state, leader, lane) - driver[MIN_GAP]
            return gap >= secure_gap(driver, speed, state.floats[leader, SPEED]) and gap >= 0.0
        seen += net.lane_floats[lane, LANE_LENGTH]
        link = net.route_link[traffic.ints[v, ROUTE], lane]
        if seen >= reach or link < 0:
            return True
        lane = net.link_ints[link, LINK_NEXT]
        leader = last_on(net, traffic, state, lane, v)


@compiled
def enter(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Put vehicle ``v`` on the road."""
    floats, driver = state.floats, traffic.floats[v]
    floats[v, POSITION] = min(net.lane_floats[lane, LANE_LENGTH], driver[LENGTH] + POSITION_EPS)
    floats[v, SPEED], floats[v, ACCEL] = driver[DEPART_SPEED], 0.0
    state.ints[v, STATUS] = DRIVING
    state.ints[v, VARIANT] = find_variant(net, state, traffic.ints[v, ROUTE])
    place(state, v, lane)
    state.clock[ON_ROAD] += 1
