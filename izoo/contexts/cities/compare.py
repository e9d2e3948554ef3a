"""Compares intersections with a city's published feature distributions: total variation per feature."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from izoo.contexts.cities.copula import FEATURES, marginal
from izoo.contexts.cities.plans import measure
from izoo.contexts.context import HOUR_FACTOR
from izoo.contexts.spec import IntersectionSpec


def feature_table(specs: Iterable[IntersectionSpec]) -> pd.DataFrame:
    """Return a row per approach with its :data:`FEATURES`, as published (flow at peak, before the cap of 900 veh/h).

    Args:
        specs: with their signal plans, on which phase count and green share are measured.
    """
    rows = []
    for spec in specs:
        for leg in spec.legs:
            if leg.approach is not None and spec.signal_plan is not None:
                phases, share = measure(spec.signal_plan, leg.name)
                side, flow_vph = leg.approach, leg.approach.aadt_per_lane * HOUR_FACTOR["peak"]
                road = side.lane_count, side.grade, side.length_m, side.speed_limit_mps
                rows.append((*road, flow_vph, share, phases))
    return pd.DataFrame(rows, columns=list(FEATURES))


def total_variation(table: pd.DataFrame, city: str) -> dict[str, float]:
    """Return half the summed absolute difference to the published distribution, per feature, in [0, 1]."""
    distances = {}
    for name in FEATURES:
        published = marginal(city, name)
        share = published.prob / published.prob.sum()
        distances[name] = 0.5 * float(np.abs(published.histogram(table[name].to_numpy(float)) - share).sum())
    return distances


def format_distances(tables: Mapping[str, pd.DataFrame]) -> str:
    """Return the distances as a text table, one line per city."""
    width = max(len(city) for city in tables)
    lines = ["  ".join([" " * width, *FEATURES])]
    for city, table in tables.items():
        cells = [f"{value:.3f}".rjust(len(name)) for name, value in total_variation(table, city).items()]
        lines.append("  ".join([city.ljust(width), *cells]))
    return "\n".join(lines)
