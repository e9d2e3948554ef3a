"""Leaders and followers: vehicles sorted by lane, and searches along routes.

The tables ``vehicles`` hold ``floats``, ``ints`` and ``flags``, a row per vehicle, and ``order`` and ``lane_start``
from :func:`sort_lanes`.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.columns import (
    EXIT,
    GAP,
    HAS_LEADER,
    LANE_POSITION,
    LEADER,
    LEADER_SPEED,
    LENGTH,
    PLACE,
    REGION_LANE,
    SPEED,
    TTC,
)
from izoo.envs.mdp.displacement import ROUTE_LIMIT
from izoo.envs.mdp.observation import FAR_M
from izoo.networks.road import LEAVING

NO_TTC = np.inf
LONGEST_VEHICLE_M = 30.0


@compiled(borrows=True)
def sort_lanes(rows, floats, ints, fill, order, start):  # type: ignore[no-untyped-def]
    """Fill ``order [n]`` with rows by lane and position, and ``start [L + 1]`` with where each lane begins.

    Args:
        rows: in order of arrival; of two vehicles at the same position the earlier one comes first.
        fill: ``[L]`` working memory.
    """
    num_lanes = fill.shape[0]
    for k in range(num_lanes):
        fill[k] = 0
    for j in range(rows.shape[0]):
        fill[ints[rows[j], REGION_LANE]] += 1
    start[0] = 0
    for k in range(num_lanes):
        start[k + 1] = start[k] + fill[k]
        fill[k] = start[k]
    # The latest arrival is mostly furthest upstream, so this rarely moves anything.
    for j in range(rows.shape[0] - 1, -1, -1):
        r = rows[j]
        k = ints[r, REGION_LANE]
        slot = fill[k]
        while slot > start[k] and floats[order[slot - 1], LANE_POSITION] >= floats[r, LANE_POSITION]:
            order[slot] = order[slot - 1]
            slot -= 1
        order[slot] = r
        fill[k] += 1


@compiled(borrows=True, forceinline=True)
def first_at_or_beyond(lane, position, vehicles):  # type: ignore[no-untyped-def]
    """Return the index in ``order`` of the first vehicle on ``lane`` at or beyond ``position``, or the lane's end."""
    floats, order, start = vehicles.floats, vehicles.order, vehicles.lane_start
    low, high = start[lane], start[lane + 1]
    while low < high:
        middle = (low + high) // 2
        if floats[order[middle], LANE_POSITION] < position:
            low = middle + 1
        else:
            high = middle
    return low


@compiled(borrows=True, forceinline=True)
def find_turning_off(lane, position, exit_, ego, vehicles, road):  # type: ignore[no-untyped-def]
    """Return the vehicle that turns off to another exit with its rear still on ``lane``, and the gap to ``position``.

    Of several it is the one whose rear is farthest back; row -1 means none. Vehicles already on an exit are left out,
    since they may have come from another approach.
    """
    floats, order, start = vehicles.floats, vehicles.order, vehicles.lane_start
    found, nearest = -1, FAR_M
    for q in range(road.next_lane.shape[1]):
        beyond, turn = 0.0, road.next_lane[lane, q]
        while q != exit_ and turn >= 0 and road.lane_location[turn] != LEAVING and beyond < LONGEST_VEHICLE_M:
            if start[turn] < start[turn + 1]:
                other = order[start[turn]]
                behind = beyond + floats[other, LANE_POSITION] - floats[other, LENGTH]
                if other != ego and behind < 0.0:
                    gap = road.lane_length[lane] - position + behind
                    if gap < nearest:
                        found, nearest = other, gap
                break
            beyond += road.lane_length[turn]
            turn = road.next_lane[turn, q]
    return found, nearest


@compiled(borrows=True, forceinline=True)
def find_leader(lane, position, first, exit_, ego, vehicles, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle ahead of ``position`` along the way to ``exit_`` and its gap.

    A vehicle that turns off to another exit counts until its rear has left ``lane``. ``first`` is the index in
    ``order`` where the search on ``lane`` begins. The gap in m is from ``position`` to the leader's rear bumper. Row -1
    means that there is none.
    """
    floats, order, start = vehicles.floats, vehicles.order, vehicles.lane_start
    if first < start[lane + 1]:
        other = order[first]
        return other, floats[other, LANE_POSITION] - floats[other, LENGTH] - position
    travelled = road.lane_length[lane] - position
    turning, rear = find_turning_off(lane, position, exit_, ego, vehicles, road)
    for _ in range(ROUTE_LIMIT):
        lane = road.next_lane[lane, exit_]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane]]
            if other != ego:
                gap = travelled + floats[other, LANE_POSITION] - floats[other, LENGTH]
                return (other, gap) if turning < 0 or gap <= rear else (turning, rear)
        travelled += road.lane_length[lane]
    return turning, rear


@compiled(borrows=True, forceinline=True)
def find_follower(lane, position, last, length, approach, ego, vehicles, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle behind ``position`` along the way from ``approach`` and its gap.

    ``last`` is the index in ``order`` where the search on ``lane`` begins, backwards. The gap in m is from the rear
    bumper of a vehicle of ``length`` at ``position`` to the follower's front bumper.
    """
    floats, order, start = vehicles.floats, vehicles.order, vehicles.lane_start
    if last >= start[lane]:
        other = order[last]
        return other, position - length - floats[other, LANE_POSITION]
    travelled = position
    for _ in range(ROUTE_LIMIT):
        lane = road.prev_lane[lane, approach]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane + 1] - 1]
            if other != ego:
                return other, travelled + road.lane_length[lane] - floats[other, LANE_POSITION] - length
        travelled += road.lane_length[lane]
    return -1, FAR_M


@compiled(borrows=True)
def find_leaders(rows, vehicles, road):  # type: ignore[no-untyped-def]
    """Write each vehicle's leader (gap in m, speed, flag) and its time to collision in s, infinite when not closing."""
    floats, ints, flags, order = vehicles.floats, vehicles.ints, vehicles.flags, vehicles.order
    for k in range(rows.shape[0]):
        r = order[k]
        ints[r, PLACE] = k
        lane, position = ints[r, REGION_LANE], floats[r, LANE_POSITION]
        leader, gap = find_leader(lane, position, k + 1, ints[r, EXIT], r, vehicles, road)
        floats[r, TTC] = NO_TTC
        flags[r, HAS_LEADER] = leader >= 0
        ints[r, LEADER] = leader
        if leader >= 0:
            floats[r, GAP] = gap
            floats[r, LEADER_SPEED] = floats[leader, SPEED]
            closing = floats[r, SPEED] - floats[leader, SPEED]
            if closing > 0.0:
                floats[r, TTC] = max(gap, 0.0) / closing
        else:
            floats[r, GAP] = 0.0
            floats[r, LEADER_SPEED] = 0.0
