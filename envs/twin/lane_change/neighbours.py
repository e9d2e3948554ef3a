"""Neighbours of a lane-changing vehicle: leaders and followers on the lanes of an edge, and beyond its ends."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, secure_gap
from izoo.envs.twin.driving.lane_queues import last_tail, last_vehicle, rear_position
from izoo.envs.twin.driving.tolerances import STANDING_MPS
from izoo.envs.twin.driving.traffic_lights import is_major
from izoo.envs.twin.junction.leaders import leader_in_conflict
from izoo.envs.twin.net.conflicts import CONFLICT_FOE_TO_END, CONFLICT_KIND, CONFLICT_LANE, CONFLICT_TO_END, DIVERGING
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    AHEAD,
    CHANGER_NEXT,
    DECEL,
    EDGE_CHANGES,
    EDGE_FIRST_LANE,
    EDGE_INSIDE,
    EDGE_LANES,
    FLEET_DECEL,
    FLEET_FROM_MS,
    FLEET_MIN_GAP,
    LANE,
    LANE_BACK,
    LANE_EDGE,
    LANE_FRONT,
    LANE_INSIDE,
    LANE_LEFT,
    LANE_LENGTH,
    LANE_LIMIT,
    LANE_RIGHT,
    LANE_TAILS,
    LENGTH,
    LINK_FROM,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_STATE,
    MIN_GAP,
    NOW_MS,
    POSITION,
    SPEED,
    TAIL_LANES,
    TAU,
    VARIANT,
)

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


def incoming_links_of(link_ints: np.ndarray, lane_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``[L + 1]`` starts and the links that lead to each lane, both int32."""
    target = link_ints[:, LINK_NEXT]
    order = np.argsort(target, kind="stable").astype(np.int32)
    return np.searchsorted(target[order], np.arange(lane_count + 1)).astype(np.int32), order


def mark_lane_changing(
    edge_ints: np.ndarray, lane_floats: np.ndarray, lane_ints: np.ndarray, link_ints: np.ndarray
) -> None:
    """Set ``EDGE_CHANGES``: 1 on edges on which vehicles may change lanes.

    Inside junctions these are edges whose lanes are equally long and not behind a minor link without signal. There,
    lanes that begin at the same lane are not neighbours.
    """
    edge_ints[:, EDGE_CHANGES] = edge_ints[:, EDGE_LANES] > 1
    for edge in np.flatnonzero((edge_ints[:, EDGE_INSIDE] == 1) & (edge_ints[:, EDGE_LANES] > 1)):
        lanes = edge_ints[edge, EDGE_FIRST_LANE] + np.arange(edge_ints[edge, EDGE_LANES])
        links = link_ints[np.isin(link_ints[:, LINK_NEXT], lanes)]
        minor = (links[:, LINK_PROGRAM] < 0) & np.isin(links[:, LINK_STATE], [ord(letter) for letter in "m=sw"])
        edge_ints[edge, EDGE_CHANGES] = len(np.unique(lane_floats[lanes, LANE_LENGTH])) == 1 and not minor.any()
        origin = {int(link[LINK_NEXT]): int(link[LINK_FROM]) for link in links}
        for right, left in itertools.pairwise(lanes.tolist()):
            if origin.get(right) == origin.get(left):
                lane_ints[right, LANE_LEFT] = lane_ints[left, LANE_RIGHT] = -1


@compiled
def leader_on_lane(net, traffic, state, v, lane, step_s):  # type: ignore[no-untyped-def]
    """Return the leader of ``v`` on ``lane`` of its edge, or -1, and the gap (m, less the standstill gap)."""
    floats = state.floats
    if lane == state.ints[v, LANE]:
        leader = state.ints[v, AHEAD]
    else:
        behind = state.changer[lane, CHANGER_NEXT]
        leader = state.ints[behind, AHEAD] if behind >= 0 else state.lanes[lane, LANE_BACK]
    front, min_gap = floats[v, POSITION], traffic.floats[v, MIN_GAP]
    if leader >= 0:
        return leader, floats[leader, POSITION] - traffic.floats[leader, LENGTH] - front - min_gap
    if state.lanes[lane, LANE_TAILS] > 0:
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
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    variant = state.ints[v, VARIANT]
    reach = brake_gap(speed, driver[DECEL], driver[TAU], step_s) + driver[MIN_GAP]
    seen = net.lane_floats[lane, LANE_LENGTH] - state.floats[v, POSITION]
    desired = desired_speed(net, state, v, state.ints[v, LANE])
    found, found_gap, least = -1, 0.0, math.inf
    while seen <= reach or net.lane_ints[lane, LANE_INSIDE]:
        link = net.best_link[variant, lane]
        if link < 0:
            break
        lane = net.link_ints[link, LINK_NEXT]
        for on_lane in range(2):
            if on_lane:
                leader, gap = last_vehicle(net, traffic, state, lane, v), 0.0
                if leader >= 0:
                    gap = seen + rear_position(net, traffic, state, leader, lane) - driver[MIN_GAP]
            else:
                leader, gap = leader_in_conflict(net, traffic, state, v, link, seen, step_s)
            if leader < 0:
                continue
            if nearest:
                return leader, gap
            safe = 0.0
            if gap >= 0.0:
                safe = follow_speed(driver, gap, speed, state.floats[leader, SPEED], desired, step_s)
            if safe < least:
                found, found_gap, least = leader, gap, safe
        limit = desired_speed(net, state, v, lane)
        if limit < speed:
            reach = brake_gap(limit, driver[DECEL], driver[TAU], step_s)
        seen += net.lane_floats[lane, LANE_LENGTH]
    return found, found_gap


