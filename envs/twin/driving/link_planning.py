"""The plan of every vehicle for the coming step, from the state at its beginning.

A vehicle looks along its route from lane to lane and makes an item for every link: its speed if it passes the link, its
speed if it stops before it, and its arrival time. The items end at a red light, at the end of the route or of a lane
that does not continue it, or where the vehicle could stop in time and has seen enough road beyond.
"""

from __future__ import annotations

import math

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import (
    accelerated_speed,
    arrival_time_s,
    brake_gap,
    braked_speed,
    follow_speed,
    free_speed,
    limit_ahead,
    max_speed,
    min_speed,
    safe_stop_speed,
    stop_speed,
    unlimited_speed,
)
from izoo.envs.twin.driving.lane_queues import last_tail, last_vehicle, rear_position
from izoo.envs.twin.driving.tolerances import EPS, POSITION_EPS, VISIBILITY_M
from izoo.envs.twin.driving.traffic_lights import is_major, is_red_or_yellow
from izoo.envs.twin.junction.foes import Plan, limit_by_foes
from izoo.envs.twin.junction.right_of_way import slows_before
from izoo.envs.twin.runtime.layout import MAX_ITEMS_PER_VEHICLE

STOP_LINE_GAP_M = 1.0
YELLOW_DECEL_MPS2 = 3.0
LOOK_BEYOND_LENGTHS = 5.0
"""Road that a driver sees beyond a junction, in lengths of its vehicle; at least one length more than inside."""
SPEED_EPS = 1e-4
"""A speed (m/s) below this times the step (s) counts as 0."""


