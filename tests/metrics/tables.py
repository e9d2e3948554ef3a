"""Evaluation tables with chosen numbers, for the tests of scores, benefit and summary."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from izoo.metrics.definitions import APPROACH_METRICS


def episode_row(
    crossed: int,
    emission_g: float,
    *,
    policy: str = "ppo",
    context: str = "x/1/A",
    approach: str = "A",
    seed: int = 0,
    demand: str = "one",
    volume_over_capacity: float = 0.5,
    engine: str = "combustion",
    **sums: float,
) -> dict[str, object]:
    """One row: an approach in an episode; sums that are not given follow from ``crossed`` or are 0."""
    values = dict.fromkeys(APPROACH_METRICS, 0.0)
    values.update(entered=crossed, crossed=crossed, crossed_hdv=crossed, emission_g=emission_g)
    values.update(region_emission_g=emission_g, vehicle_steps=100.0 * crossed, travel_time_s=50.0 * crossed)
    values.update(distance_m=400.0 * crossed, region_time_s=60.0 * crossed, **sums)
    return {
        "policy": policy,
        "context": context,
        "context_hash": f"hash-{context}",
        "intersection": context.rsplit("/", 1)[0],
        "city": None,
        "approach": approach,
        "seed": seed,
        "demand": demand,
        "engine": engine,
        "adoption": 1 / 3,
        "volume_over_capacity": volume_over_capacity,
        **values,
    }


def seeds_table(crossed: Sequence[int], emission_g: Sequence[float], **settings: object) -> pd.DataFrame:
    """One approach over ``len(crossed)`` seeds."""
    pairs = zip(crossed, emission_g, strict=True)
    return pd.DataFrame([episode_row(c, e, seed=k, **settings) for k, (c, e) in enumerate(pairs)])  # type: ignore[arg-type]
