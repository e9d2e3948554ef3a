"""From plans to positions: which links may be passed, the resulting speed, and the move."""

from __future__ import annotations

import math

from izoo.envs.tables import compiled
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
from izoo.envs.twin.runtime.layout import ARRIVED, MAX_TAIL_LANES


@compiled
def safe_speed(net, traffic, state, v, step_ms):  # type: ignore[no-untyped-def]
    """Return the highest speed (m/s) that the links ahead of vehicle ``v`` allow, and the least to clear one.

    Records whether it has to wait, and that it loses its right of way in a junction where it does not request to go on.
    """
    step_s = step_ms / 1000.0
    driver = traffic.drivers[v]
    speed = state.vehicles[v].speed
    comfortable = brake_gap(speed, driver.decel, 0.0, step_s)
    fastest = max_speed(driver, speed, state.vehicles[v].top_speed, step_s)
    safe = fastest
    needed = needed_wait = needed_m = 0.0
    needed_can_brake = waits = False
    slowest = min_speed(driver, speed, step_s)
    first = state.vehicles[v].first_item
    for item in range(first, first + state.vehicles[v].items):
        planned = state.items[item]
        link, distance = planned.link, planned.distance
        if link < 0 or not planned.request:
            safe = planned.wait_speed
            waits = waits or (link >= 0 and safe < speed)
            if link >= 0:
                lose_right_of_way(net, state, v, link)
            break
        letter = state.link_letter[link]
        can_brake = distance > comfortable
        yellow = letter in (YELLOW, OFF_YELLOW)
        if yellow and can_brake:
            safe, waits = planned.wait_speed, True
            break
        if yellow or may_pass(net, traffic, state, item, step_ms):
            if not net.links[link].cont and slows_before(net, state, link):
                if distance > VISIBILITY_M and (can_brake or not yellow):
                    safe, waits = planned.wait_speed, True
                    break
                needed_wait, needed_m, needed_can_brake = planned.wait_speed, distance, can_brake
                needed = min((distance + POSITION_EPS) / step_s, planned.pass_speed, fastest)
            safe = planned.pass_speed
            waits = waits or (safe < driver.decel and safe <= planned.wait_speed and safe < fastest)
        elif (
            not can_brake
            and net.links[link].program < 0
            and distance < brake_gap(speed, driver.emergency_decel, 0.0, step_s)
        ):
            safe = planned.pass_speed
        else:
            safe, waits = planned.wait_speed, True
            break
    if safe + EPS < needed:
        # It would not clear the minor link: it stops before it, if it can.
        if safe >= speed:
            if net.lanes[state.vehicles[v].lane].inside == 1:
                safe = max(safe, needed_wait)
        elif needed_can_brake:
            desired = desired_speed(net, state, v, state.vehicles[v].lane)
            stop = stop_speed(driver, needed_m, speed, desired, driver.decel, step_s)
            safe, waits = min(safe, max(slowest, stop)), True
        # A vehicle that goes on is not slowed for lane changes.
        needed = 0.0 if waits and safe < speed else min(needed, safe)
    state.vehicles[v].has_to_wait = waits
    return safe, needed


@compiled
def next_speed(net, traffic, state, v, safe, needed, step_ms):  # type: ignore[no-untyped-def]
    """Return the speed of the coming step within the vehicle's limits, and record the one without a command."""
    step_s = step_ms / 1000.0
    vehicles, driver = state.vehicles, traffic.drivers[v]
    speed = vehicles[v].speed
    hardest = max(0.0, speed - driver.emergency_decel * step_s)
    slowest = min_speed(driver, speed, step_s)
    fastest = max_speed(driver, speed, vehicles[v].top_speed, step_s)
    limit = desired_speed(net, state, v, vehicles[v].lane)
    low = min(slowest, max(safe, hardest))
    high = max(low, min(fastest, safe, max(limit, safe)))
    result = advised_speed(net, traffic, state, v, low, high, high, step_s)
    if result > 0.0:
        result = max(result, needed)
    if result < SPEED_EPS * step_s:
        result = 0.0
    vehicles[v].free_speed = result
    command = vehicles[v].command
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
    vehicles = state.vehicles
    safe, needed = safe_speed(net, traffic, state, v, step_ms)
    speed = next_speed(net, traffic, state, v, safe, needed, step_ms)
    accel = (speed - vehicles[v].speed) / step_s
    vehicles[v].accel, vehicles[v].speed = accel, speed
    if speed <= STANDING_MPS and accel <= 0.5 * traffic.drivers[v].max_accel:
        vehicles[v].waiting_ms += step_ms
    else:
        vehicles[v].waiting_ms = 0
    vehicles[v].position += speed * step_s
    lane, has_left = vehicles[v].lane, False
    if vehicles[v].position > net.lanes[lane].length:
        remove_from_lane(state, v)
        lane = advance(net, traffic, state, v)
        has_left = True
    elif vehicles[v].tail_lanes > 0:
        kept = vehicles[v].tail_lanes
        clear_tail(state, v)
        set_tail(net, traffic, state, v, kept)
    on_exit = net.lanes[lane].edge == net.routes[traffic.drivers[v].route].exit_edge
    if on_exit and vehicles[v].position > net.lanes[lane].length - POSITION_EPS:
        if not has_left:
            remove_from_lane(state, v)
        clear_tail(state, v)
        vehicles[v].status = ARRIVED
        state.clock.on_road -= 1
    elif has_left:
        moved[count] = v
        count += 1
    note_request(net, state, v)
    vehicles[v].signals = blinkers(net, state, v)
    return count


@compiled
def advance(net, traffic, state, v):  # type: ignore[no-untyped-def]
    """Move vehicle ``v``, past the end of its lane, along its route; return the lane that it comes to.

    At the end of a lane that does not continue the route, or at a red light, it stops at once.
    """
    vehicles = state.vehicles
    lane, kept = vehicles[v].lane, vehicles[v].tail_lanes
    clear_tail(state, v)
    while vehicles[v].position > net.lanes[lane].length:
        link = net.best[vehicles[v].variant, lane].link
        if link < 0 or state.link_letter[link] == RED:
            if net.lanes[lane].edge != net.routes[traffic.drivers[v].route].exit_edge:
                vehicles[v].position, vehicles[v].speed = net.lanes[lane].length, 0.0
            break
        kept = min(kept + 1, MAX_TAIL_LANES)
        for k in range(kept - 1, 0, -1):
            state.tail_lane[v, k] = state.tail_lane[v, k - 1]
        state.tail_lane[v, 0] = lane
        vehicles[v].position -= net.lanes[lane].length
        pass_link(net, state, v, link)
        lane = net.links[link].next_lane
        if not net.lanes[lane].inside:
            vehicles[v].variant = find_variant(net, state, traffic.drivers[v].route)
    vehicles[v].lane = lane
    remember_downstream_occupancy(net, state, state.lane_room_before, v, lane)
    set_tail(net, traffic, state, v, kept)
    return lane
