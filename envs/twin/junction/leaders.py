"""Leaders inside a junction: vehicles on ways in conflict with a vehicle's own way or that of a neighbouring lane."""

from __future__ import annotations

import math

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import desired_speed, follow_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS
from izoo.envs.twin.driving.traffic_lights import RED
from izoo.envs.twin.junction.foes import Encounter, gap_to_foe, is_before_wait
from izoo.envs.twin.net.conflicts import DIVERGING, MERGING, NOWHERE


@compiled
def leader_in_conflict(net, traffic, state, v, link, distance_m, step_s):  # type: ignore[no-untyped-def]
    """Return the vehicle inside the junction that would restrict ``v`` most by ``link``, or -1, and the gap (m).

    For the link of a neighbouring lane, precedence does not matter.

    Args:
        distance_m: from the front of ``v``, whatever its lane, to ``link``.
    """
    driver, speed = traffic.drivers[v], state.vehicles[v].speed
    wish = desired_speed(net, state, v, state.vehicles[v].lane)
    found, found_gap, least = -1, 0.0, math.inf
    ahead = net.links[link].from_lane
    inside = net.lanes[state.vehicles[v].lane].inside == 1
    # Before a red signal, vehicles inside the junction do not count.
    if not inside and state.link_letter[net.links[link].entry] == RED:
        return found, found_gap
    beside = ahead != state.vehicles[v].lane and net.lanes[ahead].edge == net.lanes[state.vehicles[v].lane].edge
    first = net.links[link].first_conflict
    for row in range(first, first + net.links[link].conflicts):
        lane = net.conflicts[row].lane
        front, tails = state.lanes[lane].front, state.lanes[lane].tails
        k = 0
        while front >= 0 or k < tails:
            if front >= 0:
                w = front
                front = state.vehicles[w].behind
            else:
                w = state.tails[lane, k]
                k += 1
            counts, _, gap = gap_to_foe(net, traffic, state, v, w, Encounter(link, row, distance_m), step_s)
            if beside and (not counts or net.conflicts[row].kind == DIVERGING):
                in_the_way, gap_beside = _gap_beside(net, traffic, state, v, w, row, distance_m)
                if in_the_way:
                    counts, gap = True, gap_beside
            if not counts:
                continue
            gap = -1.0 if is_before_wait(net, row) else gap - net.conflicts[row].foe_size
            if gap >= 0.0:
                safe = follow_speed(driver, gap, speed, state.vehicles[w].speed, wish, step_s)
            else:
                to_way = distance_m - net.lanes[net.links[link].from_lane].length
                safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver.decel, step_s)
            if safe < least:
                found, found_gap, least = w, gap, safe
    return found, found_gap


@compiled
def _gap_beside(net, traffic, state, v, w, row, distance_m):  # type: ignore[no-untyped-def]
    """Return whether ``w`` would be in the way of ``v`` on a neighbouring lane, whatever the precedence, and the gap.

    On diverging and on crossing ways it is, until the rear of one of the two is past the conflict.

    Returns:
        Whether it is; the gap (m) less the standstill gap, below 0 also if the two would be side by side.
    """
    kind, lane = net.conflicts[row].kind, net.conflicts[row].lane
    foe_to_end = net.conflicts[row].foe_to_end
    if w == v or foe_to_end == NOWHERE:
        return False, 0.0
    size, foe_size = net.conflicts[row].size, net.conflicts[row].foe_size
    to_conflict = distance_m - net.conflicts[row].to_end
    back_left = net.lanes[lane].length - foe_to_end - rear_position(net, traffic, state, w, lane)
    if kind != MERGING and (to_conflict + size + traffic.drivers[v].length <= 0.0 or back_left + foe_size <= 0.0):
        return False, 0.0
    if kind == DIVERGING:
        return True, -1.0
    if lane == state.vehicles[v].lane or (state.vehicles[w].lane == lane and state.vehicles[w].will_pass == 0):
        return False, 0.0
    return True, to_conflict - traffic.drivers[v].min_gap - back_left
