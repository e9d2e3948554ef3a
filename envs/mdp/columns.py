"""The record of a vehicle in the controlled region, and which of its fields are emitted as ``("vehicles", name)``."""

from __future__ import annotations

import numpy as np

VEHICLE_FLOATS: tuple[str, ...] = (
    "speed_mps",
    "accel_mps2",  # over the last step: for a commanded CV the acceleration actually executed
    "length_m",
    "path_position_m",  # front bumper along the route: negative before the stop line
    "stop_line_distance_m",  # negative before the line, 0 in the junction, position on the exit
    "leader_gap_m",  # bumper to bumper, along the route; 0 where has_leader is false
    "leader_speed_mps",
    "grade_pct",
    "emission_g",  # CO2 of the last step
    "lane_position_m",  # front bumper on its lane
)
"""Fields that are emitted as float32, in their order."""
VEHICLE_INTS: tuple[str, ...] = (
    "location",  # 0 approaching, 1 inside the junction, 2 leaving
    "approach",  # index of the approach that it came from
    "exit",  # index of the exit that it goes to
    "lane",  # 0 is the rightmost lane of its edge
    "movement",  # 0 right, 1 straight, 2 left
    "moves_class",  # row of the emission surrogate
    "vehicle_number",  # the vehicle's number in the episode's demand
    "region_lane",  # row of the lane in the road net
)
"""Fields that are emitted as int32."""
VEHICLE_FLAGS: tuple[str, ...] = (
    "present",
    "is_cv",
    "blinker_left",
    "blinker_right",
    "has_leader",
    "deferred",
    "electric",
)
"""Fields that are emitted as bool."""
_OTHER_FLOATS = (
    "prev_accel_mps2",
    "reported_speed_mps",  # as the simulator reports it, before it becomes the speed
    "junction_m",  # length of its way through the junction
    "sum_emission_g",  # this and the next: from entering to crossing the stop line
    "sum_steps",
    "sum_stopped_steps",
    "sum_abs_accel",
    "sum_abs_jerk",
    "min_ttc_s",
    "entry_m",  # path position where it entered
    "ttc_s",
    "delay_s",  # time lost in the last step, against driving at the limit
    "target_mps",  # speed that was commanded last
    "cap_mps",  # maximum speed set last, 0 before the first
)
_OTHER_INTS = (
    "agent",  # its agent slot, or -1
    "leader",  # row of its leader, or -1
    "place",  # its index in the order of lanes and positions
    "signals",  # bits that the simulator reports: 1 right blinker, 2 left blinker
)
_OTHER_FLAGS = (
    "counted",  # it entered after the warm-up
    "cohort",  # it was scheduled to depart between warm-up and horizon
    "crossed",
    "wrong_lane",  # its lane does not lead to its exit
    "fresh",  # it was given its row in this step
    "commanded",
    "steady",  # speed, acceleration and grade are those of the step before
    "yielding",  # the simulator slows it for a lane change
)
Vehicle = np.dtype(
    [
        *((name, np.float64) for name in (*VEHICLE_FLOATS, *_OTHER_FLOATS)),
        *((name, np.int32) for name in (*VEHICLE_INTS, *_OTHER_INTS)),
        *((name, np.uint8) for name in (*VEHICLE_FLAGS, *_OTHER_FLAGS)),
    ],
    align=True,
)
"""A vehicle: ``vehicles[r].speed_mps`` in compiled code, ``vehicles["speed_mps"][r]`` in NumPy."""
