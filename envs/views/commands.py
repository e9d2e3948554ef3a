"""Commands of a step, and the action spaces from which the Gymnasium and PettingZoo views read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from izoo.envs.config import (
    ACTION_HIGH_MPS2,
    ACTION_LOW_MPS2,
    KEEP_LANE,
    LANE_CHANGES,
    MIN_SHARE,
    SPEED,
    EnvConfig,
)
from izoo.errors import IzooError


class Commands(NamedTuple):
    """Commands to the CVs for one step.

    Attributes:
        action: ``[A, D]`` accelerations in m/s^2, or shares of the speed limit; NaN leaves a CV uncommanded and is
            counted.
        defer: ``[A]`` bool, CVs to leave uncommanded.
        lane_change: ``[A]`` 0 right, 1 keep, 2 left; read where the environment's settings have ``lane_change``.
    """

    action: np.ndarray
    defer: np.ndarray
    lane_change: np.ndarray


def action_space(config: EnvConfig, count: int | None) -> spaces.Space[Any]:
    """Return the space of a view's actions: accelerations, and with ``lane_change`` a dictionary of two entries.

    Where actions are desired speeds: shares, one for each of ``config.action_parts``.

    Args:
        config: the environment's settings.
        count: number of vehicles that act together; ``None``: one, whose lane change is a number, not an array.
    """
    if config.action == SPEED:
        return spaces.Box(MIN_SHARE, 1.0, _shape(config, count), np.float32)
    acceleration = spaces.Box(ACTION_LOW_MPS2, ACTION_HIGH_MPS2, _shape(config, count), np.float32)
    if not config.lane_change:
        return acceleration
    lanes = spaces.Discrete(LANE_CHANGES) if count is None else spaces.MultiDiscrete([LANE_CHANGES] * count)
    return spaces.Dict(acceleration=acceleration, lane_change=lanes)


def _shape(config: EnvConfig, count: int | None) -> tuple[int, ...]:
    """Return the shape of the numbers of an action."""
    size = config.action_size
    return (size,) if count is None else (count,) if size == 1 else (count, size)


def read_action(
    config: EnvConfig, action: Any, count: int | None, what: str = "the action"
) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers ``[count, D]`` and lane changes ``[count]`` of an action (``[1, ...]`` for ``None``).

    Raises:
        IzooError: an entry is missing or unknown, or is of another shape or type.
    """
    shape = (1,) if count is None else (count,)
    if not config.lane_change:
        return _numbers(config, action, count, what), np.full(shape, KEEP_LANE, np.int64)
    if not isinstance(action, Mapping) or set(action) != {"acceleration", "lane_change"}:
        got = f"has the keys {sorted(action)}" if isinstance(action, Mapping) else f"is a {type(action).__name__}"
        raise IzooError(
            f"{what} {got}; with lane_change=True, give a dictionary of 'acceleration' (m/s^2) and 'lane_change' "
            "(0 right, 1 keep, 2 left)."
        )
    lanes = np.asarray(action["lane_change"])
    legal = () if count is None else shape
    if lanes.shape != legal or lanes.dtype.kind not in "iu" or not np.isin(lanes, range(LANE_CHANGES)).all():
        shown = np.unique(lanes)[:5].tolist() if lanes.dtype.kind in "iuf" else lanes.dtype
        raise IzooError(
            f"'lane_change' of {what} is {lanes.dtype} of shape {list(lanes.shape)} with the values {shown}; give "
            f"whole numbers of shape {list(legal)}: 0 right, 1 keep, 2 left."
        )
    return _numbers(config, action["acceleration"], count, f"'acceleration' of {what}"), lanes.reshape(shape)


def _numbers(config: EnvConfig, values: Any, count: int | None, what: str) -> np.ndarray:
    array, shape = np.asarray(values), _shape(config, count)
    if array.shape != shape or not np.issubdtype(array.dtype, np.floating):
        kind = "shares of the speed limit" if config.action == SPEED else "accelerations in m/s^2"
        raise IzooError(
            f"{what} is {array.dtype} of shape {list(array.shape)}; give {kind} as floating-point numbers of shape "
            f"{list(shape)}."
        )
    return array.reshape(-1, config.action_size)
