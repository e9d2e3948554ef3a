"""Where vehicles are: a simulator's report, and what follows from it and the road."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from izoo.envs.tables import Float1, Int2, compiled, tables_type
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet

ROUTE_LIMIT = 12
"""Most lanes that a search along a route visits; routes through the region are shorter."""
_LANE_FIELDS = {
    "length_m": "lane_length",
    "limit_mps": "lane_limit_mps",
    "offset_m": "lane_offset_m",
    "inside_length_m": "inside_length_m",
    "location": "lane_location",
    "index": "lane_index",
    "siblings": "lane_siblings",
    "right": "lane_right",
    "left": "lane_left",
}
Lane = np.dtype([(name, "f8" if name.endswith(("_m", "_mps")) else "i4") for name in (*_LANE_FIELDS, "first_segment")])
"""A lane of :class:`~izoo.networks.road.RoadNet`, and its first row of :attr:`Road.segments`."""
Segment = np.dtype([("from_m", "f8"), ("grade_pct", "f8")])


class Road(NamedTuple):
    """The parts of a :class:`~izoo.networks.road.RoadNet` that compiled code reads, with its names and shapes.

    Attributes:
        lanes: ``[L + 1]`` records; the last holds the end of the segments alone.
        segments: records; a lane's are ordered by where they begin.
        next_lane, prev_lane, movement_turn, lane_length_m: as in the net.
    """

    lanes: Annotated[np.ndarray, Lane, 1]
    segments: Annotated[np.ndarray, Segment, 1]
    next_lane: Int2
    prev_lane: Int2
    movement_turn: Int2
    lane_length_m: Float1


ROAD = tables_type(Road, constant=True)


def road_tables(road: RoadNet) -> Road:
    """Return a road net's tables."""
    lanes, segments = np.zeros(len(road.lane_ids) + 1, Lane), np.zeros(len(road.segment_from_m), Segment)
    for name, column in _LANE_FIELDS.items():
        lanes[name][:-1] = getattr(road, column)
    lanes["first_segment"] = road.segment_start
    segments["from_m"], segments["grade_pct"] = road.segment_from_m, road.segment_grade_pct
    turn, lengths_m = road.movement_turn.astype(np.int32), np.ascontiguousarray(road.lane_length_m, float)
    return Road(lanes, segments, road.next_lane, road.prev_lane, turn, lengths_m)


@compiled
def update_motion(tables, road, step_s):  # type: ignore[no-untyped-def]
    """Update the members' records from what the simulator has written there.

    That is ``region_lane``, ``lane_position_m``, ``reported_speed_mps`` and ``signals`` (bits: 1 right blinker, 2 left
    blinker). A fresh record already holds its acceleration. Those whose speed, acceleration and grade are exactly those
    of the last step are marked steady: so is their emission.
    """
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        lane, position, speed = vehicle.region_lane, vehicle.lane_position_m, vehicle.reported_speed_mps
        fresh, old_speed, old_grade = vehicle.fresh, vehicle.speed_mps, vehicle.grade_pct
        vehicle.prev_accel_mps2 = vehicle.accel_mps2
        if fresh:
            vehicle.fresh = 0
        else:
            vehicle.accel_mps2 = (speed - old_speed) / step_s
        vehicle.speed_mps = speed
        vehicle.delay_s = step_s * max(0.0, 1.0 - speed / road.lanes[lane].limit_mps)
        location = road.lanes[lane].location
        if location == INSIDE:
            vehicle.junction_m = road.lanes[lane].inside_length_m
        path = road.lanes[lane].offset_m + position
        if location == LEAVING:
            path += vehicle.junction_m
            vehicle.stop_line_distance_m = position
        elif location == INSIDE:
            vehicle.stop_line_distance_m = 0.0
        else:
            vehicle.stop_line_distance_m = path
        vehicle.path_position_m = path
        vehicle.grade_pct = mean_grade_pct(lane, position, vehicle.length_m, vehicle.approach, road)
        same_motion = speed == old_speed and vehicle.accel_mps2 == vehicle.prev_accel_mps2
        vehicle.steady = not fresh and same_motion and vehicle.grade_pct == old_grade
        vehicle.location = location
        vehicle.lane = road.lanes[lane].index
        vehicle.movement = road.movement_turn[vehicle.approach, vehicle.exit]
        vehicle.blinker_right = vehicle.signals & 1
        vehicle.blinker_left = (vehicle.signals >> 1) & 1
        vehicle.wrong_lane = location == APPROACHING and road.next_lane[lane, vehicle.exit] < 0


@compiled(forceinline=True)
def mean_grade_pct(lane, position, length, approach, road):  # type: ignore[no-untyped-def]
    """Return the mean grade in percent under a vehicle, positive uphill, which is SUMO's slope from back to front.

    The junction before the controlled region, where the rear of a vehicle that enters still is, counts as level.
    """
    left, rise = length, 0.0
    for _ in range(ROUTE_LIMIT):
        first, k = road.lanes[lane].first_segment, road.lanes[lane + 1].first_segment - 1
        while k > first and road.segments[k].from_m >= position:
            k -= 1
        while left > 0.0 and k >= first:
            piece = min(left, position - road.segments[k].from_m)
            rise += piece * road.segments[k].grade_pct
            left -= piece
            position = road.segments[k].from_m
            k -= 1
        lane = road.prev_lane[lane, approach] if left > 0.0 else -1
        if lane < 0:
            break
        position = road.lanes[lane].length_m
    return rise / length
