"""Where every number of a frame lies: named columns, and one block of memory for any number of environments.

A *frame* is what one environment emits in one step. All arrays of a frame share one buffer, which a worker process
and its parent both map; the worker writes its row in place and the parent copies what it needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from izoo.envs.config import EnvConfig
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS

FAR_M = 1000.0
"""Distance reported for a neighbour that is not there; its speed and blinkers are 0 and its flag ``present`` is 0."""
SPEED_SCALE_MPS, DISTANCE_SCALE_M, TIME_SCALE_S = 15.0, 250.0, 100.0
TTC_CAP_S = 10.0

VEHICLE_FLOATS = (
    "speed_mps",
    "accel_mps2",  # realised over the last step: for a commanded CV this is the applied acceleration
    "length_m",
    "path_position_m",  # of the front bumper along the route: negative before the stop line, continuous after it
    "stop_line_distance_m",  # negative before the stop line, 0 inside the junction, position on the exit after it
    "leader_gap_m",  # bumper to bumper, along the route; 0 where has_leader is false
    "leader_speed_mps",
    "grade_pct",
    "emission_g",  # CO2 of the last step
    "lane_position_m",  # front bumper on its lane
)
"""Columns of ``("vehicles", name)`` as float32."""
(SPEED, ACCEL, LENGTH, PATH_POSITION, STOP_LINE, GAP, LEADER_SPEED, GRADE, EMISSION, LANE_POSITION) = range(10)
# Working columns that are not emitted.
(PREV_ACCEL, JUNCTION_M, SUM_EMISSION, SUM_STEPS, SUM_STOPPED) = range(10, 15)
(SUM_ACCEL, SUM_JERK, MIN_TTC, ENTRY_M, TTC, TARGET) = range(15, 21)
NUM_FLOATS = 21

VEHICLE_INTS = (
    "location",  # 0 approaching, 1 inside the junction, 2 leaving
    "approach",  # index of the approach that it came from
    "exit",  # index of the exit that it goes to
    "lane",  # 0 is the rightmost lane of its edge
    "movement",  # 0 right, 1 straight, 2 left
    "moves_class",  # row of the emission surrogate
    "vehicle_number",  # the vehicle's number in the episode's demand
    "region_lane",  # row of the lane in the road net
)
"""Columns of ``("vehicles", name)`` as int32."""
(LOCATION, APPROACH, EXIT, LANE, MOVEMENT, MOVES_CLASS, NUMBER, REGION_LANE) = range(8)
(AGENT, PLACE) = range(8, 10)
NUM_INTS = 10

VEHICLE_FLAGS = ("present", "is_cv", "blinker_left", "blinker_right", "has_leader", "deferred")
"""Columns of ``("vehicles", name)`` as bool."""
(PRESENT, IS_CV, BLINKER_LEFT, BLINKER_RIGHT, HAS_LEADER, DEFERRED) = range(6)
(COUNTED, CROSSED, ELECTRIC, WRONG_LANE, FRESH, COMMANDED, STEADY) = range(6, 13)
NUM_FLAGS = 13

REWARD_COLUMNS = ("speed_mps", "stopped", "emission_g", "comfort", "realism")
"""Individual columns of ``("agents", "reward_vector")``; the same names with ``fleet_`` follow, then ``min_ttc_s``."""
REWARD_VECTOR = (*REWARD_COLUMNS, *(f"fleet_{name}" for name in REWARD_COLUMNS), "min_ttc_s")

EGO_FEATURES = (
    "speed",
    "stop_line_distance",
    "location_approaching",
    "location_inside",
    "location_leaving",
    "lane",
    "intention_right",
    "intention_straight",
    "intention_left",
    "signal_green",
    "signal_yellow",
    "signal_red",
    "signal_time_left",
    "signal_second_green",
    "signal_third_green",
)
NEIGHBOUR_FEATURES = ("speed", "distance", "blinker_left", "blinker_right", "present", "lane_exists")

METRIC = {name: column for column, name in enumerate(APPROACH_METRICS)}
EPISODE_METRIC = {name: column for column, name in enumerate(EPISODE_METRICS)}
TOTALS = "totals"
"""Array ``[E + P * M]``: the episode's metrics, then those of each approach; also mapped as two arrays."""
CONTEXT_VALUES = ("adoption", "temperature_c", "humidity_pct", "engine")


