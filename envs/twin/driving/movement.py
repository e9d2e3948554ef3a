"""From plans to positions: which links may be passed, the resulting speed, and the move."""

from __future__ import annotations

import math

from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, max_speed, min_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import clear_tail, remove_from_lane, set_tail
from izoo.envs.twin.driving.link_planning import SPEED_EPS
from izoo.envs.twin.driving.tolerances import EPS, POSITION_EPS, STANDING_MPS, VISIBILITY_M
from izoo.envs.twin.driving.traffic_lights import OFF_YELLOW, RED, YELLOW
from izoo.envs.twin.junction.right_of_way import lose_right_of_way, may_pass, note_request, pass_link, slows_before
from izoo.envs.twin.lane_change.blinkers import blinkers
from izoo.envs.twin.lane_change.cooperation import advised_speed
from izoo.envs.twin.lane_change.downstream_occupancy import remember_downstream_occupancy
from izoo.envs.twin.net.best_lanes import find_variant
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACCEL,
    ARRIVED,
    COMMAND,
    DECEL,
    EMERGENCY_DECEL,
    FIRST_ITEM,
    FREE_SPEED,
    HAS_TO_WAIT,
    ITEM_DISTANCE,
    ITEM_LINK,
    ITEM_PASS,
    ITEM_REQUEST,
    ITEM_WAIT,
    ITEMS,
    LANE,
    LANE_EDGE,
    LANE_INSIDE,
    LANE_LENGTH,
    LINK_CONT,
    LINK_NEXT,
    LINK_PROGRAM,
    MAX_ACCEL,
    MAX_TAIL_LANES,
    ON_ROAD,
    POSITION,
    ROUTE,
    SIGNALS,
    SPEED,
    STATUS,
    TAIL_LANES,
    TOP_SPEED,
    VARIANT,
    WAITING_MS,
)


@compiled
def safe_speed(net, traffic, state, v, step_ms):  # type: ignore[no-untyped-def]
    """Return the highest speed (m/s) that the links ahead of vehicle ``v`` allow, and the least to clear one.

    Records whether it has to wait, and that it loses its right of way in a junction where it does not request to go on.
    """
    step_s = step_ms / 1000.0
    driver = traffic.floats[v]
    speed = state.floats[v, SPEED]
    comfortable = brake_gap(speed, driver[DECEL], 0.0, step_s)
    fastest = max_speed(driver, speed, state.floats[v, TOP_SPEED], step_s)
    safe = fastest
    needed = needed_wait = needed_m = 0.0
    needed_can_brake = waits = False
    slowest = min_speed(driver, speed, step_s)
    first = state.ints[v, FIRST_ITEM]
    for item in range(first, first + state.ints[v, ITEMS]):
        values, numbers = state.item_floats[item], state.item_ints[item]
        link, distance = numbers[ITEM_LINK], values[ITEM_DISTANCE]
        if link < 0 or not numbers[ITEM_REQUEST]:
            safe = values[ITEM_WAIT]
            waits = waits or (link >= 0 and safe < speed)
            if link >= 0:
                lose_right_of_way(net, state, v, link)
            break
        letter = state.link_letter[link]
        can_brake = distance > comfortable
        yellow = letter in (YELLOW, OFF_YELLOW)
        if yellow and can_brake:
            safe, waits = values[ITEM_WAIT], True
            break
        if yellow or may_pass(net, traffic, state, item, step_ms):
            if not net.link_ints[link, LINK_CONT] and slows_before(net, state, link):
                if distance > VISIBILITY_M and (can_brake or not yellow):
                    safe, waits = values[ITEM_WAIT], True
                    break
                needed_wait, needed_m, needed_can_brake = values[ITEM_WAIT], distance, can_brake
                needed = min((distance + POSITION_EPS) / step_s, values[ITEM_PASS], fastest)
            safe = values[ITEM_PASS]
            waits = waits or (safe < driver[DECEL] and safe <= values[ITEM_WAIT] and safe < fastest)
        elif (
            not can_brake
            and net.link_ints[link, LINK_PROGRAM] < 0
            and distance < brake_gap(speed, driver[EMERGENCY_DECEL], 0.0, step_s)
        ):
            safe = values[ITEM_PASS]
        else:
            safe, waits = values[ITEM_WAIT], True
            break
    if safe + EPS < needed:
        # It would not clear the minor link: it stops before it, if it can.
        if safe >= speed:
            if net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 1:
                safe = max(safe, needed_wait)
        elif needed_can_brake:
            desired = desired_speed(net, state, v, state.ints[v, LANE])
            stop = stop_speed(driver, needed_m, speed, desired, driver[DECEL], step_s)
            safe, waits = min(safe, max(slowest, stop)), True
        # A vehicle that goes on is not slowed for lane changes.
        needed = 0.0 if waits and safe < speed else min(needed, safe)
    state.ints[v, HAS_TO_WAIT] = waits
    return safe, needed


