"""Compiled kernels that turn what SUMO reports into a frame: places, neighbours, the signal clock, observations.

All kernels work on the simulator's tables: ``floats [C, *]``, ``ints [C, *]`` and ``flags [C, *]`` with one row per
vehicle (columns in :mod:`izoo.envs.layout`), and on ``rows [n]``, the rows that hold a vehicle. They know nothing of
SUMO and can be called with hand-placed vehicles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from izoo.envs.layout import (
    ACCEL,
    APPROACH,
    BLINKER_LEFT,
    BLINKER_RIGHT,
    DISTANCE_SCALE_M,
    EXIT,
    FAR_M,
    FRESH,
    GAP,
    GRADE,
    HAS_LEADER,
    JUNCTION_M,
    LANE,
    LANE_POSITION,
    LEADER_SPEED,
    LENGTH,
    LOCATION,
    MOVEMENT,
    PATH_POSITION,
    PLACE,
    PREV_ACCEL,
    REGION_LANE,
    SPEED,
    SPEED_SCALE_MPS,
    STEADY,
    STOP_LINE,
    TIME_SCALE_S,
    TTC,
    WRONG_LANE,
)
from izoo.networks.clock import NEVER_S
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet

NO_TTC = np.inf
LONGEST_VEHICLE_M = 30.0
_ROUTE_LIMIT = 12  # lanes that a search along a route may visit; routes through the region are shorter


class RoadArrays(NamedTuple):
    """The parts of a :class:`RoadNet` that kernels read, with its names and shapes."""

    lane_location: np.ndarray
    lane_index: np.ndarray
    lane_siblings: np.ndarray
    lane_length: np.ndarray
    lane_offset_m: np.ndarray
    inside_length_m: np.ndarray
    next_lane: np.ndarray
    prev_lane: np.ndarray
    lane_right: np.ndarray
    lane_left: np.ndarray
    segment_start: np.ndarray
    segment_from_m: np.ndarray
    segment_grade_pct: np.ndarray
    movement_turn: np.ndarray


def road_arrays(road: RoadNet) -> RoadArrays:
    """Pick the kernels' arrays out of a road net."""
    return RoadArrays(*(np.ascontiguousarray(getattr(road, name)) for name in RoadArrays._fields))


@njit(cache=True)
def place(rows, lane, position, speed, signals, floats, ints, flags, road, step_s):  # type: ignore[no-untyped-def]
    """Write what SUMO reported for ``rows`` into the tables.

    ``lane``, ``position``, ``speed`` and ``signals`` are ``[n]``: region lane, lane position of the front bumper in m,
    m/s, and SUMO's signal bits (1 right blinker, 2 left blinker). A fresh row already holds its acceleration. Rows are
    marked steady whose speed, acceleration and grade are exactly those of the last step, and so is what they emit.
    """
    for j in range(rows.shape[0]):
        r, new_lane, s = rows[j], lane[j], position[j]
        fresh, old_speed, old_grade = flags[r, FRESH], floats[r, SPEED], floats[r, GRADE]
        if fresh:
            floats[r, PREV_ACCEL] = floats[r, ACCEL]
            flags[r, FRESH] = 0
        else:
            floats[r, PREV_ACCEL] = floats[r, ACCEL]
            floats[r, ACCEL] = (speed[j] - floats[r, SPEED]) / step_s
        floats[r, SPEED] = speed[j]
        floats[r, LANE_POSITION] = s
        location = road.lane_location[new_lane]
        if location == INSIDE:
            floats[r, JUNCTION_M] = road.inside_length_m[new_lane]
        path = road.lane_offset_m[new_lane] + s
        if location == LEAVING:
            path += floats[r, JUNCTION_M]
            floats[r, STOP_LINE] = s
        elif location == INSIDE:
            floats[r, STOP_LINE] = 0.0
        else:
            floats[r, STOP_LINE] = path
        floats[r, PATH_POSITION] = path
        floats[r, GRADE] = grade_under(new_lane, s, floats[r, LENGTH], ints[r, APPROACH], road)
        same_motion = speed[j] == old_speed and floats[r, ACCEL] == floats[r, PREV_ACCEL]
        flags[r, STEADY] = not fresh and same_motion and floats[r, GRADE] == old_grade
        ints[r, LOCATION] = location
        ints[r, REGION_LANE] = new_lane
        ints[r, LANE] = road.lane_index[new_lane]
        ints[r, MOVEMENT] = road.movement_turn[ints[r, APPROACH], ints[r, EXIT]]
        flags[r, BLINKER_RIGHT] = signals[j] & 1
        flags[r, BLINKER_LEFT] = (signals[j] >> 1) & 1
        flags[r, WRONG_LANE] = location == APPROACHING and road.next_lane[new_lane, ints[r, EXIT]] < 0


