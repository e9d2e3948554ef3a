"""Compares intersections with a city's published feature distributions: total variation per feature."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from izoo.contexts.cities.copula import FEATURES, marginal
from izoo.contexts.cities.plans import measure
from izoo.contexts.cities.rebuilt import get
from izoo.contexts.context import HOUR_FACTOR
from izoo.contexts.spec import IntersectionSpec


def approach_features(spec: IntersectionSpec) -> Iterator[dict[str, float]]:
    """Yield the features of every approach, as published (flow at peak, before the cap of 900 veh/h).

    Phase count and green share are measured on the signal plan, and NaN without one.
    """
    for leg in spec.legs:
        if leg.approach is not None:
            phases, share = measure(spec.signal_plan, leg.name) if spec.signal_plan else (math.nan, math.nan)
            yield {
                "lane_count": leg.approach.lane_count,
                "grade": leg.approach.grade,
                "lane_length_m": leg.approach.length_m,
                "speed_limit_mps": leg.approach.speed_limit_mps,
                "inflow_peak_vph": leg.approach.aadt_per_lane * HOUR_FACTOR["peak"],
                "signal_time_ratio": share,
                "phase_count": phases,
            }


def feature_table(specs: Iterable[IntersectionSpec]) -> np.ndarray:
    """Return ``[R, 7]``: the features of every approach; intersections without a plan are left out."""
    rows = [row for spec in specs if spec.signal_plan is not None for row in approach_features(spec)]
    return np.array([[row[name] for name in FEATURES] for row in rows], float).reshape(-1, len(FEATURES))


def total_variation(table: np.ndarray, city: str) -> dict[str, float]:
    """Return half the summed absolute difference to the published distribution, per feature, in [0, 1]."""
    distances = {}
    for index, name in enumerate(FEATURES):
        published = marginal(city, name)
        share = published.prob / published.prob.sum()
        distances[name] = 0.5 * float(np.abs(published.histogram(table[:, index]) - share).sum())
    return distances


def compare_cities(cities: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the feature table of each rebuilt city."""
    return {city: feature_table(get(city)) for city in cities}


def format_distances(tables: Mapping[str, np.ndarray]) -> str:
    """Return the distances as a text table, one line per city."""
    width = max(len(city) for city in tables)
    lines = ["  ".join([" " * width, *FEATURES])]
    for city, table in tables.items():
        cells = [f"{value:.3f}".rjust(len(name)) for name, value in total_variation(table, city).items()]
        lines.append("  ".join([city.ljust(width), *cells]))
    return "\n".join(lines)