def observation_names(config: EnvConfig) -> tuple[str, ...]:
    """Names of the ``F`` columns of ``("agents", "observation")``, in order."""
    seen = tuple(f"{neighbour}_{name}" for neighbour in config.neighbours for name in NEIGHBOUR_FEATURES)
    return (*EGO_FEATURES, *seen, *(f"context_{name}" for name in config.observed))


@dataclass(frozen=True)
class Field:
    """One array of a frame: its name, element type and shape for one environment."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]


def frame_fields(config: EnvConfig) -> Iterator[Field]:
    """Yield the arrays of a frame; the action arrays are written by the parent, all others by the worker."""
    a, v, p = config.num_agents, config.num_vehicles, config.num_approaches
    f = len(observation_names(config))
    f32, i32, i64, u8 = (np.dtype(t) for t in (np.float32, np.int32, np.int64, np.uint8))
    yield Field("action", f32, (a,))
    yield Field("defer", u8, (a,))
    yield Field("lane_change", i64, (a,))
    yield Field("observation", f32, (a, f))
    yield Field("reward", f32, (a,))
    yield Field("mask", u8, (a,))
    yield Field("agent_terminated", u8, (a,))
    yield Field("agent_truncated", u8, (a,))
    yield Field("agent_done", u8, (a,))
    yield Field("agent_vehicle", i64, (a,))
    yield Field("terminated", u8, (1,))
    yield Field("truncated", u8, (1,))
    yield Field("done", u8, (1,))
    yield Field("reward_vector", f32, (a, len(REWARD_VECTOR)))
    yield Field("vehicle_floats", f32, (v, len(VEHICLE_FLOATS)))
    yield Field("vehicle_ints", i32, (v, len(VEHICLE_INTS)))
    yield Field("vehicle_flags", u8, (v, len(VEHICLE_FLAGS)))
    yield Field("signal_colour", i32, (p, p))
    yield Field("signal_time_left_s", f32, (p, p))
    yield Field(TOTALS, f32, (len(EPISODE_METRICS) + p * len(APPROACH_METRICS),))
    yield Field("approach_mask", u8, (p,))
    yield Field("context_values", f32, (len(CONTEXT_VALUES),))
    yield Field("context_ids", i64, (3,))  # episode number, context id or -1, seed


def frame_bytes(config: EnvConfig, num_envs: int) -> int:
    """Size of the buffer that holds the frames of ``num_envs`` environments."""
    return sum(_padded(field, num_envs) for field in frame_fields(config))


def map_frames(buffer: Any, config: EnvConfig, num_envs: int) -> dict[str, np.ndarray]:
    """Return the arrays ``[num_envs, *shape]`` by name, all of them views of ``buffer``."""
    arrays: dict[str, np.ndarray] = {}
    offset = 0
    for field in frame_fields(config):
        shape = (num_envs, *field.shape)
        arrays[field.name] = np.ndarray(shape, field.dtype, buffer, offset)
        offset += _padded(field, num_envs)
    episode, approach = np.split(arrays[TOTALS], [len(EPISODE_METRICS)], axis=1)
    arrays["episode_metrics"] = episode
    arrays["approach_metrics"] = approach.reshape(num_envs, config.num_approaches, len(APPROACH_METRICS))
    return arrays


def _padded(field: Field, num_envs: int) -> int:
    """Bytes of one array, rounded up to cache lines so that rows of different arrays never share one."""
    size = int(np.prod((num_envs, *field.shape))) * field.dtype.itemsize
    return -(-size // 64) * 64