@njit(cache=True, forceinline=True)
def grade_under(lane, position, length, approach, road):  # type: ignore[no-untyped-def]
    """Grade in percent under a vehicle, positive uphill: the mean over its length, as SUMO takes it from back to front.

    The junction before the controlled region, where the back of a newcomer still is, counts as level.
    """
    left, rise = length, 0.0
    for _ in range(_ROUTE_LIMIT):
        first, k = road.segment_start[lane], road.segment_start[lane + 1] - 1
        while k > first and road.segment_from_m[k] >= position:
            k -= 1
        while left > 0.0 and k >= first:
            piece = min(left, position - road.segment_from_m[k])
            rise += piece * road.segment_grade_pct[k]
            left -= piece
            position = road.segment_from_m[k]
            k -= 1
        lane = road.prev_lane[lane, approach] if left > 0.0 else -1
        if lane < 0:
            break
        position = road.lane_length[lane]
    return rise / length


@njit(cache=True)
def sort_lanes(rows, floats, ints, num_lanes, order, start):  # type: ignore[no-untyped-def]
    """Fill ``order [n]`` with rows by lane and position, and ``start [num_lanes + 1]`` with where each lane begins."""
    n = rows.shape[0]
    count = np.zeros(num_lanes + 1, np.int64)
    for j in range(n):
        count[ints[rows[j], REGION_LANE] + 1] += 1
    start[0] = 0
    for k in range(num_lanes):
        start[k + 1] = start[k] + count[k + 1]
    fill = start[:num_lanes].copy()
    for j in range(n):
        r = rows[j]
        k = ints[r, REGION_LANE]
        slot = fill[k]
        # Insertion within the lane: lanes hold few vehicles.
        while slot > start[k] and floats[order[slot - 1], LANE_POSITION] > floats[r, LANE_POSITION]:
            order[slot] = order[slot - 1]
            slot -= 1
        order[slot] = r
        fill[k] += 1


@njit(cache=True, forceinline=True)
def first_from(lane, position, floats, order, start):  # type: ignore[no-untyped-def]
    """Return the place in ``order`` of the first vehicle on ``lane`` at or beyond ``position`` (its end if none)."""
    low, high = start[lane], start[lane + 1]
    while low < high:
        middle = (low + high) // 2
        if floats[order[middle], LANE_POSITION] < position:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, forceinline=True)
def rear_on(lane, position, exit_, me, floats, order, start, road):  # type: ignore[no-untyped-def]
    """Return who turns off to another exit than ``exit_`` with its rear still on ``lane``, and the gap to ``position``.

    Of several it is the one whose rear is farthest back; row -1 means that nobody is there. Exits are not looked at:
    who drives there may have come from elsewhere.
    """
    found, nearest = -1, FAR_M
    for q in range(road.next_lane.shape[1]):
        beyond, turn = 0.0, road.next_lane[lane, q]
        while q != exit_ and turn >= 0 and road.lane_location[turn] != LEAVING and beyond < LONGEST_VEHICLE_M:
            if start[turn] < start[turn + 1]:
                other = order[start[turn]]
                behind = beyond + floats[other, LANE_POSITION] - floats[other, LENGTH]
                if other != me and behind < 0.0:
                    gap = road.lane_length[lane] - position + behind
                    if gap < nearest:
                        found, nearest = other, gap
                break
            beyond += road.lane_length[turn]
            turn = road.next_lane[turn, q]
    return found, nearest


