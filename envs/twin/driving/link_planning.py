"""The plan of every vehicle for the coming step, from the state at its beginning.

A vehicle looks along its route from lane to lane and makes an item for every link: its speed if it passes the link, its
speed if it stops before it, and its arrival time. The items end at a red light, at the end of the route or of a lane
that does not continue it, or where the vehicle could stop in time and has seen enough road beyond.
"""

from __future__ import annotations

import math

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
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    AHEAD,
    COMMAND,
    DECEL,
    EMERGENCY_DECEL,
    FIRST_ITEM,
    ITEM_ARRIVAL_MS,
    ITEM_ARRIVAL_SPEED,
    ITEM_BRAKED_SPEED,
    ITEM_DISTANCE,
    ITEM_LEAVE_MS,
    ITEM_LEAVE_SPEED,
    ITEM_LINK,
    ITEM_NEXT,
    ITEM_PASS,
    ITEM_PASSAGE,
    ITEM_REQUEST,
    ITEM_TOTAL,
    ITEM_VEHICLE,
    ITEM_WAIT,
    ITEMS,
    LANE,
    LANE_EDGE,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_LIMIT,
    LANE_TAILS,
    LENGTH,
    LINK_NEXT,
    LINK_VIA,
    MAX_ACCEL,
    MAX_ITEMS_PER_VEHICLE,
    MIN_GAP,
    NOW_MS,
    POSITION,
    ROUTE,
    SPEED,
    TAU,
    TOP_SPEED,
    VARIANT,
)

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
    floats, ints = state.floats, state.ints
    driver = traffic.floats[v]
    route = traffic.ints[v, ROUTE]
    variant = ints[v, VARIANT]
    speed, lane = floats[v, SPEED], ints[v, LANE]
    top = floats[v, TOP_SPEED]
    desired = min(net.lane_floats[lane, LANE_LIMIT], top)
    fastest = max_speed(driver, speed, top, step_s)
    slowest = min_speed(driver, speed, step_s)
    reach = fastest * step_s + brake_gap(fastest, driver[DECEL], driver[TAU], step_s)
    seen = net.lane_floats[lane, LANE_LENGTH] - floats[v, POSITION]
    inside = net.lane_ints[lane, LANE_INSIDE] == 1
    seen_roads, seen_inside = 0.0, seen if inside else 0.0
    best = min(fastest, desired)
    command = floats[v, COMMAND]
    if not math.isnan(command):
        best = max(min(command, best), slowest)
    passing = min(desired, accelerated_speed(seen, best, driver[MAX_ACCEL], top))
    beyond = slowed_for_minor = False
    lane_limit = desired
    # On a free road the speed depends on the limit alone, which most lanes share.
    free_limit, freely = -1.0, 0.0
    first = state.clock[ITEM_TOTAL]
    count = 0
    leader = ints[v, AHEAD]
    if leader < 0 and state.lanes[lane, LANE_TAILS] > 0:
        leader = last_tail(net, traffic, state, lane, v)
    while True:
        if leader >= 0:
            back = rear_position(net, traffic, state, leader, lane)
            gap = back - floats[v, POSITION] if count == 0 else back + seen - net.lane_floats[lane, LANE_LENGTH]
            safe = follow_speed(driver, gap - driver[MIN_GAP], speed, floats[leader, SPEED], desired, step_s)
            if count == 0 and inside and ints[leader, LANE] != lane and gap < driver[MIN_GAP]:
                # Behind a vehicle that has left the junction except for its tail.
                safe = 0.0
            best = min(best, safe)
            passing = min(passing, best)
            if count > 0:
                # The leave speed of the last link is that of following from there at the present gap.
                leave = state.item_floats[first + count - 1, ITEM_LEAVE_SPEED]
                later = follow_speed(driver, gap - driver[MIN_GAP], leave, floats[leader, SPEED], desired, step_s)
                state.item_floats[first + count - 1, ITEM_LEAVE_SPEED] = min(leave, later)
        item = first + count
        values, numbers = state.item_floats[item], state.item_ints[item]
        if count > 0:
            state.item_floats[item - 1, ITEM_WAIT] = min(state.item_floats[item - 1, ITEM_WAIT], best)
        numbers[ITEM_VEHICLE], numbers[ITEM_LINK], numbers[ITEM_NEXT], numbers[ITEM_REQUEST] = v, -1, -1, 0
        values[ITEM_DISTANCE] = seen
        count += 1
        link = net.best_link[variant, lane]
        if link < 0:
            if net.lane_ints[lane, LANE_EDGE] == net.route_exit_edge[route]:
                safe = max(EPS, free_speed(driver, seen, speed, lane_limit, desired, step_s))
            else:
                safe = stop_speed(driver, seen, speed, desired, driver[DECEL], step_s)
            best = min(best, safe)
            if count > 1:
                state.item_floats[item - 1, ITEM_LEAVE_SPEED] = min(state.item_floats[item - 1, ITEM_LEAVE_SPEED], safe)
            values[ITEM_PASS] = values[ITEM_WAIT] = best
            break
        letter = state.link_letter[link]
        stopped = is_red_or_yellow(letter)
        decel = driver[DECEL]
        if stopped:
            decel = max(decel, min(YELLOW_DECEL_MPS2, driver[EMERGENCY_DECEL]))
        braking = brake_gap(speed, decel, 0.0, step_s)
        offset = STOP_LINE_GAP_M if stopped or is_major(letter) else 0.0
        if seen >= braking:
            offset = min(offset, seen - braking)
        offset = max(POSITION_EPS, offset)
        waiting = min(best, stop_speed(driver, max(0.0, seen - offset), speed, desired, decel, step_s))
        numbers[ITEM_LINK] = link
        values[ITEM_WAIT] = waiting
        values[ITEM_PASS] = passing
        leaving = inside and count == 1
        request = (best > SPEED_EPS * step_s and not (slowed_for_minor and not inside)) or leaving
        if stopped and seen >= braking:
            values[ITEM_ARRIVAL_SPEED] = values[ITEM_LEAVE_SPEED] = values[ITEM_PASSAGE] = 0.0
            numbers[ITEM_ARRIVAL_MS] = state.clock[NOW_MS] + int(1000.0 * seen / max(waiting, EPS))
            break
        before = best
        floor = state.item_floats[item - 1, ITEM_WAIT] if count > 1 else 0.0
        restricted = limit_by_foes(net, traffic, state, v, link, seen, Plan(best, passing, request), floor, step_s)
        best, passing, request = restricted
        if best < before and count > 1:
            state.item_floats[item - 1, ITEM_LEAVE_SPEED] = min(state.item_floats[item - 1, ITEM_LEAVE_SPEED], best)
        values[ITEM_WAIT] = min(values[ITEM_WAIT], best)
        arrival_speed = passing
        if slows_before(net, state, link) and braking < seen and seen > VISIBILITY_M:
            seeing = safe_stop_speed(VISIBILITY_M, driver[DECEL], 0.0, step_s)
            arrival_speed = min(passing, accelerated_speed(VISIBILITY_M, seeing, driver[MAX_ACCEL], top))
            slowed_for_minor = True
        enter_ms = state.clock[NOW_MS] - step_ms + int(1000.0 * arrival_time_s(driver, seen, best, arrival_speed) + 0.5)
        next_lane = net.link_ints[link, LINK_NEXT]
        next_length = net.lane_floats[next_lane, LANE_LENGTH]
        lane_limit = min(net.lane_floats[next_lane, LANE_LIMIT], top)
        inside_m = next_length if net.lane_ints[next_lane, LANE_INSIDE] == 1 else 0.0
        leave_speed = min(lane_limit, accelerated_speed(inside_m, arrival_speed, driver[MAX_ACCEL], top))
        values[ITEM_PASS] = best
        values[ITEM_ARRIVAL_SPEED], values[ITEM_LEAVE_SPEED] = arrival_speed, leave_speed
        values[ITEM_BRAKED_SPEED] = braked_speed(driver, seen, best, arrival_speed, step_s)
        values[ITEM_PASSAGE] = inside_m + driver[LENGTH]
        numbers[ITEM_ARRIVAL_MS], numbers[ITEM_REQUEST] = enter_ms, request
        if count == MAX_ITEMS_PER_VEHICLE:
            break
        if not request or best <= 0.0 or seen > reach:
            length = driver[LENGTH]
            if beyond and seen_roads > max(seen_inside + length, LOOK_BEYOND_LENGTHS * length):
                break
        beyond = beyond or net.link_ints[link, LINK_VIA] < 0
        lane = next_lane
        inside = net.lane_ints[lane, LANE_INSIDE] == 1
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
        passing = min(accelerated_speed(next_length, best, driver[MAX_ACCEL], top), lane_limit)
        leader = last_vehicle(net, traffic, state, lane, v)
    ints[v, FIRST_ITEM], ints[v, ITEMS] = first, count
    state.clock[ITEM_TOTAL] = first + count


@compiled
def register_approaches(state):  # type: ignore[no-untyped-def]
    """Register every item with its link."""
    for link in range(state.link_first.shape[0]):
        state.link_first[link] = -1
    for item in range(state.clock[ITEM_TOTAL]):
        link = state.item_ints[item, ITEM_LINK]
        if link >= 0:
            values, numbers = state.item_floats[item], state.item_ints[item]
            mean = max(0.5 * (values[ITEM_ARRIVAL_SPEED] + values[ITEM_LEAVE_SPEED]), EPS)
            numbers[ITEM_LEAVE_MS] = numbers[ITEM_ARRIVAL_MS] + int(1000.0 * values[ITEM_PASSAGE] / mean + 0.5)
            state.item_ints[item, ITEM_NEXT] = state.link_first[link]
            state.link_first[link] = item
