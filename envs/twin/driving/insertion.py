"""Insertion of vehicles: which ones are due, enter, wait, or are dropped as in SUMO."""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import brake_gap, free_speed, secure_gap, stop_speed
from izoo.envs.twin.driving.lane_queues import insert_into_lane, last_tail, last_vehicle, rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS
from izoo.envs.twin.driving.traffic_lights import ALLWAY_STOP, EQUAL, MINOR, PRIORITY_GREEN, STOP, is_major
from izoo.envs.twin.net.best_lanes import find_variant
from izoo.envs.twin.net.conflicts import DIVERGING
from izoo.envs.twin.runtime.layout import DRIVING, DROPPED, WAITING

ENTER, WAIT, DROP = range(3)
ROOM_RIGHT_M, ROOM_LEFT_M = 20.0, 40.0
"""Room that SUMO reserves at the end of a lane for vehicles that must change by two lanes or more."""


@compiled
def insert_vehicles(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Insert the vehicles that are due where there is room, per lane in the order of departure."""
    vehicles, clock = state.vehicles, state.clock
    now_ms = clock.now_ms
    count = traffic.drivers.shape[0]
    while clock.next_departure < count and traffic.drivers[clock.next_departure].depart_ms <= now_ms:
        v = clock.next_departure
        vehicles[v].status = WAITING
        lane = traffic.drivers[v].depart_lane
        last = state.waiting_last[lane]
        if last < 0:
            state.waiting_first[lane] = v
        else:
            state.waiting_next[last] = v
        state.waiting_last[lane] = v
        state.waiting_next[v] = -1
        clock.next_departure += 1
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
                vehicles[v].status = DROPPED
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
    driver = traffic.drivers[v]
    start, speed = lane, driver.depart_speed
    if state.vehicles[v].variant < 0:
        # Set once, although the signals may change while it waits.
        state.vehicles[v].variant = find_variant(net, state, traffic.drivers[v].route)
    desired = net.lanes[lane].limit
    position = min(net.lanes[lane].length, driver.length + POSITION_EPS)
    seen = -position
    leader = state.lanes[lane].back
    if leader < 0:
        leader = last_tail(net, traffic, state, lane, v)
    reach = brake_gap(speed, driver.decel, driver.tau, step_s) + driver.min_gap
    verdict = ENTER
    while True:
        if leader >= 0:
            gap = seen + rear_position(net, traffic, state, leader, lane) - driver.min_gap
            if gap < 0.0 or gap < secure_gap(driver, speed, state.vehicles[leader].speed):
                verdict = WAIT
                break
        seen += net.lanes[lane].length
        if seen >= reach:
            break
        link = net.route_link[traffic.drivers[v].route, lane]
        stops = stop_speed(driver, seen, speed, desired, driver.decel, step_s) >= speed
        if link < 0:
            if net.lanes[lane].edge != net.routes[traffic.drivers[v].route].exit_edge and not stops:
                verdict = DROP
            break
        letter = state.link_letter[link]
        if not is_major(letter):
            if not stops:
                verdict = DROP if _never_has_priority(net, link, letter) else WAIT
            break
        lane = net.links[link].next_lane
        if free_speed(driver, seen, speed, net.lanes[lane].limit, desired, step_s) < speed:
            verdict = DROP
            break
        onward = net.route_link[traffic.drivers[v].route, lane]
        if net.lanes[lane].inside and _is_crossed(net, state, onward):
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
    first = net.links[link].first_conflict
    for row in range(first, first + net.links[link].conflicts):
        kind, lane = net.conflicts[row].kind, net.conflicts[row].lane
        if kind != DIVERGING and _is_busy(state, lane):
            return True
    entry = net.links[link].entry
    first = net.links[entry].first_foe
    for k in range(first, first + net.links[entry].foes):
        lane = net.links[net.foes[k]].next_lane
        if net.lanes[lane].inside and _is_busy(state, lane):
            return True
    return False


@compiled
def _is_busy(state, lane):  # type: ignore[no-untyped-def]
    return state.lanes[lane].front >= 0 or state.lanes[lane].tails > 0


@compiled
def _too_fast_for_lane_changes(net, traffic, state, v, lane, position, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` would be too fast on ``lane`` to change by two lanes or more before its end.

    SUMO checks this at the position after one step. If the reserved room has begun by then, it does not check, and the
    vehicle enters.
    """
    variant = state.vehicles[v].variant
    offset = net.best[variant, lane].offset
    if -2 < offset < 2:
        return False
    driver = traffic.drivers[v]
    speed = driver.depart_speed
    room = ROOM_RIGHT_M if offset < 0 else ROOM_LEFT_M
    left = net.best[variant, lane].length - position - room - speed * step_s
    if left < 0.0:
        return False
    return stop_speed(driver, left, speed, net.lanes[lane].limit, driver.decel, step_s) < speed


@compiled
def _never_has_priority(net, link, letter):  # type: ignore[no-untyped-def]
    """Return whether ``link``, which shows ``letter`` now, never has priority."""
    if letter in (MINOR, EQUAL, STOP, ALLWAY_STOP):
        return True
    program = net.links[link].program
    if program < 0:
        return False
    first = net.programs[program].first_phase
    for phase in range(first, first + net.programs[program].phases):
        if net.phase_letters[net.phases[phase].state + net.links[link].signal] == PRIORITY_GREEN:
            return False
    return True


@compiled
def insert_vehicle(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Put vehicle ``v`` on the road."""
    vehicles, driver = state.vehicles, traffic.drivers[v]
    vehicles[v].position = min(net.lanes[lane].length, driver.length + POSITION_EPS)
    vehicles[v].speed, vehicles[v].accel = driver.depart_speed, 0.0
    vehicles[v].status = DRIVING
    insert_into_lane(state, v, lane)
    state.clock.on_road += 1
