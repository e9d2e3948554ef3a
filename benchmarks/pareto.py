"""Points of a trade-off, which of them no other one beats, and their plot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from izoo.benchmarks.generalization_options import FLOOR_INFIX
from izoo.evaluation.policies import HUMAN
from izoo.files import replacing
from izoo.metrics.scores import pool
from izoo.reporting.results import Results, evaluation_of

SCORES = (
    "emission_g_per_vehicle",
    "travel_time_s_per_vehicle",
    "throughput",
    "unfinished_share",
    "comfort_mps2",
    "jerk_mps3",
    "min_ttc_s",
    "collisions",
)
"""Columns of the points; ``throughput`` and ``collisions`` are means per episode and approach."""
PER_EPISODE = ("throughput", "collisions")
AXES = ("emission_g_per_vehicle", "travel_time_s_per_vehicle")
"""What is traded, lower is better in both."""


def points(folder: Path, results: Results, weights: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Return a row per policy and training seed, human driving first.

    Args:
        folder: the results folder.
        results: its index.
        weights: of the reward, by the name of the trained entry.

    Returns:
        ``point``, ``train_seed``, ``kind``, the swept weights (empty where a point has none), ``floor_mps``,
        :data:`SCORES` over all vehicles of the test contexts, ``throughput_kept`` (at least that of human driving) and
        ``on_front`` (kept its throughput, and no other such point is better in one of :data:`AXES` and as good in the
        other).
    """
    swept = sorted({name for point in weights.values() for name in point})
    rows: list[dict[str, Any]] = []
    for entry in results.entries:
        for run in entry.done:
            pooled = pool(evaluation_of(folder, run), ["policy"]).set_index("policy")
            if not rows:
                rows.append({"point": HUMAN, "kind": "human", **_scores(pooled.loc[HUMAN])})
            floor = float(entry.name.removeprefix(FLOOR_INFIX)) if entry.name.startswith(FLOOR_INFIX) else np.nan
            seed = run.seed if entry.algo else pd.NA
            about = {"point": entry.name, "train_seed": seed, "kind": entry.kind, "floor_mps": floor}
            rows.append({**about, **weights.get(entry.name, {}), **_scores(pooled.loc[entry.name])})
    table = pd.DataFrame(rows, columns=["point", "train_seed", "kind", *swept, "floor_mps", *SCORES])
    table["train_seed"] = table["train_seed"].astype("Int64")
    table["throughput_kept"] = table["throughput"] >= table["throughput"].iloc[0]
    table["on_front"] = on_front(table[list(AXES)].to_numpy(float), table["throughput_kept"].to_numpy(bool))
    return table


def _scores(pooled: pd.Series) -> dict[str, float]:
    return {name: float(pooled[name]) / (float(pooled["rows"]) if name in PER_EPISODE else 1.0) for name in SCORES}


def on_front(costs: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return which points no other allowed point dominates, ``[N]``.

    Args:
        costs: ``[N, K]``, lower is better; a row with NaN is on no front.
        allowed: ``[N]``; points that are not allowed neither dominate nor are on the front.
    """
    allowed = allowed & ~np.isnan(costs).any(axis=1)
    no_worse = (costs[:, None] <= costs[None]).all(axis=-1)
    better = (costs[:, None] < costs[None]).any(axis=-1)
    dominated = (no_worse & better & allowed[:, None]).any(axis=0)
    return np.asarray(allowed & ~dominated)


def plot(table: pd.DataFrame, path: Path, title: str) -> None:
    """Draw emission against travel time; points that lost throughput are hollow, the front is a line."""
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.subplots()
    x, y = AXES
    for kind, colour in (("human", "#1a202c"), ("scripted", "#c05621"), ("trained", "#2b6cb0")):
        for kept in (True, False):
            chosen = table[(table["kind"] == kind) & (table["throughput_kept"] == kept)]
            label = kind + ("" if kept else ", throughput lost")
            face = colour if kept else "none"
            if len(chosen):
                axes.scatter(chosen[x], chosen[y], s=36, facecolors=face, edgecolors=colour, label=label, zorder=3)
    front = table[table["on_front"]].sort_values(x)
    axes.plot(front[x], front[y], color="#718096", linewidth=1.0, zorder=1, label="Pareto front")
    for row in table.drop_duplicates("point").itertuples():
        place = (getattr(row, x), getattr(row, y))
        axes.annotate(row.point, place, xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="CO2 per vehicle (g)", ylabel="travel time to the stop line (s)", title=title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, format="png")


def table(points: pd.DataFrame, title: str) -> Table:
    """Return the points as a table to read."""
    shown = Table(title=title, title_justify="left")
    for column in ("point", "seed", "g per vehicle", "travel time s", "vehicles", "front"):
        shown.add_column(column, justify="left" if column == "point" else "right")
    for row in points.itertuples():
        kept = "" if row.throughput_kept else " (fell)"
        shown.add_row(
            str(row.point),
            "" if pd.isna(row.train_seed) else str(row.train_seed),
            f"{row.emission_g_per_vehicle:.2f}",
            f"{row.travel_time_s_per_vehicle:.2f}",
            f"{row.throughput:.2f}{kept}",
            "yes" if row.on_front else "",
        )
    return shown
