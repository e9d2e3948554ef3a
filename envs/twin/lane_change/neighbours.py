"""Neighbours of a lane-changing vehicle: leaders and followers on the lanes of an edge, and beyond its ends."""

from __future__ import annotations

import math
from typing import NamedTuple

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, secure_gap
from izoo.envs.twin.driving.lane_queues import last_tail, last_vehicle, rear_position
from izoo.envs.twin.driving.tolerances import STANDING_MPS
from izoo.envs.twin.driving.traffic_lights import is_major
from izoo.envs.twin.junction.leaders import leader_in_conflict
from izoo.envs.twin.net.conflicts import DIVERGING

_MAX_BRAKING_M = 1000.0
_MAX_LANES_BEHIND = 32


class Neighbours(NamedTuple):
    """Vehicles around a vehicle that considers a change to the target lane (-1: none), and the gaps to them.

    Gaps are in m, less the standstill gap of the follower.
    """

    leader: int
    leader_gap: float
    target_leader: int
    target_leader_gap: float
    target_follower: int
    target_follower_gap: float


@compiled
def leader_on_lane(net, traffic, state, v, lane, step_s):  # type: ignore[no-untyped-def]
    """Return the leader of ``v`` on ``lane`` of its edge, or -1, and the gap (m, less the standstill gap)."""
    vehicles = state.vehicles
    if lane == vehicles[v].lane:
        leader = vehicles[v].ahead
    else:
        behind = state.changer[lane].next
        leader = vehicles[behind].ahead if behind >= 0 else state.lanes[lane].back
    front, min_gap = vehicles[v].position, traffic.drivers[v].min_gap
    if leader >= 0:
        return leader, vehicles[leader].position - traffic.drivers[leader].length - front - min_gap
    if state.lanes[lane].tails > 0:
        leader = last_tail(net, traffic, state, lane, v)
        if leader >= 0:
            return leader, rear_position(net, traffic, state, leader, lane) - front - min_gap
    return leader_beyond(net, traffic, state, v, lane, True, step_s)


@compiled
def leader_beyond(net, traffic, state, v, lane, nearest, step_s):  # type: ignore[no-untyped-def]
    """Search for a leader past the end of ``lane`` within the braking distance, also past red lights.

    Args:
        nearest: take the first one; otherwise the one that restricts ``v`` most.

    Returns:
        The vehicle, or -1; the gap (m, less the standstill gap).
    """
    driver, speed = traffic.drivers[v], state.vehicles[v].speed
    variant = state.vehicles[v].variant
    reach = brake_gap(speed, driver.decel, driver.tau, step_s) + driver.min_gap
    seen = net.lanes[lane].length - state.vehicles[v].position
    desired = desired_speed(net, state, v, state.vehicles[v].lane)
    found, found_gap, least = -1, 0.0, math.inf
    while seen <= reach or net.lanes[lane].inside:
        link = net.best[variant, lane].link
        if link < 0:
            break
        lane = net.links[link].next_lane
        for on_lane in range(2):
            if on_lane:
                leader, gap = last_vehicle(net, traffic, state, lane, v), 0.0
                if leader >= 0:
                    gap = seen + rear_position(net, traffic, state, leader, lane) - driver.min_gap
            else:
                leader, gap = leader_in_conflict(net, traffic, state, v, link, seen, step_s)
            if leader < 0:
                continue
            if nearest:
                return leader, gap
            safe = 0.0
            if gap >= 0.0:
                safe = follow_speed(driver, gap, speed, state.vehicles[leader].speed, desired, step_s)
            if safe < least:
                found, found_gap, least = leader, gap, safe
        limit = desired_speed(net, state, v, lane)
        if limit < speed:
            reach = brake_gap(limit, driver.decel, driver.tau, step_s)
        seen += net.lanes[lane].length
    return found, found_gap