@compiled
def follower_on_lane(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the follower of ``v`` on ``lane`` of its edge, or -1, and the gap (m, less its standstill gap)."""
    back = state.floats[v, POSITION] - traffic.floats[v, LENGTH]
    follower = state.changer[lane, CHANGER_NEXT]
    if follower >= 0:
        return follower, back - state.floats[follower, POSITION] - traffic.floats[follower, MIN_GAP]
    return _follower_upstream(net, traffic, state, v, lane, back)


@compiled
def _search_distance(net, traffic, state, lane):  # type: ignore[no-untyped-def]
    """Return how far (m) SUMO searches upstream of ``lane``: the braking distance of the worst vehicle type so far."""
    limit = net.lane_floats[lane, LANE_LIMIT]
    row = traffic.fleet.shape[0] - 1
    while row > 0 and traffic.fleet[row, FLEET_FROM_MS] > state.clock[NOW_MS]:
        row -= 1
    way = limit * limit * 0.5 / traffic.fleet[row, FLEET_DECEL] + traffic.fleet[row, FLEET_MIN_GAP]
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
        before = net.link_ints[link, LINK_FROM]
        follower, gap, covered = _first_upstream(net, traffic, state, v, before, link, way, back)
        if follower >= 0:
            lacking = secure_gap(traffic.floats[follower], state.floats[follower, SPEED], state.floats[v, SPEED]) - gap
            if found < 0 or lacking > worst:
                found, found_gap, worst = follower, gap, lacking
        # A vehicle from the same lane counts until its rear is where the ways have diverged, as long as the rear of
        # ``v`` is less than the length of ``v`` past that place.
        rear_left = net.lane_floats[before, LANE_LENGTH] - back - way
        first = net.conflict_first[link]
        rows = net.conflict_count[link] if rear_left > 0.0 else 0
        for row in range(first, first + rows):
            if net.conflict_ints[row, CONFLICT_KIND] != DIVERGING:
                continue
            if rear_left + traffic.floats[v, LENGTH] < net.conflict_floats[row, CONFLICT_TO_END]:
                continue
            beside = net.conflict_ints[row, CONFLICT_LANE]
            parting = net.lane_floats[beside, LANE_LENGTH] - net.conflict_floats[row, CONFLICT_FOE_TO_END]
            for k in range(-1, state.lanes[beside, LANE_TAILS]):
                follower = state.lanes[beside, LANE_FRONT] if k < 0 else state.tails[beside, k]
                if follower < 0 or follower == v:
                    continue
                rear = rear_position(net, traffic, state, follower, beside)
                if rear < parting:
                    gap = way - rear - traffic.floats[follower, LENGTH] + back - traffic.floats[follower, MIN_GAP]
                    other = state.floats[follower, SPEED]
                    lacking = secure_gap(traffic.floats[follower], other, state.floats[v, SPEED]) - gap
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
        ways[count] = way + net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
        count += 1
    return count


@compiled
def _first_upstream(net, traffic, state, v, lane, link, way, back):  # type: ignore[no-untyped-def]
    """Return the vehicle furthest downstream on ``lane``, and its gap to a rear bumper at ``back``.

    Returns:
        The vehicle or -1; its gap (m); whether the search ends there on this way.
    """
    if state.lanes[lane, LANE_TAILS] > 0:
        other = last_tail(net, traffic, state, lane, v)
        if other >= 0:
            # Its front is beside ``v`` or past it, and the search ends; or it went another way.
            edge = net.lane_ints[state.ints[v, LANE], LANE_EDGE]
            if net.lane_ints[state.ints[other, LANE], LANE_EDGE] == edge:
                return -1, 0.0, True
            for k in range(state.ints[other, TAIL_LANES]):
                if net.lane_ints[state.tail_lane[other, k], LANE_EDGE] == edge:
                    return -1, 0.0, True
            gap = way - net.lane_floats[lane, LANE_LENGTH] + back - traffic.floats[other, MIN_GAP]
            if gap <= 0.0:
                return other, gap, True
    first = state.lanes[lane, LANE_FRONT]
    if first < 0 or first == v:
        return -1, 0.0, False
    gap = way - state.floats[first, POSITION] + back - traffic.floats[first, MIN_GAP]
    clear_of_it = back + way >= net.lane_floats[lane, LANE_LENGTH]
    if clear_of_it and not is_major(state.link_letter[link]) and state.floats[first, SPEED] < STANDING_MPS:
        # A vehicle that stands on a minor road does not block, unless the rear of ``v`` is still beside that road.
        gap = max(gap, 0.0)
    return first, gap, True