@compiled
def plan(net, traffic, state, v, step_ms):  # type: ignore[no-untyped-def]
    """Make the items of vehicle ``v``."""
    step_s = step_ms / 1000.0
    vehicles = state.vehicles
    driver = traffic.drivers[v]
    route = driver.route
    variant = vehicles[v].variant
    speed, lane = vehicles[v].speed, vehicles[v].lane
    top = vehicles[v].top_speed
    desired = min(net.lanes[lane].limit, top)
    fastest = max_speed(driver, speed, top, step_s)
    slowest = min_speed(driver, speed, step_s)
    reach = fastest * step_s + brake_gap(fastest, driver.decel, driver.tau, step_s)
    seen = net.lanes[lane].length - vehicles[v].position
    inside = net.lanes[lane].inside == 1
    seen_roads, seen_inside = 0.0, seen if inside else 0.0
    best = min(fastest, desired)
    command = vehicles[v].command
    if not math.isnan(command):
        best = max(min(command, best), slowest)
    passing = min(desired, accelerated_speed(seen, best, driver.max_accel, top))
    beyond = slowed_for_minor = False
    lane_limit = desired
    # On a free road the speed depends on the limit alone, which most lanes share.
    free_limit, freely = -1.0, 0.0
    first = state.clock.items
    count = 0
    leader = vehicles[v].ahead
    if leader < 0 and state.lanes[lane].tails > 0:
        leader = last_tail(net, traffic, state, lane, v)
    while True:
        if leader >= 0:
            back = rear_position(net, traffic, state, leader, lane)
            gap = back - vehicles[v].position if count == 0 else back + seen - net.lanes[lane].length
            safe = follow_speed(driver, gap - driver.min_gap, speed, vehicles[leader].speed, desired, step_s)
            if count == 0 and inside and vehicles[leader].lane != lane and gap < driver.min_gap:
                # Behind a vehicle that has left the junction except for its tail.
                safe = 0.0
            best = min(best, safe)
            passing = min(passing, best)
            if count > 0:
                # The leave speed of the last link is that of following from there at the present gap.
                leave = state.items[first + count - 1].leave_speed
                later = follow_speed(driver, gap - driver.min_gap, leave, vehicles[leader].speed, desired, step_s)
                state.items[first + count - 1].leave_speed = min(leave, later)
        item = first + count
        planned = state.items[item]
        if count > 0:
            state.items[item - 1].wait_speed = min(state.items[item - 1].wait_speed, best)
        planned.vehicle, planned.link, planned.next, planned.request = v, -1, -1, 0
        planned.distance = seen
        count += 1
        link = net.best[variant, lane].link
        if link < 0:
            if net.lanes[lane].edge == net.routes[route].exit_edge:
                safe = max(EPS, free_speed(driver, seen, speed, lane_limit, desired, step_s))
            else:
                safe = stop_speed(driver, seen, speed, desired, driver.decel, step_s)
            best = min(best, safe)
            if count > 1:
                state.items[item - 1].leave_speed = min(state.items[item - 1].leave_speed, safe)
            planned.pass_speed = planned.wait_speed = best
            break
        letter = state.link_letter[link]
        stopped = is_red_or_yellow(letter)
        decel = driver.decel
        if stopped:
            decel = max(decel, min(YELLOW_DECEL_MPS2, driver.emergency_decel))
        braking = brake_gap(speed, decel, 0.0, step_s)
        offset = STOP_LINE_GAP_M if stopped or is_major(letter) else 0.0
        if seen >= braking:
            offset = min(offset, seen - braking)
        offset = max(POSITION_EPS, offset)
        waiting = min(best, stop_speed(driver, max(0.0, seen - offset), speed, desired, decel, step_s))
        planned.link = link
        planned.wait_speed = waiting
        planned.pass_speed = passing
        leaving = inside and count == 1
        request = (best > SPEED_EPS * step_s and not (slowed_for_minor and not inside)) or leaving
        if stopped and seen >= braking:
            planned.arrival_speed = planned.leave_speed = planned.passage = 0.0
            planned.arrival_ms = state.clock.now_ms + int(1000.0 * seen / max(waiting, EPS))
            break
        before = best
        floor = state.items[item - 1].wait_speed if count > 1 else 0.0
        restricted = limit_by_foes(net, traffic, state, v, link, seen, Plan(best, passing, request), floor, step_s)
        best, passing, request = restricted
        if best < before and count > 1:
            state.items[item - 1].leave_speed = min(state.items[item - 1].leave_speed, best)
        planned.wait_speed = min(planned.wait_speed, best)
        arrival_speed = passing
        if slows_before(net, state, link) and braking < seen and seen > VISIBILITY_M:
            seeing = safe_stop_speed(VISIBILITY_M, driver.decel, 0.0, step_s)
            arrival_speed = min(passing, accelerated_speed(VISIBILITY_M, seeing, driver.max_accel, top))
            slowed_for_minor = True
        enter_ms = state.clock.now_ms - step_ms + int(1000.0 * arrival_time_s(driver, seen, best, arrival_speed) + 0.5)
        next_lane = net.links[link].next_lane
        next_length = net.lanes[next_lane].length
        lane_limit = min(net.lanes[next_lane].limit, top)
        inside_m = next_length if net.lanes[next_lane].inside == 1 else 0.0
        leave_speed = min(lane_limit, accelerated_speed(inside_m, arrival_speed, driver.max_accel, top))
        planned.pass_speed = best
        planned.arrival_speed, planned.leave_speed = arrival_speed, leave_speed
        planned.braked_speed = braked_speed(driver, seen, best, arrival_speed, step_s)
        planned.passage = inside_m + driver.length
        planned.arrival_ms, planned.request = enter_ms, request
        if count == MAX_ITEMS_PER_VEHICLE:
            break
        if not request or best <= 0.0 or seen > reach:
            length = driver.length
            if beyond and seen_roads > max(seen_inside + length, LOOK_BEYOND_LENGTHS * length):
                break
        beyond = beyond or net.links[link].via_lane < 0
        lane = next_lane
        inside = net.lanes[lane].inside == 1
        if speed > lane_limit:
            free = free_speed(driver, seen, speed, lane_limit, desired, step_s)
        else:
            if lane_limit != free_limit:
                free_limit, freely = lane_limit, unlimited_speed(driver, speed, lane_limit, desired, step_s)
            free = limit_ahead(driver, seen, freely, lane_limit)
        best = min(best, max(free, slowest - EPS))
        if inside:
            seen_inside += next_length
        else:
            seen_roads += next_length
        seen += next_length
        passing = min(accelerated_speed(next_length, best, driver.max_accel, top), lane_limit)
        leader = last_vehicle(net, traffic, state, lane, v)
    vehicles[v].first_item, vehicles[v].items = first, count
    state.clock.items = first + count


@compiled
def register_approaches(state):  # type: ignore[no-untyped-def]
    """Register every item with its link."""
    for link in range(state.link_first.shape[0]):
        state.link_first[link] = -1
    for item in range(state.clock.items):
        planned = state.items[item]
        if planned.link >= 0:
            mean = max(0.5 * (planned.arrival_speed + planned.leave_speed), EPS)
            planned.leave_ms = planned.arrival_ms + int(1000.0 * planned.passage / mean + 0.5)
            planned.next = state.link_first[planned.link]
            state.link_first[planned.link] = item