@njit(cache=True, forceinline=True)
def find_ahead(lane, position, first, exit_, me, floats, order, start, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle ahead of ``position`` along the way to ``exit_`` and its gap.

    Whoever turns off to another exit counts until its rear has left ``lane``. ``first`` is the place in ``order`` where
    the search on ``lane`` begins. The gap in m is from ``position`` to the other's rear bumper. Row -1 means that
    nobody is there.
    """
    if first < start[lane + 1]:
        other = order[first]
        return other, floats[other, LANE_POSITION] - floats[other, LENGTH] - position
    travelled = road.lane_length[lane] - position
    turning, rear = rear_on(lane, position, exit_, me, floats, order, start, road)
    for _ in range(_ROUTE_LIMIT):
        lane = road.next_lane[lane, exit_]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane]]
            if other != me:
                gap = travelled + floats[other, LANE_POSITION] - floats[other, LENGTH]
                return (other, gap) if turning < 0 or gap <= rear else (turning, rear)
        travelled += road.lane_length[lane]
    return turning, rear


@njit(cache=True, forceinline=True)
def find_behind(lane, position, last, length, approach, me, floats, order, start, road):  # type: ignore[no-untyped-def]
    """Return the row of the first vehicle behind ``position`` along the way from ``approach`` and its gap.

    ``last`` is the place in ``order`` where the search on ``lane`` begins, backwards. The gap in m is from the rear
    bumper of a vehicle of ``length`` at ``position`` to the other's front bumper.
    """
    if last >= start[lane]:
        other = order[last]
        return other, position - length - floats[other, LANE_POSITION]
    travelled = position
    for _ in range(_ROUTE_LIMIT):
        lane = road.prev_lane[lane, approach]
        if lane < 0:
            break
        if start[lane] < start[lane + 1]:
            other = order[start[lane + 1] - 1]
            if other != me:
                return other, travelled + road.lane_length[lane] - floats[other, LANE_POSITION] - length
        travelled += road.lane_length[lane]
    return -1, FAR_M


@njit(cache=True)
def find_leaders(rows, floats, ints, flags, order, start, road):  # type: ignore[no-untyped-def]
    """Write each vehicle's leader (gap in m, speed, flag) and its time to collision in s, infinite when not closing."""
    for k in range(rows.shape[0]):
        r = order[k]
        ints[r, PLACE] = k
        lane, position = ints[r, REGION_LANE], floats[r, LANE_POSITION]
        leader, gap = find_ahead(lane, position, k + 1, ints[r, EXIT], r, floats, order, start, road)
        floats[r, TTC] = NO_TTC
        flags[r, HAS_LEADER] = leader >= 0
        if leader >= 0:
            floats[r, GAP] = gap
            floats[r, LEADER_SPEED] = floats[leader, SPEED]
            closing = floats[r, SPEED] - floats[leader, SPEED]
            if closing > 0.0:
                floats[r, TTC] = max(gap, 0.0) / closing
        else:
            floats[r, GAP] = 0.0
            floats[r, LEADER_SPEED] = 0.0


@njit(cache=True)
def read_clock(time_s, cycle_s, offset_s, begin, colour, change, second, third, now, left, next2, next3):  # type: ignore[no-untyped-def]
    """Evaluate the signal clock at ``time_s`` for all movements ``[P, Q]``; return the phase.

    ``now`` gets the colour (0 green, 1 yellow, 2 red) in force from ``time_s`` on, the others seconds from ``time_s``,
    at most ``NEVER_S``.
    """
    in_cycle = (time_s - offset_s) % cycle_s
    phase = np.searchsorted(begin, in_cycle + 1e-6, side="right") - 1
    elapsed = in_cycle - begin[phase]
    for p in range(now.shape[0]):
        for q in range(now.shape[1]):
            now[p, q] = colour[p, q, phase]
            left[p, q] = min(max(change[p, q, phase] - elapsed, 0.0), NEVER_S)
            next2[p, q] = min(max(second[p, q, phase] - elapsed, 0.0), NEVER_S)
            next3[p, q] = min(max(third[p, q, phase] - elapsed, 0.0), NEVER_S)
    return phase


@njit(cache=True)
def observe(agent_row, floats, ints, flags, order, start, road, clock, features, neighbours, sensor_range_m, out):  # type: ignore[no-untyped-def]
    """Write the observation ``out [A, F]`` of every agent slot; empty slots (row -1) become zero.

    Args:
        clock: tuple ``(colour, time left, second green, third green)`` of ``[P, Q]`` arrays.
        features: ``[P, Q, O]`` observed context features of a movement, scaled.
        neighbours: ``[n]`` which of leader, follower, left leader, left follower, right leader, right follower are
            seen (0 to 5), in this order.
    """
    colour, left, next2, next3 = clock
    columns = np.empty(6, np.int64)  # np.full compiles longer
    columns[:] = -1
    for j in range(neighbours.shape[0]):
        columns[neighbours[j]] = 15 + 6 * j
    first_feature = 15 + 6 * neighbours.shape[0]
    for a in range(agent_row.shape[0]):
        r = agent_row[a]
        line = out[a]
        line[:] = 0.0
        if r < 0:
            continue
        lane, p, q = ints[r, REGION_LANE], ints[r, APPROACH], ints[r, EXIT]
        siblings = road.lane_siblings[lane]
        line[0] = floats[r, SPEED] / SPEED_SCALE_MPS
        line[1] = floats[r, STOP_LINE] / DISTANCE_SCALE_M
        line[2 + ints[r, LOCATION]] = 1.0
        if siblings > 1:
            line[5] = road.lane_index[lane] / (siblings - 1)
        line[6 + ints[r, MOVEMENT]] = 1.0
        line[9 + colour[p, q]] = 1.0
        line[12] = left[p, q] / TIME_SCALE_S
        line[13] = next2[p, q] / TIME_SCALE_S
        line[14] = next3[p, q] / TIME_SCALE_S
        for side in range(3):
            if columns[2 * side] < 0 and columns[2 * side + 1] < 0:
                continue
            seen_lane, position, ahead = _beside(side, r, floats, ints, order, start, road)
            for back in range(2):
                column = columns[2 * side + back]
                if column < 0:
                    continue
                seen = line[column : column + 6]
                seen[1], seen[5] = FAR_M / DISTANCE_SCALE_M, seen_lane >= 0
                if seen_lane < 0:
                    continue
                if back == 0:
                    other, gap = find_ahead(seen_lane, position, ahead, q, r, floats, order, start, road)
                else:
                    last = ahead - 2 if side == 0 else ahead - 1
                    length = floats[r, LENGTH]
                    other, gap = find_behind(seen_lane, position, last, length, p, r, floats, order, start, road)
                _see(other, gap, sensor_range_m, floats, flags, seen)
        for j in range(features.shape[2]):
            line[first_feature + j] = features[p, q, j]


@njit(cache=True, forceinline=True)
def _beside(side, r, floats, ints, order, start, road):  # type: ignore[no-untyped-def]
    """Return the lane on a side of vehicle ``r`` (0 its own, 1 left, 2 right), where ``r`` would be on it, and the
    place in ``order`` of the first vehicle ahead."""
    lane, position = ints[r, REGION_LANE], floats[r, LANE_POSITION]
    if side == 0:
        return lane, position, ints[r, PLACE] + 1
    seen_lane = road.lane_left[lane] if side == 1 else road.lane_right[lane]
    if seen_lane < 0:
        return seen_lane, position, 0
    # Lanes of one edge end together, so positions on them compare from the end.
    position += road.lane_length[seen_lane] - road.lane_length[lane]
    return seen_lane, position, first_from(seen_lane, position, floats, order, start)


@njit(cache=True, forceinline=True)
def _see(other, gap, sensor_range_m, floats, flags, seen):  # type: ignore[no-untyped-def]
    """Write what is seen of a neighbour, if there is one in range."""
    if other < 0 or gap > sensor_range_m:
        return
    seen[0] = floats[other, SPEED] / SPEED_SCALE_MPS
    seen[1] = gap / DISTANCE_SCALE_M
    seen[2] = flags[other, BLINKER_LEFT]
    seen[3] = flags[other, BLINKER_RIGHT]
    seen[4] = 1.0


@njit(cache=True)
def agent_vehicles(agent_row, mask, vehicle):  # type: ignore[no-untyped-def]
    """Write the mask and the vehicle row of every agent slot."""
    for a in range(agent_row.shape[0]):
        mask[a] = agent_row[a] >= 0
        vehicle[a] = max(agent_row[a], 0)


@njit(cache=True)
def emit_vehicles(floats, ints, flags, floats_out, ints_out, flags_out):  # type: ignore[no-untyped-def]
    """Copy the emitted columns of the first ``V`` rows; rows without a vehicle are zero."""
    for v in range(floats_out.shape[0]):
        if v < flags.shape[0] and flags[v, 0]:
            for c in range(floats_out.shape[1]):
                floats_out[v, c] = floats[v, c]
            for c in range(ints_out.shape[1]):
                ints_out[v, c] = ints[v, c]
            for c in range(flags_out.shape[1]):
                flags_out[v, c] = flags[v, c]
        else:
            floats_out[v, :] = 0.0
            ints_out[v, :] = 0
            flags_out[v, :] = 0
