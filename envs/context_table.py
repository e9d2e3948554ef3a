"""The context features that a CV observes, as a table by movement."""

from __future__ import annotations

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.contexts.features import scales
from izoo.networks.road import RoadNet


def observed_table(context: Context, road: RoadNet, names: tuple[str, ...]) -> np.ndarray:
    """Return ``[P, Q, O]`` scaled values of the named features for every movement of the net."""
    shape = road.movement_turn.shape
    values = {
        "adoption": context.adoption,
        "green_s": road.clock.green_s,
        "red_s": road.clock.red_s,
        "temperature_c": context.temperature_c,
        "humidity_pct": context.humidity_pct,
        "engine": float(ENGINES.index(context.engine)),
        "lane_count": road.lane_count[:, None],
        "lane_length_m": road.lane_length_m[:, None],
        "speed_limit_mps": road.speed_limit_mps[:, None],
    }
    columns = [np.broadcast_to(np.asarray(values[name], float), shape) for name in names]
    if not columns:
        return np.zeros((*shape, 0))
    return np.stack(columns, axis=-1) / np.array(scales(names))
