"""Leaders and followers: vehicles sorted by lane, and searches along routes.

``tables`` hold ``vehicles``, a record per vehicle, and ``order`` and ``lane_start`` from :func:`sort_lanes`.
"""

from __future__ import annotations

import numpy as np

from izoo.envs.mdp.displacement import ROUTE_LIMIT
from izoo.envs.mdp.observation import FAR_M
from izoo.envs.tables import compiled
from izoo.networks.road import LEAVING

NO_TTC = np.inf
LONGEST_VEHICLE_M = 30.0


@compiled
def sort_lanes(tables, fill):  # type: ignore[no-untyped-def]
    """Fill ``order`` with rows by lane and position, and ``lane_start`` with where in it each lane begins.

    Of two vehicles at the same position the earlier one comes first. ``fill`` is ``[L]`` working memory.
    """
    vehicles, order, start = tables.vehicles, tables.order, tables.lane_start
    num_lanes = fill.shape[0]
    for k in range(num_lanes):
        fill[k] = 0
    for j in range(tables.cursor.members):
        fill[vehicles[tables.members[j]].region_lane] += 1
    start[0] = 0
    for k in range(num_lanes):
        start[k + 1] = start[k] + fill[k]
        fill[k] = start[k]
    # The latest arrival is mostly furthest upstream, so this rarely moves anything.
    for j in range(tables.cursor.members - 1, -1, -1):
        r = tables.members[j]
        k = vehicles[r].region_lane
        slot = fill[k]
        while slot > start[k] and vehicles[order[slot - 1]].lane_position_m >= vehicles[r].lane_position_m:
            order[slot] = order[slot - 1]
            slot -= 1
        order[slot] = r
        fill[k] += 1


@compiled(forceinline=True)
def first_at_or_beyond(lane, position, tables):  # type: ignore[no-untyped-def]
    """Return the index in ``order`` of the first vehicle on ``lane`` at or beyond ``position``, or the lane's end."""
    vehicles, order, start = tables.vehicles, tables.order, tables.lane_start
    low, high = start[lane], start[lane + 1]
    while low < high:
        middle = (low + high) // 2
        if vehicles[order[middle]].lane_position_m < position:
            low = middle + 1
        else:
            high = middle
    return low


@compiled(forceinline=True)
def find_turning_off(lane, position, exit_, ego, tables, road):  # type: ignore[no-untyped-def]
    """Return the vehicle that turns off to another exit with its rear still on ``lane``, and the gap to ``position``.

    Of several it is the one whose rear is farthest back; row -1 means none. Vehicles already on an exit are left out,
    since they may have come from another approach.
    """
    vehicles, order, start = tables.vehicles, tables.order, tables.lane_start
    found, nearest = -1, FAR_M
    for q in range(road.next_lane.shape[1]):
        beyond, turn = 0.0, road.next_lane[lane, q]
        while q != exit_ and turn >= 0 and road.lanes[turn].location != LEAVING and beyond < LONGEST_VEHICLE_M:
            if start[turn] < start[turn + 1]:
                other = order[start[turn]]
                behind = beyond + vehicles[other].lane_position_m - vehicles[other].length_m
                if other != ego and behind < 0.0:
                    gap = road.lanes[lane].length_m - position + behind
                    if gap < nearest:
                        found, nearest = other, gap
                break
            beyond += road.lanes[turn].length_m
            turn = road.next_lane[turn, q]
    return found, nearest


@compiled(forceinline=True)
def find_leader(lane, position, first, exit_, ego, tables, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle ahead of ``position`` along the way to ``exit_`` and its gap.

    A vehicle that turns off to another exit counts until its rear has left ``lane``. ``first`` is the index in
    ``order`` where the search on ``lane`` begins. The gap in m is from ``position`` to the leader's rear bumper. Row -1
    means that there is none.
    """
    vehicles, order, start = tables.vehicles, tables.order, tables.lane_start
    if first < start[lane + 1]:
        other = order[first]
        return other, vehicles[other].lane_position_m - vehicles[other].length_m - position
    travelled = road.lanes[lane].length_m - position
    turning, rear = find_turning_off(lane, position, exit_, ego, tables, road)
    for _ in range(ROUTE_LIMIT):
        lane = road.next_lane[lane, exit_]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane]]
            if other != ego:
                gap = travelled + vehicles[other].lane_position_m - vehicles[other].length_m
                return (other, gap) if turning < 0 or gap <= rear else (turning, rear)
        travelled += road.lanes[lane].length_m
    return turning, rear


@compiled(forceinline=True)
def find_follower(lane, position, last, length, approach, ego, tables, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle behind ``position`` along the way from ``approach`` and its gap.

    ``last`` is the index in ``order`` where the search on ``lane`` begins, backwards. The gap in m is from the rear
    bumper of a vehicle of ``length`` at ``position`` to the follower's front bumper.
    """
    vehicles, order, start = tables.vehicles, tables.order, tables.lane_start
    if last >= start[lane]:
        other = order[last]
        return other, position - length - vehicles[other].lane_position_m
    travelled = position
    for _ in range(ROUTE_LIMIT):
        lane = road.prev_lane[lane, approach]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane + 1] - 1]
            if other != ego:
                return other, travelled + road.lanes[lane].length_m - vehicles[other].lane_position_m - length
        travelled += road.lanes[lane].length_m
    return -1, FAR_M


@compiled
def find_leaders(tables, road):  # type: ignore[no-untyped-def]
    """Write each vehicle's leader (gap in m, speed, flag) and its time to collision in s, infinite when not closing."""
    vehicles, order = tables.vehicles, tables.order
    for k in range(tables.cursor.members):
        r = order[k]
        vehicle = vehicles[r]
        vehicle.place = k
        lane, position = vehicle.region_lane, vehicle.lane_position_m
        leader, gap = find_leader(lane, position, k + 1, vehicle.exit, r, tables, road)
        vehicle.ttc_s = NO_TTC
        vehicle.has_leader = leader >= 0
        vehicle.leader = leader
        if leader >= 0:
            vehicle.leader_gap_m = gap
            vehicle.leader_speed_mps = vehicles[leader].speed_mps
            closing = vehicle.speed_mps - vehicles[leader].speed_mps
            if closing > 0.0:
                vehicle.ttc_s = max(gap, 0.0) / closing
        else:
            vehicle.leader_gap_m = 0.0
            vehicle.leader_speed_mps = 0.0
