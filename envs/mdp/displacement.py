"""Where vehicles are: a simulator's report as columns of the tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.columns import (
    ACCEL,
    APPROACH,
    BLINKER_LEFT,
    BLINKER_RIGHT,
    DELAY,
    EXIT,
    FRESH,
    GRADE,
    JUNCTION_M,
    LANE,
    LANE_POSITION,
    LENGTH,
    LOCATION,
    MOVEMENT,
    PATH_POSITION,
    PREV_ACCEL,
    REGION_LANE,
    SPEED,
    STEADY,
    STOP_LINE,
    WRONG_LANE,
)
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet

ROUTE_LIMIT = 12
"""Most lanes that a search along a route visits; routes through the region are shorter."""


class RoadArrays(NamedTuple):
    """The parts of a :class:`RoadNet` that compiled code reads, with its names and shapes."""

    lane_location: np.ndarray
    lane_index: np.ndarray
    lane_siblings: np.ndarray
    lane_length: np.ndarray
    lane_limit_mps: np.ndarray
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
    lane_length_m: np.ndarray


def road_arrays(road: RoadNet) -> RoadArrays:
    """Pick the compiled code's arrays out of a road net."""
    return RoadArrays(*(np.ascontiguousarray(getattr(road, name)) for name in RoadArrays._fields))


@compiled(borrows=True)
def update_motion(rows, reading, vehicles, road, step_s):  # type: ignore[no-untyped-def]
    """Write the simulator's report of ``rows`` into the tables ``vehicles`` (``floats``, ``ints``, ``flags``).

    ``reading`` holds four arrays ``[n]``: region lane, lane position of the front bumper (m), speed (m/s), and signal
    bits (1 right blinker, 2 left blinker). A fresh row already holds its acceleration. Rows whose speed, acceleration
    and grade are exactly those of the last step are marked steady: so is their emission.
    """
    lane, position, speed, signals = reading
    floats, ints, flags = vehicles.floats, vehicles.ints, vehicles.flags
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
        floats[r, DELAY] = step_s * max(0.0, 1.0 - speed[j] / road.lane_limit_mps[new_lane])
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
        floats[r, GRADE] = mean_grade_pct(new_lane, s, floats[r, LENGTH], ints[r, APPROACH], road)
        same_motion = speed[j] == old_speed and floats[r, ACCEL] == floats[r, PREV_ACCEL]
        flags[r, STEADY] = not fresh and same_motion and floats[r, GRADE] == old_grade
        ints[r, LOCATION] = location
        ints[r, REGION_LANE] = new_lane
        ints[r, LANE] = road.lane_index[new_lane]
        ints[r, MOVEMENT] = road.movement_turn[ints[r, APPROACH], ints[r, EXIT]]
        flags[r, BLINKER_RIGHT] = signals[j] & 1
        flags[r, BLINKER_LEFT] = (signals[j] >> 1) & 1
        flags[r, WRONG_LANE] = location == APPROACHING and road.next_lane[new_lane, ints[r, EXIT]] < 0


@compiled(borrows=True, forceinline=True)
def mean_grade_pct(lane, position, length, approach, road):  # type: ignore[no-untyped-def]
    """Return the mean grade in percent under a vehicle, positive uphill, which is SUMO's slope from back to front.

    The junction before the controlled region, where the rear of a vehicle that enters still is, counts as level.
    """
    left, rise = length, 0.0
    for _ in range(ROUTE_LIMIT):
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
