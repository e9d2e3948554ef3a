"""The tables behind a frame: one row per vehicle in the controlled region, and what each column holds.

``floats [C, *]`` float64, ``ints [C, *]`` int64 and ``flags [C, *]`` uint8 have ``C`` rows. Columns that are *emitted*
are ``("vehicles", name)``; the others are working memory. A column's constant is its number, for compiled code.
"""

from __future__ import annotations

from collections.abc import Iterator


class Columns:
    """Names of a table's columns, in order; those that are emitted come first.

    Attributes:
        emitted: names of the emitted columns.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self.emitted: tuple[str, ...] = ()

    def emit(self, name: str) -> int:
        """Add a column that is emitted; return its number."""
        if len(self.emitted) != len(self._names):
            raise ValueError(f"{name!r} comes after a column that is not emitted")
        self.emitted += (name,)
        return self.keep(name)

    def keep(self, name: str) -> int:
        """Add a working column; return its number."""
        if name in self._names:
            raise ValueError(f"there is a column {name!r} already")
        self._names.append(name)
        return len(self._names) - 1

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)


FLOATS, INTS, FLAGS = Columns(), Columns(), Columns()

SPEED = FLOATS.emit("speed_mps")
ACCEL = FLOATS.emit("accel_mps2")  # over the last step: for a commanded CV the acceleration actually executed
LENGTH = FLOATS.emit("length_m")
PATH_POSITION = FLOATS.emit("path_position_m")  # front bumper along the route: negative before the stop line
STOP_LINE = FLOATS.emit("stop_line_distance_m")  # negative before the line, 0 in the junction, position on the exit
GAP = FLOATS.emit("leader_gap_m")  # bumper to bumper, along the route; 0 where has_leader is false
LEADER_SPEED = FLOATS.emit("leader_speed_mps")
GRADE = FLOATS.emit("grade_pct")
EMISSION = FLOATS.emit("emission_g")  # CO2 of the last step
LANE_POSITION = FLOATS.emit("lane_position_m")  # front bumper on its lane
PREV_ACCEL = FLOATS.keep("prev_accel_mps2")
JUNCTION_M = FLOATS.keep("junction_m")  # length of its way through the junction
SUM_EMISSION = FLOATS.keep("sum_emission_g")  # this and the next: from entering to crossing the stop line
SUM_STEPS = FLOATS.keep("sum_steps")
SUM_STOPPED = FLOATS.keep("sum_stopped_steps")
SUM_ACCEL = FLOATS.keep("sum_abs_accel")
SUM_JERK = FLOATS.keep("sum_abs_jerk")
MIN_TTC = FLOATS.keep("min_ttc_s")
ENTRY_M = FLOATS.keep("entry_m")  # path position where it entered
TTC = FLOATS.keep("ttc_s")
DELAY = FLOATS.keep("delay_s")  # time lost in the last step, against driving at the limit
TARGET = FLOATS.keep("target_mps")  # speed that was commanded last
CAP = FLOATS.keep("cap_mps")  # maximum speed set last, 0 before the first

LOCATION = INTS.emit("location")  # 0 approaching, 1 inside the junction, 2 leaving
APPROACH = INTS.emit("approach")  # index of the approach that it came from
EXIT = INTS.emit("exit")  # index of the exit that it goes to
LANE = INTS.emit("lane")  # 0 is the rightmost lane of its edge
MOVEMENT = INTS.emit("movement")  # 0 right, 1 straight, 2 left
MOVES_CLASS = INTS.emit("moves_class")  # row of the emission surrogate
NUMBER = INTS.emit("vehicle_number")  # the vehicle's number in the episode's demand
REGION_LANE = INTS.emit("region_lane")  # row of the lane in the road net
AGENT = INTS.keep("agent")  # its agent slot, or -1
LEADER = INTS.keep("leader")  # row of its leader, or -1
PLACE = INTS.keep("place")  # its index in the order of lanes and positions

PRESENT = FLAGS.emit("present")
IS_CV = FLAGS.emit("is_cv")
BLINKER_LEFT = FLAGS.emit("blinker_left")
BLINKER_RIGHT = FLAGS.emit("blinker_right")
HAS_LEADER = FLAGS.emit("has_leader")
DEFERRED = FLAGS.emit("deferred")
ELECTRIC = FLAGS.emit("electric")
COUNTED = FLAGS.keep("counted")  # it entered after the warm-up
COHORT = FLAGS.keep("cohort")  # it was scheduled to depart between warm-up and horizon
CROSSED = FLAGS.keep("crossed")
WRONG_LANE = FLAGS.keep("wrong_lane")  # its lane does not lead to its exit
FRESH = FLAGS.keep("fresh")  # it was given its row in this step
COMMANDED = FLAGS.keep("commanded")
STEADY = FLAGS.keep("steady")  # speed, acceleration and grade are those of the step before
YIELDING = FLAGS.keep("yielding")  # the simulator slows it for a lane change

VEHICLE_FLOATS, VEHICLE_INTS, VEHICLE_FLAGS = FLOATS.emitted, INTS.emitted, FLAGS.emitted
"""Columns of ``("vehicles", name)`` as float32, int32 and bool."""