@compiled
def follower_on_lane(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the follower of ``v`` on ``lane`` of its edge, or -1, and the gap (m, less its standstill gap)."""
    back = state.vehicles[v].position - traffic.drivers[v].length
    follower = state.changer[lane].next
    if follower >= 0:
        return follower, back - state.vehicles[follower].position - traffic.drivers[follower].min_gap
    return _follower_upstream(net, traffic, state, v, lane, back)


@compiled
def _search_distance(net, traffic, state, lane):  # type: ignore[no-untyped-def]
    """Return how far (m) SUMO searches upstream of ``lane``: the braking distance of the worst vehicle type so far."""
    limit = net.lanes[lane].limit
    row = traffic.fleet.shape[0] - 1
    while row > 0 and traffic.fleet[row].from_ms > state.clock.now_ms:
        row -= 1
    way = limit * limit * 0.5 / traffic.fleet[row].decel + traffic.fleet[row].min_gap
    return min(way, _MAX_BRAKING_M)


@compiled
def _follower_upstream(net, traffic, state, v, lane, back):  # type: ignore[no-untyped-def]
    """Search all lanes that lead to ``lane`` for the follower with the largest shortfall of its secure gap."""
    queue = state.changer_queue
    ways = state.changer_way
    count = 0
    if back < _search_distance(net, traffic, state, lane):
        count = _enqueue(net, queue, ways, 0, lane, 0.0)
    done, found, found_gap, worst = 0, -1, 0.0, 0.0
    while done < count:
        link, way = queue[done], ways[done]
        done += 1
        before = net.links[link].from_lane
        follower, gap, covered = _first_upstream(net, traffic, state, v, before, link, way, back)
        if follower >= 0:
            lacking = (
                secure_gap(traffic.drivers[follower], state.vehicles[follower].speed, state.vehicles[v].speed) - gap
            )
            if found < 0 or lacking > worst:
                found, found_gap, worst = follower, gap, lacking
        # A vehicle from the same lane counts until its rear is where the ways have diverged, as long as the rear of
        # ``v`` is less than the length of ``v`` past that place.
        rear_left = net.lanes[before].length - back - way
        first = net.links[link].first_conflict
        rows = net.links[link].conflicts if rear_left > 0.0 else 0
        for row in range(first, first + rows):
            if net.conflicts[row].kind != DIVERGING:
                continue
            if rear_left + traffic.drivers[v].length < net.conflicts[row].to_end:
                continue
            beside = net.conflicts[row].lane
            parting = net.lanes[beside].length - net.conflicts[row].foe_to_end
            for k in range(-1, state.lanes[beside].tails):
                follower = state.lanes[beside].front if k < 0 else state.tails[beside, k]
                if follower < 0 or follower == v:
                    continue
                rear = rear_position(net, traffic, state, follower, beside)
                if rear < parting:
                    gap = way - rear - traffic.drivers[follower].length + back - traffic.drivers[follower].min_gap
                    other = state.vehicles[follower].speed
                    lacking = secure_gap(traffic.drivers[follower], other, state.vehicles[v].speed) - gap
                    if found < 0 or lacking > worst:
                        found, found_gap, worst = follower, gap, lacking
        if not covered and way + back < _search_distance(net, traffic, state, before):
            count = _enqueue(net, queue, ways, count, before, way)
    return found, found_gap


@compiled
def _enqueue(net, queue, ways, count, lane, way):  # type: ignore[no-untyped-def]
    """Append the links that lead to ``lane``, each with the distance to the begin of the lane that it leaves."""
    for k in range(net.incoming_start[lane], net.incoming_start[lane + 1]):
        if count >= _MAX_LANES_BEHIND:
            break
        link = net.incoming_links[k]
        queue[count] = link
        ways[count] = way + net.lanes[net.links[link].from_lane].length
        count += 1
    return count


@compiled
def _first_upstream(net, traffic, state, v, lane, link, way, back):  # type: ignore[no-untyped-def]
    """Return the vehicle furthest downstream on ``lane``, and its gap to a rear bumper at ``back``.

    Returns:
        The vehicle or -1; its gap (m); whether the search ends there on this way.
    """
    if state.lanes[lane].tails > 0:
        other = last_tail(net, traffic, state, lane, v)
        if other >= 0:
            # Its front is beside ``v`` or past it, and the search ends; or it went another way.
            edge = net.lanes[state.vehicles[v].lane].edge
            if net.lanes[state.vehicles[other].lane].edge == edge:
                return -1, 0.0, True
            for k in range(state.vehicles[other].tail_lanes):
                if net.lanes[state.tail_lane[other, k]].edge == edge:
                    return -1, 0.0, True
            gap = way - net.lanes[lane].length + back - traffic.drivers[other].min_gap
            if gap <= 0.0:
                return other, gap, True
    first = state.lanes[lane].front
    if first < 0 or first == v:
        return -1, 0.0, False
    gap = way - state.vehicles[first].position + back - traffic.drivers[first].min_gap
    clear_of_it = back + way >= net.lanes[lane].length
    if clear_of_it and not is_major(state.link_letter[link]) and state.vehicles[first].speed < STANDING_MPS:
        # A vehicle that stands on a minor road does not block, unless the rear of ``v`` is still beside that road.
        gap = max(gap, 0.0)
    return first, gap, True
