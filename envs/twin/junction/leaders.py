"""Leaders inside a junction: vehicles on ways in conflict with a vehicle's own way or that of a neighbouring lane."""

from __future__ import annotations

import math

from izoo.envs.twin.driving.car_following import desired_speed, follow_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS
from izoo.envs.twin.driving.traffic_lights import RED
from izoo.envs.twin.junction.foes import Encounter, gap_to_foe, is_before_wait
from izoo.envs.twin.net.conflicts import (
    CONFLICT_FOE_SIZE,
    CONFLICT_FOE_TO_END,
    CONFLICT_KIND,
    CONFLICT_LANE,
    CONFLICT_SIZE,
    CONFLICT_TO_END,
    CROSSING,
    DIVERGING,
    MERGING,
    NOWHERE,
)
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    BEHIND,
    DECEL,
    LANE,
    LANE_EDGE,
    LANE_FRONT,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_TAILS,
    LENGTH,
    LINK_ENTRY,
    LINK_FROM,
    MIN_GAP,
    SPEED,
    WILL_PASS,
)


@compiled
def leader_in_conflict(net, traffic, state, v, link, distance_m, step_s):  # type: ignore[no-untyped-def]
    """Return the vehicle inside the junction that would restrict ``v`` most by ``link``, or -1, and the gap (m).

    For the link of a neighbouring lane, precedence does not matter.

    Args:
        distance_m: from the front of ``v``, whatever its lane, to ``link``.
    """
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    wish = desired_speed(net, state, v, state.ints[v, LANE])
    found, found_gap, least = -1, 0.0, math.inf
    ahead = net.link_ints[link, LINK_FROM]
    inside = net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 1
    # Before a red signal, vehicles inside the junction do not count.
    if not inside and state.link_letter[net.link_ints[link, LINK_ENTRY]] == RED:
        return found, found_gap
    beside = (
        ahead != state.ints[v, LANE]
        and net.lane_ints[ahead, LANE_EDGE] == net.lane_ints[state.ints[v, LANE], LANE_EDGE]
    )
    first = net.conflict_first[link]
    for row in range(first, first + net.conflict_count[link]):
        lane = net.conflict_ints[row, CONFLICT_LANE]
        front, tails = state.lanes[lane, LANE_FRONT], state.lanes[lane, LANE_TAILS]
        k = 0
        while front >= 0 or k < tails:
            if front >= 0:
                w = front
                front = state.ints[w, BEHIND]
            else:
                w = state.tails[lane, k]
                k += 1
            counts, _, gap = gap_to_foe(net, traffic, state, v, w, Encounter(link, row, distance_m), step_s)
            if beside and (not counts or net.conflict_ints[row, CONFLICT_KIND] == DIVERGING):
                in_the_way, gap_beside = _gap_beside(net, traffic, state, v, w, row, distance_m)
                if in_the_way:
                    counts, gap = True, gap_beside
            if not counts:
                continue
            if is_before_wait(net, row):
                gap = -1.0
            elif net.conflict_ints[row, CONFLICT_KIND] == CROSSING:
                gap -= net.conflict_floats[row, CONFLICT_FOE_SIZE]
            if gap >= 0.0:
                safe = follow_speed(driver, gap, speed, state.floats[w, SPEED], wish, step_s)
            else:
                to_way = distance_m - net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
                safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver[DECEL], step_s)
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
    kind, lane = net.conflict_ints[row, CONFLICT_KIND], net.conflict_ints[row, CONFLICT_LANE]
    foe_to_end = net.conflict_floats[row, CONFLICT_FOE_TO_END]
    if w == v or foe_to_end == NOWHERE:
        return False, 0.0
    size = foe_size = 0.0
    if kind == CROSSING:
        size, foe_size = net.conflict_floats[row, CONFLICT_SIZE], net.conflict_floats[row, CONFLICT_FOE_SIZE]
    to_conflict = distance_m - net.conflict_floats[row, CONFLICT_TO_END]
    back_left = net.lane_floats[lane, LANE_LENGTH] - foe_to_end - rear_position(net, traffic, state, w, lane)
    if kind != MERGING and (to_conflict + size + traffic.floats[v, LENGTH] <= 0.0 or back_left + foe_size <= 0.0):
        return False, 0.0
    if kind == DIVERGING:
        return True, -1.0
    if lane == state.ints[v, LANE] or (state.ints[w, LANE] == lane and state.ints[w, WILL_PASS] == 0):
        return False, 0.0
    return True, to_conflict - traffic.floats[v, MIN_GAP] - back_left
