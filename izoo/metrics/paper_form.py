"""The measure of the published figures, from the same rows: shown only beside the paper's own figures.

CO2 up to the stop line per vehicle that crossed it within the horizon, over human driving. Where the mean throughput
falls the benefit is 0 (the exact gate): on the approach, or at the whole intersection where all approaches have demand.
Shares are fractions here, as in the paper.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from izoo.metrics.figures import Array
from izoo.metrics.pairing import CONTEXT, HUMAN, matched

APPROACH = [*CONTEXT, "approach"]


def paper_form(table: pd.DataFrame, policy: str) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the paper's benefit of a policy on each approach, and its aggregates.

    Args:
        table: rows of one simulator, with those of human driving.

    Returns:
        One row per training seed, context and approach: ``throughput_policy`` and ``throughput_baseline`` (vehicles,
        means over episode seeds), ``emission_policy_g`` and ``emission_baseline_g`` (g per vehicle that crossed, means
        over the episodes in which both are defined), ``throughput_benefit``, ``benefit_ungated``, ``gated``, ``fell``
        (whether it is this approach that closes the gate), ``benefit``, and ``left_out``: why the row has no benefit
        (no traffic; nobody crossed under human driving), or the empty string. Where nobody crossed under the policy its
        benefit is 0.
        The aggregates are those of :func:`paper_aggregates`.

    Raises:
        IzooError: human driving lacks episodes of the policy.
    """
    own, human = matched(table, policy, HUMAN)
    keys = own.groupby(APPROACH, sort=False)
    number, count = keys.ngroup().to_numpy(), keys.ngroups

    def added(values: Array) -> Array:
        return np.bincount(number, weights=values, minlength=count).astype(np.float64)

    def sums(rows: pd.DataFrame, name: str) -> Array:
        return added(rows[name].to_numpy(float))

    rows = keys[["context", "demand"]].first()
    sides = {"policy": own, "baseline": human}
    crossed = {side: part["crossed"].to_numpy(float) for side, part in sides.items()}
    grams = {
        side: np.divide(part["emission_g"], crossed[side], out=np.zeros(len(part)), where=crossed[side] > 0)
        for side, part in sides.items()
    }
    both = (crossed["policy"] > 0) & (crossed["baseline"] > 0)
    episodes, defined = keys.size().to_numpy(), added(both.astype(float))
    for side in sides:
        rows[f"throughput_{side}"] = added(crossed[side]) / episodes
        # Where nobody crosses under the policy in any episode, the baseline's emission still counts.
        alone = (crossed[side] > 0) & (defined == 0)[number]
        shown = both | alone
        rows[f"emission_{side}_g"] = _ratio(added(grams[side] * shown), added(shown.astype(float)))
    flow = rows["throughput_baseline"].to_numpy()
    rows["throughput_benefit"] = _ratio(rows["throughput_policy"].to_numpy() - flow, flow)
    burned, other = (added(grams[side] * both) for side in sides)
    rows["benefit_ungated"] = np.where(other > 0, 1.0 - _ratio(burned, other), 0.0)
    traffic = sums(own, "entered") + sums(human, "entered") + sums(human, "waiting")
    rows["left_out"] = np.where(traffic == 0, "no traffic", np.where(flow == 0, "nobody crossed", ""))
    rows = rows.reset_index()
    counts = rows["left_out"] == ""
    rows["fell"] = counts & (rows["throughput_policy"] < rows["throughput_baseline"])
    anywhere = rows["fell"].groupby([rows[key] for key in CONTEXT]).transform("any")
    rows["gated"] = rows["fell"].where(rows["demand"] == "one", anywhere) & counts
    rows["benefit"] = rows["benefit_ungated"].mask(rows["gated"], 0.0).mask(~counts)
    return rows, paper_aggregates(rows)


def paper_aggregates(rows: pd.DataFrame) -> dict[str, Any]:
    """Sum up approaches as the paper does; plain values, ready for JSON.

    Args:
        rows: as :func:`paper_form` returns them, of one or several training seeds.

    Returns:
        ``train_seeds``; ``closed_by``: of intersections with demand from all approaches, which approaches closed the
        gate for all of them, in words; means over training seeds of ``ratio_of_sums`` (``1 - sum of the policy's g per
        vehicle / sum of the baseline's``, the baseline's own where the gate is closed), ``mean``, ``share_gated``,
        ``throughput_mean`` (relative change) and ``share_kept`` (approaches whose throughput did not fall); and
        ``best_ratio_of_sums``: of the best training seed, chosen on the test set, which is the paper's way.
    """
    about = {
        "train_seeds": int(rows["train_seed"].nunique()),
        "closed_by": _closed_by(rows[rows["fell"] & (rows["demand"] == "all")]),
    }
    counted = rows[rows["left_out"] == ""]
    if counted.empty:
        return {**about, **dict.fromkeys((*_aggregates(counted), "best_ratio_of_sums"))}
    seeds = pd.DataFrame([_aggregates(part) for _, part in counted.groupby("train_seed")])
    return {**about, **seeds.mean().to_dict(), "best_ratio_of_sums": float(seeds["ratio_of_sums"].max())}


def _closed_by(fell: pd.DataFrame) -> list[str]:
    """Name the approaches on which the throughput fell, by intersection."""
    named: dict[str, list[str]] = {}
    for row in fell.itertuples():
        seed = f", training seed {row.train_seed}" if fell["train_seed"].nunique() > 1 else ""
        words = f"{row.approach} ({row.throughput_policy:.1f} vehicles, not {row.throughput_baseline:.1f}{seed})"
        named.setdefault(str(row.context), []).append(words)
    return [f"{context}: {', '.join(words)}" for context, words in named.items()]


def _aggregates(rows: pd.DataFrame) -> dict[str, float]:
    """Aggregates of one training seed."""
    baseline = rows["emission_baseline_g"]
    own = rows["emission_policy_g"].mask(rows["gated"].astype(bool)).fillna(baseline)
    return {
        "ratio_of_sums": float(1.0 - own.sum() / baseline.sum()) if baseline.sum() > 0 else 0.0,
        "mean": float(rows["benefit"].mean()),
        "share_gated": float(rows["gated"].mean()),
        "throughput_mean": float(rows["throughput_benefit"].mean()),
        "share_kept": float((rows["throughput_policy"] >= rows["throughput_baseline"]).mean()),
    }


def _ratio(top: Array, bottom: Array) -> Array:
    """NaN over nothing."""
    return np.divide(top, bottom, out=np.full(len(bottom), np.nan), where=bottom > 0)
