"""Scores per vehicle, from the sums and counts of :mod:`izoo.metrics.definitions`: one definition, two forms.

Each score is a ratio of two sums, or a plain sum. :func:`score_tensors` serves training (torch, value and validity);
:func:`add_scores` serves tables (pandas), where a mean over nothing is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS, DEMAND


@dataclass(frozen=True)
class Score:
    """A score: ``sum of numerator columns / sum of denominator columns``, or the first alone without a denominator.

    Attributes:
        label: the score in words.
        numerator: names of sums, added up.
        denominator: the same; may be empty.
        unit: of the score.
        better: ``lower``, ``higher`` or ``neither``.
    """

    label: str
    numerator: tuple[str, ...]
    denominator: tuple[str, ...]
    unit: str
    better: str


SCORES: dict[str, Score] = {
    "emission_g_per_vehicle": Score("emission per vehicle", ("emission_g",), ("crossed",), "g", "lower"),
    "throughput": Score("vehicles that crossed", ("crossed",), (), "veh", "higher"),
    "travel_time_s_per_vehicle": Score("travel time to the stop line", ("travel_time_s",), ("crossed",), "s", "lower"),
    "approach_speed_mps": Score("approach speed", ("distance_m",), ("travel_time_s",), "m/s", "higher"),
    "stopped_time_s_per_vehicle": Score("stopped time", ("stopped_time_s",), ("crossed",), "s", "lower"),
    "emission_g_per_vehicle_step": Score(
        "emission per vehicle and step", ("emission_g",), ("vehicle_steps",), "g", "lower"
    ),
    "emission_hdv_g_per_vehicle": Score(
        "emission per human-driven vehicle", ("emission_hdv_g",), ("crossed_hdv",), "g", "lower"
    ),
    "region_emission_g_per_vehicle": Score(
        "emission in the whole region per vehicle", ("region_emission_g",), ("entered",), "g", "lower"
    ),
    "demand_emission_g_per_vehicle": Score(
        "emission of the whole demand per vehicle",
        ("emission_g", "unfinished_emission_g", "held_up_emission_g"),
        ("crossed",),
        "g",
        "lower",
    ),
    "served_share": Score("share of the demand that crossed", ("crossed",), DEMAND, "", "higher"),
    "unfinished_share": Score("share that had not crossed", ("unfinished",), ("entered",), "", "lower"),
    "waiting_vehicles": Score("waiting to enter at the end", ("waiting",), (), "veh", "lower"),
    "dropped_vehicles": Score("dropped before they entered", ("dropped",), (), "veh", "lower"),
    "comfort_mps2": Score("mean absolute acceleration", ("abs_accel_sum",), ("vehicle_steps",), "m/s2", "lower"),
    "jerk_mps3": Score("mean absolute jerk", ("abs_jerk_sum",), ("vehicle_steps",), "m/s3", "lower"),
    "min_ttc_s": Score("smallest time to collision", ("min_ttc_sum_s",), ("min_ttc_vehicles",), "s", "higher"),
    "collisions": Score("collisions", ("collisions_cv", "collisions_hdv"), (), "", "lower"),
    "deferred_share": Score("share of commands left to SUMO", ("deferred_steps",), ("agent_steps",), "", "neither"),
    "nan_share": Score("share of commands that were NaN", ("nan_actions",), ("agent_steps",), "", "lower"),
    "red_crossings": Score("crossings on red", ("red_crossings_cv", "red_crossings_hdv"), (), "veh", "lower"),
}
"""Every score by name, the headline first. ``emission_g_per_vehicle_step`` rewards slowness: not primary."""

TIME_WEIGHT_G_PER_S = 1.0
"""Default lambda of the objective J, in g CO2 per vehicle second: about what an idling car emits."""


def score_tensors(sums: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
    """Compute every score whose sums are given.

    Args:
        sums: float sums by name, all of one shape ``[*B]`` (add over approaches or episodes beforehand, as wanted).

    Returns:
        ``(value, valid)`` by score, both ``[*B]``; the value is 0 where the denominator is 0 and ``valid`` false.
    """
    result: dict[str, tuple[Tensor, Tensor]] = {}
    for name, score in SCORES.items():
        if any(column not in sums for column in (*score.numerator, *score.denominator)):
            continue
        top = torch.stack([sums[column] for column in score.numerator]).sum(0)
        if not score.denominator:
            result[name] = (top, torch.ones_like(top, dtype=torch.bool))
            continue
        bottom = torch.stack([sums[column] for column in score.denominator]).sum(0)
        valid = bottom > 0
        ones = torch.ones_like(bottom)
        result[name] = (torch.where(valid, top / torch.where(valid, bottom, ones), torch.zeros_like(top)), valid)
    return result


def add_scores(table: pd.DataFrame, time_weight_g_per_s: float = TIME_WEIGHT_G_PER_S) -> pd.DataFrame:
    """Return ``table`` with a column per score, and ``objective_g``, the objective J.

    Args:
        table: rows with the columns :data:`~izoo.metrics.definitions.APPROACH_METRICS`.
        time_weight_g_per_s: lambda: grams of CO2 that a second in the region weighs.

    Returns:
        A copy; a score is NaN where its denominator is 0 (nothing crossed, nobody was controlled, ...).
        ``objective_g = region_emission_g + lambda * region_time_s`` counts vehicles that did not finish too.
    """
    require_columns(table, APPROACH_METRICS)
    columns: dict[str, pd.Series] = {}
    for name, score in SCORES.items():
        top = table[list(score.numerator)].sum(axis=1)
        bottom = table[list(score.denominator)].sum(axis=1).astype(float)
        columns[name] = (top / bottom.where(bottom > 0)).astype(float) if score.denominator else top
    columns["objective_g"] = table["region_emission_g"] + time_weight_g_per_s * table["region_time_s"]
    return table.drop(columns=[name for name in columns if name in table]).assign(**columns)


def nan_share_of(tables: Iterable[pd.DataFrame]) -> float:
    """Return the share of commands that were NaN, over all rows of the tables; 0 where nobody was commanded."""
    sums = [table[["nan_actions", "agent_steps"]].sum().to_numpy(float) for table in tables]
    nan, commands = np.sum(sums, axis=0) if sums else (0.0, 0.0)
    return float(nan / commands) if commands else 0.0


def pool(table: pd.DataFrame, by: Sequence[str], time_weight_g_per_s: float = TIME_WEIGHT_G_PER_S) -> pd.DataFrame:
    """Add the sums of all rows that agree on ``by``, then score: every vehicle weighs the same.

    Returns:
        One row per group, with the group's columns, the sums, ``rows`` (how many were added) and the scores.
    """
    require_columns(table, (*by, *APPROACH_METRICS))
    grouped = table.groupby(list(by), sort=False, dropna=False)
    sums = grouped[list(APPROACH_METRICS)].sum().assign(rows=grouped.size()).reset_index()
    return add_scores(sums, time_weight_g_per_s)


def require_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise :class:`IzooError` unless ``table`` has all of ``columns``."""
    missing = [column for column in columns if column not in table]
    if missing:
        raise IzooError(
            f"the evaluation table lacks the column(s) {', '.join(missing)}; it was written by another version of izoo "
            "or cut short: evaluate again into a new folder."
        )
