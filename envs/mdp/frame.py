"""The memory layout of frames: one block for any number of environments.

A *frame* is what one environment emits in one step. All arrays of a frame share one buffer, which a worker process
and its parent both map; the worker writes its row in place and the parent copies from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from izoo.envs.config import EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.envs.mdp.observation import observation_columns
from izoo.envs.mdp.reward import REWARD_VECTOR

TEAM_REWARD = "team_reward"
"""Array ``[1]``: the fleet part of the reward in the step or decision; emitted at the root on demand."""
TOTALS = "totals"
"""Array ``[E + P * M]``: the episode's metrics, then those of each approach; also mapped as two arrays."""
CONTEXT_VALUES = ("adoption", "temperature_c", "humidity_pct", "engine")
CONTEXT_IDS = ("episode", "context_id", "seed")


def observation_names(config: EnvConfig) -> tuple[str, ...]:
    """Names of the ``F`` columns of ``("agents", "observation")``, in order."""
    return tuple(column.name for column in observation_columns(config.neighbours, config.observed))


@dataclass(frozen=True)
class Field:
    """One array of a frame: its name, element type and shape for one environment."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]


def frame_fields(config: EnvConfig) -> Iterator[Field]:
    """Yield the arrays of a frame; the action arrays are written by the parent, all others by the simulator."""
    a, v, p = config.num_agents, config.num_vehicles, config.num_approaches
    f = len(observation_names(config))
    f32, i32, i64, u8 = (np.dtype(t) for t in (np.float32, np.int32, np.int64, np.uint8))
    yield Field("action", f32, (a, config.action_size))
    yield Field("defer", u8, (a,))
    yield Field("lane_change", i64, (a,))
    yield Field("observation", f32, (a, f))
    yield Field("reward", f32, (a,))
    yield Field("mask", u8, (a,))
    yield Field("decides", u8, (a,))
    yield Field("number", i64, (a,))
    yield Field("agent_terminated", u8, (a,))
    yield Field("agent_truncated", u8, (a,))
    yield Field("agent_done", u8, (a,))
    yield Field("agent_vehicle", i64, (a,))
    yield Field("terminated", u8, (1,))
    yield Field("truncated", u8, (1,))
    yield Field("done", u8, (1,))
    yield Field("reward_vector", f32, (a, len(REWARD_VECTOR)))
    yield Field(TEAM_REWARD, f32, (1,))
    yield Field("vehicle_floats", f32, (v, len(VEHICLE_FLOATS)))
    yield Field("vehicle_ints", i32, (v, len(VEHICLE_INTS)))
    yield Field("vehicle_flags", u8, (v, len(VEHICLE_FLAGS)))
    yield Field("signal_colour", i32, (p, p))
    yield Field("signal_time_left_s", f32, (p, p))
    yield Field(TOTALS, f32, (len(EPISODE_METRICS) + p * len(APPROACH_METRICS),))
    yield Field("approach_mask", u8, (p,))
    yield Field("context_values", f32, (len(CONTEXT_VALUES),))
    yield Field("context_ids", i64, (len(CONTEXT_IDS),))  # episode number, context id or -1, seed


def frame_types() -> Iterator[tuple[str, str, int, int]]:
    """Yield name, element type and dimensions of the arrays of a frame, for compiled code."""
    for field in frame_fields(EnvConfig()):
        if field.name != TOTALS:
            yield field.name, field.dtype.name, len(field.shape), 0
    yield "episode_metrics", "float32", 1, 0
    yield "approach_metrics", "float32", 2, 0


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


def row_of(frames: dict[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
    """Return the arrays of one environment."""
    return {name: array[index] for name, array in frames.items()}


def _padded(field: Field, num_envs: int) -> int:
    """Bytes of one array, rounded up to cache lines so that rows of different arrays never share one."""
    size = int(np.prod((num_envs, *field.shape))) * field.dtype.itemsize
    return -(-size // 64) * 64