@compiled
def next_speed(net, traffic, state, v, safe, needed, step_ms):  # type: ignore[no-untyped-def]
    """Return the speed of the coming step within the vehicle's limits, and record the one without a command."""
    step_s = step_ms / 1000.0
    floats, driver = state.floats, traffic.floats[v]
    speed = floats[v, SPEED]
    hardest = max(0.0, speed - driver[EMERGENCY_DECEL] * step_s)
    slowest = min_speed(driver, speed, step_s)
    fastest = max_speed(driver, speed, floats[v, TOP_SPEED], step_s)
    limit = desired_speed(net, state, v, state.ints[v, LANE])
    low = min(slowest, max(safe, hardest))
    high = max(low, min(fastest, safe, max(limit, safe)))
    result = advised_speed(net, traffic, state, v, low, high, high, step_s)
    if result > 0.0:
        result = max(result, needed)
    if result < SPEED_EPS * step_s:
        result = 0.0
    floats[v, FREE_SPEED] = result
    command = floats[v, COMMAND]
    if not math.isnan(command):
        result = max(min(command, safe, min(fastest, limit)), slowest)
    return result


@compiled
def drive(net, traffic, state, v, moved, count, step_ms):  # type: ignore[no-untyped-def]
    """Set the speed of vehicle ``v`` and move it; return how many vehicles have left their lane so far.

    Args:
        moved: ``[N]`` working memory; the first ``count`` have left their lane and are in no queue.
    """
    step_s = step_ms / 1000.0
    floats, ints = state.floats, state.ints
    safe, needed = safe_speed(net, traffic, state, v, step_ms)
    speed = next_speed(net, traffic, state, v, safe, needed, step_ms)
    accel = (speed - floats[v, SPEED]) / step_s
    floats[v, ACCEL], floats[v, SPEED] = accel, speed
    if speed <= STANDING_MPS and accel <= 0.5 * traffic.floats[v, MAX_ACCEL]:
        ints[v, WAITING_MS] += step_ms
    else:
        ints[v, WAITING_MS] = 0
    floats[v, POSITION] += speed * step_s
    lane, has_left = ints[v, LANE], False
    if floats[v, POSITION] > net.lane_floats[lane, LANE_LENGTH]:
        remove_from_lane(state, v)
        lane = advance(net, traffic, state, v)
        has_left = True
    elif ints[v, TAIL_LANES] > 0:
        kept = ints[v, TAIL_LANES]
        clear_tail(state, v)
        set_tail(net, traffic, state, v, kept)
    on_exit = net.lane_ints[lane, LANE_EDGE] == net.route_exit_edge[traffic.ints[v, ROUTE]]
    if on_exit and floats[v, POSITION] > net.lane_floats[lane, LANE_LENGTH] - POSITION_EPS:
        if not has_left:
            remove_from_lane(state, v)
        clear_tail(state, v)
        ints[v, STATUS] = ARRIVED
        state.clock[ON_ROAD] -= 1
    elif has_left:
        moved[count] = v
        count += 1
    note_request(net, state, v)
    ints[v, SIGNALS] = blinkers(net, state, v)
    return count


@compiled
def advance(net, traffic, state, v):  # type: ignore[no-untyped-def]
    """Move vehicle ``v``, past the end of its lane, along its route; return the lane that it comes to.

    At the end of a lane that does not continue the route, or at a red light, it stops at once.
    """
    floats, ints = state.floats, state.ints
    lane, kept = ints[v, LANE], ints[v, TAIL_LANES]
    clear_tail(state, v)
    while floats[v, POSITION] > net.lane_floats[lane, LANE_LENGTH]:
        link = net.best_link[ints[v, VARIANT], lane]
        if link < 0 or state.link_letter[link] == RED:
            if net.lane_ints[lane, LANE_EDGE] != net.route_exit_edge[traffic.ints[v, ROUTE]]:
                floats[v, POSITION], floats[v, SPEED] = net.lane_floats[lane, LANE_LENGTH], 0.0
            break
        kept = min(kept + 1, MAX_TAIL_LANES)
        for k in range(kept - 1, 0, -1):
            state.tail_lane[v, k] = state.tail_lane[v, k - 1]
        state.tail_lane[v, 0] = lane
        floats[v, POSITION] -= net.lane_floats[lane, LANE_LENGTH]
        pass_link(net, state, v, link)
        lane = net.link_ints[link, LINK_NEXT]
        if not net.lane_ints[lane, LANE_INSIDE]:
            ints[v, VARIANT] = find_variant(net, state, traffic.ints[v, ROUTE])
    ints[v, LANE] = lane
    remember_downstream_occupancy(net, state, state.lane_room_before, v, lane)
    set_tail(net, traffic, state, v, kept)
    return lane
