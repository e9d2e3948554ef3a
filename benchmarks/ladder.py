"""How far the twin is from SUMO: per approach, per policy, and in what policies gain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table

from izoo.evaluation.policies import HUMAN
from izoo.files import replacing
from izoo.metrics.benefit import benefits

MEASURES = {
    "co2_g": ("emission_g", "crossed"),
    "crossed": ("crossed", None),
    "travel_time_s": ("travel_time_s", "crossed"),
    "stopped_s": ("stopped_time_s", "crossed"),
}
"""What is compared per approach: a sum, over a count or (``None``) over episodes."""
KEY = ["policy", "context", "context_hash", "approach"]
WIDE = 0.05
"""Differences of CO2 above this, beyond SUMO's own spread, are named."""


def approaches(sumo: pd.DataFrame, twin: pd.DataFrame) -> pd.DataFrame:
    """Compare two evaluations of the same contexts and seeds, a row per policy and approach.

    Args:
        sumo, twin: tables as ``izoo.evaluate`` writes them.

    Returns:
        :data:`KEY`, ``lanes``, and per measure ``*_sumo``, ``*_twin`` (means over seeds), ``*_difference`` (relative to
        SUMO; of crossed vehicles too) and ``*_spread`` (standard error of SUMO's mean over its seeds, relative).
        Approaches that nobody crosses in SUMO have no differences (NaN).
    """
    joined = sumo.merge(twin, on=[*KEY, "seed"], suffixes=("_sumo", "_twin"), validate="one_to_one")
    rows = []
    for key, group in joined.groupby(KEY, sort=False):
        row: dict[str, Any] = dict(zip(KEY, key, strict=True)) | {"seeds": len(group)}
        row["lanes"] = int(group["lane_count_sumo"].iloc[0])
        for name, (total, count) in MEASURES.items():
            values = {side: _per_seed(group, total, count, side) for side in ("sumo", "twin")}
            centre = {side: _mean(column) for side, column in values.items()}
            row |= {f"{name}_{side}": centre[side] for side in centre}
            row[f"{name}_difference"] = centre["twin"] / centre["sumo"] - 1.0 if centre["sumo"] else np.nan
            known = values["sumo"][~np.isnan(values["sumo"])]
            error = known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else np.nan
            row[f"{name}_spread"] = error / centre["sumo"] if centre["sumo"] else np.nan
        rows.append(row)
    return pd.DataFrame(rows)


def _per_seed(group: pd.DataFrame, total: str, count: str | None, side: str) -> np.ndarray:
    sums = group[f"{total}_{side}"].to_numpy(float)
    if count is None:
        return sums
    counts = group[f"{count}_{side}"].to_numpy(float)
    return np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else np.nan


def exactness(exact: pd.DataFrame) -> pd.DataFrame:
    """Sum up episodes that were compared step by step, a row per policy, demand and kind of approach.

    Args:
        exact: a row per episode, as :func:`izoo.benchmarks.twin.compare_steps` returns them.
    """
    if exact.empty:
        return pd.DataFrame()
    kinds = np.where(exact["lanes"] == 1, "one lane", "several lanes")
    rows = []
    for key, group in exact.assign(kind=kinds).groupby(["policy", "demand", "kind"], sort=False):
        parted = group["parted"].dropna()
        rows.append(
            dict(zip(("policy", "demand", "kind"), key, strict=True))
            | {
                "episodes": len(group),
                "same": len(group) - len(parted),
                "median_parted": float(parted.median()) if len(parted) else np.nan,
                "ks_speed": float(group["ks_speed"].mean()),
                "ks_accel": float(group["ks_accel"].mean()),
            }
        )
    return pd.DataFrame(rows)


def rungs(table: pd.DataFrame) -> pd.DataFrame:
    """Sum :func:`approaches` up, a row per policy and kind of approach (one lane, several)."""
    kinds = np.where(table["lanes"] == 1, "one lane", "several lanes")
    rows = []
    for (policy, kind), group in table.assign(kind=kinds).groupby(["policy", "kind"], sort=False):
        away = group["co2_g_difference"].abs()
        beyond = away - group["co2_g_spread"].fillna(0.0) > WIDE
        rows.append(
            {
                "policy": policy,
                "kind": kind,
                "approaches": int(away.notna().sum()),
                "co2_mean_abs": float(away.mean()),
                "co2_bias": float(group["co2_g_difference"].mean()),
                "co2_median_abs": float(away.median()),
                "co2_worst": float(away.max()),
                "co2_beyond": int(beyond.sum()),
                "co2_spread": float(group["co2_g_spread"].mean()),
                "crossed": _change(group, "crossed"),
                "crossed_mean_abs": float(group["crossed_difference"].abs().mean()),
                "travel_time": float(group["travel_time_s_difference"].mean()),
                "stopped": _change(group, "stopped_s"),
            }
        )
    return pd.DataFrame(rows)


