"""Where vehicles are: a simulator's report as columns of the tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from izoo.compiling import compiled
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
    """Write the simulator's report of ``rows`` into their records ``vehicles``.

    ``reading`` holds four arrays ``[n]``: region lane, lane position of the front bumper (m), speed (m/s), and signal
    bits (1 right blinker, 2 left blinker). A fresh row already holds its acceleration. Rows whose speed, acceleration
    and grade are exactly those of the last step are marked steady: so is their emission.
    """
    lane, position, speed, signals = reading
    for j in range(rows.shape[0]):
        vehicle, new_lane, s = vehicles[rows[j]], lane[j], position[j]
        fresh, old_speed, old_grade = vehicle.fresh, vehicle.speed_mps, vehicle.grade_pct
        vehicle.prev_accel_mps2 = vehicle.accel_mps2
        if fresh:
            vehicle.fresh = 0
        else:
            vehicle.accel_mps2 = (speed[j] - vehicle.speed_mps) / step_s
        vehicle.speed_mps = speed[j]
        vehicle.delay_s = step_s * max(0.0, 1.0 - speed[j] / road.lane_limit_mps[new_lane])
        vehicle.lane_position_m = s
        location = road.lane_location[new_lane]
        if location == INSIDE:
            vehicle.junction_m = road.inside_length_m[new_lane]
        path = road.lane_offset_m[new_lane] + s
        if location == LEAVING:
            path += vehicle.junction_m
            vehicle.stop_line_distance_m = s
        elif location == INSIDE:
            vehicle.stop_line_distance_m = 0.0
        else:
            vehicle.stop_line_distance_m = path
        vehicle.path_position_m = path
        vehicle.grade_pct = mean_grade_pct(new_lane, s, vehicle.length_m, vehicle.approach, road)
        same_motion = speed[j] == old_speed and vehicle.accel_mps2 == vehicle.prev_accel_mps2
        vehicle.steady = not fresh and same_motion and vehicle.grade_pct == old_grade
        vehicle.location = location
        vehicle.region_lane = new_lane
        vehicle.lane = road.lane_index[new_lane]
        vehicle.movement = road.movement_turn[vehicle.approach, vehicle.exit]
        vehicle.blinker_right = signals[j] & 1
        vehicle.blinker_left = (signals[j] >> 1) & 1
        vehicle.wrong_lane = location == APPROACHING and road.next_lane[new_lane, vehicle.exit] < 0


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