def _change(group: pd.DataFrame, name: str) -> float:
    """Return how much larger a measure is on the twin, summed over approaches; NaN where it is 0 in SUMO."""
    sumo, twin = (float(group[f"{name}_{side}"].sum()) for side in ("sumo", "twin"))
    return twin / sumo - 1.0 if sumo else np.nan


def gains(sumo: pd.DataFrame, twin: pd.DataFrame) -> pd.DataFrame:
    """Return the mean benefit over human driving, ungated, in SUMO and on the twin, of policies played on both."""
    rows = []
    played = set(twin["policy"])
    for policy in [name for name in sumo["policy"].unique() if name != HUMAN and name in played]:
        found = {}
        for side, table in (("sumo", sumo), ("twin", twin)):
            chosen, human = (table[table["policy"] == name] for name in (policy, HUMAN))
            found[side] = float(benefits(chosen, human)["benefit_ungated"].mean())
        rows.append({"policy": policy, **found, "difference": found["twin"] - found["sumo"]})
    return pd.DataFrame(rows)


def same_order(gained: pd.DataFrame) -> bool:
    """Whether policies rank the same on both."""
    return bool((gained["sumo"].rank() == gained["twin"].rank()).all())


def ks_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Kolmogorov-Smirnov distance of two histograms over the same bins; NaN where one is empty."""
    if not one.sum() or not other.sum():
        return float("nan")
    return float(np.abs(np.cumsum(one) / one.sum() - np.cumsum(other) / other.sum()).max())


def tables(exact: pd.DataFrame, summed: pd.DataFrame, gained: pd.DataFrame) -> list[Table]:
    """Return :func:`exactness`, :func:`rungs` and :func:`gains` as tables to read."""
    steps = _table("Every vehicle and step", "policy", "demand", "approaches", "episodes", "the same", "else parted at")
    for row in exact.itertuples():
        parted = "" if np.isnan(row.median_parted) else f"step {row.median_parted:.0f} (median)"
        steps.add_row(row.policy, row.demand, row.kind, f"{row.episodes}", f"{row.same}", parted)
    co2 = _table(
        "CO2 per vehicle, twin against SUMO", "policy", "approaches", "n", "mean |d|", "median", "bias", "worst"
    )
    co2.add_column("> 5 %", justify="right", no_wrap=True)
    others = _table(
        "Vehicles, twin against SUMO", "policy", "approaches", "crossed", "mean |d|", "travel time", "stopped"
    )
    for row in summed.itertuples():
        co2.add_row(
            *(row.policy, row.kind, f"{row.approaches}", f"{row.co2_mean_abs:.2%}", f"{row.co2_median_abs:.3%}"),
            *(f"{row.co2_bias:+.2%}", f"{row.co2_worst:.1%}", f"{row.co2_beyond}"),
        )
        others.add_row(
            *(row.policy, row.kind, f"{row.crossed:+.2%}", f"{row.crossed_mean_abs:.2%}"),
            *(f"{row.travel_time:+.2%}", f"{row.stopped:+.2%}"),
        )
    benefit = _table("Benefit over human driving, not gated", "policy", "SUMO", "twin", "difference in points")
    for row in gained.itertuples():
        benefit.add_row(row.policy, f"{row.sumo:+.2%}", f"{row.twin:+.2%}", f"{100 * row.difference:+.2f}")
    return [steps, co2, others, benefit]


def _table(title: str, *columns: str) -> Table:
    shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        words = column in ("policy", "demand", "approaches")
        shown.add_column(column, justify="left" if words else "right", no_wrap=True)
    return shown


def plot(table: pd.DataFrame, path: Path, title: str) -> None:
    """Draw the CO2 of every approach on the twin against that in SUMO, a panel per policy."""
    policies: Sequence[str] = list(table["policy"].unique())
    figure = Figure(figsize=(3.6 * len(policies), 4.2), layout="constrained")
    for axes, policy in zip(figure.subplots(1, len(policies), squeeze=False)[0], policies, strict=True):
        group = table[table["policy"] == policy]
        largest = 1.05 * float(np.nanmax(group[["co2_g_sumo", "co2_g_twin"]].to_numpy(float), initial=1.0))
        axes.fill_between([0, largest], [0, 0.95 * largest], [0, 1.05 * largest], color="#e2e8f0", label="within 5 %")
        for one_lane, colour, label in ((True, "#2b6cb0", "one lane"), (False, "#c05621", "several lanes")):
            chosen = group[(group["lanes"] == 1) == one_lane]
            axes.scatter(chosen["co2_g_sumo"], chosen["co2_g_twin"], s=12, color=colour, alpha=0.7, label=label)
        axes.set(xlim=(0, largest), ylim=(0, largest), title=policy, xlabel="SUMO: CO2 per vehicle (g)")
        axes.set_aspect("equal")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("twin: CO2 per vehicle (g)")
    figure.suptitle(title, fontsize=11)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, format="png")
