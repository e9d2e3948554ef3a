"""Benefit against human driving, paired and gated.

A row of a table is one approach in one episode: the keys :data:`PAIR`, the sums of
:mod:`izoo.metrics.definitions`, and what describes the context. Policy and baseline rows are paired by context, seed
and approach: same demand, same drivers, same arrival times. Only then does a policy that changes nothing keep its
throughput for certain; unpaired, it would fall below the baseline's about half the time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS, DEMAND, KEPT_OUT
from izoo.metrics.scores import require_columns
from izoo.metrics.student import student_t_below

PAIR = ("context_hash", "seed", "approach")
"""What a policy row and its baseline row agree on."""
DESCRIPTION = ("context", "intersection", "city", "demand", "engine", "adoption", "volume_over_capacity")
"""Columns of the context that are carried along."""
GATES = ("exact", "tested")
SIGNIFICANCE = 0.05
MARGIN = 0.02
"""Share of the baseline's throughput below which a fall does not count for the tested gate. About what the horizon does
by itself: whether the last two vehicles of a hundred cross just before it or just after."""
FORMS = ("", "region_", "demand_")
"""Benefits come by approach (the paper's form: CO2 up to the stop line, of the vehicles that crossed it), by region
(CO2 of the whole controlled region, exits included, per vehicle that entered) and by demand (CO2 up to the stop line of
all who came to cross it: also of those who have not crossed, and of those who are held up outside of the region, as if
they stood there; per vehicle that crossed). All have the same gates. What upstream signals take is in the last form on
both sides, so its figures are closer to 0. Episodes in which nobody crosses have no CO2 per vehicle in the first form,
and are left out of it; in the last a policy pays for them as if one vehicle had crossed, so that a blocked road shows.
"""
BURNED = {
    "": ("emission_g",),
    "region_": ("region_emission_g",),
    "demand_": ("emission_g", "unfinished_emission_g", "held_up_emission_g"),
}
"""Columns whose sum is the CO2 of a form."""
_VEHICLES = {"": "crossed", "region_": "entered", "demand_": "crossed"}


def not_inferior_p_value(difference: Sequence[float] | NDArray[np.float64], margin: float) -> float:
    """One-sided paired t-test: the p-value of "the mean difference (policy - baseline) is ``-margin`` or lower".

    Small values show that at most ``margin`` was lost. Without variance there is nothing to estimate, and the mean
    decides; so it does for a single seed.

    Args:
        difference: ``[S]``, one per seed.
        margin: in the same unit, 0 or more.
    """
    d = np.asarray(difference, dtype=np.float64)
    centre, spread = float(d.mean()), float(d.std(ddof=1)) if d.size > 1 else 0.0
    if spread == 0.0:
        return 0.0 if centre >= -margin else 1.0
    return 1.0 - student_t_below((centre + margin) / (spread / math.sqrt(d.size)), d.size - 1)


def pair(policy: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Join policy rows with their baseline rows on :data:`PAIR`; columns get ``_policy`` and ``_baseline``.

    Raises:
        IzooError: where a policy row has no baseline row, or keys repeat.
    """
    for table in (policy, baseline):
        require_columns(table, (*PAIR, *DESCRIPTION, *APPROACH_METRICS))
        if table.duplicated(list(PAIR)).any():
            raise IzooError("an evaluation table holds a (context, seed, approach) twice; give one policy at a time.")
    left = policy[[*PAIR, *DESCRIPTION, *APPROACH_METRICS]]
    right = baseline[[*PAIR, *APPROACH_METRICS]]
    joined = left.merge(right, on=list(PAIR), how="left", suffixes=("_policy", "_baseline"), indicator="found")
    lost = joined[joined["found"] != "both"]
    if len(lost):
        first = lost.iloc[0]
        raise IzooError(
            f"{len(lost)} row(s) have no baseline, the first: context {first['context']}, seed {first['seed']}; "
            "evaluate the baseline on the same contexts and seeds."
        )
    return joined.drop(columns="found")


def benefits(policy: pd.DataFrame, baseline: pd.DataFrame, significance: float = SIGNIFICANCE) -> pd.DataFrame:
    """Compare a policy with its baseline, approach by approach.

    Args:
        policy, baseline: rows of one policy each; see the module's docstring.
        significance: of the tested gate.

    Returns:
        One row per (context, approach): ``seeds`` (pairs), ``emission_policy_g``, ``emission_baseline_g`` (g per
        vehicle that crossed, means over the seeds in which both are defined), ``region_emission_*_g`` (g in the whole
        region per vehicle that entered), ``demand_emission_*_g`` (g of the whole demand, up to the stop line, per
        vehicle that crossed), ``throughput_*`` (vehicles, means over all seeds), ``throughput_benefit``,
        ``throughput_p`` (of a fall by :data:`MARGIN` or more), ``benefit_ungated``, and per gate ``gated_*`` and
        ``benefit_*``; the same benefits by region and by demand, ``benefit_region_*`` and ``benefit_demand_*``;
        ``served_*`` (share of the demand that crossed), ``kept_out_*`` (share of it that has not come to the region),
        ``waiting_*``, ``unfinished_*``, ``collisions_*`` (means over seeds), ``saturated``, and ``left_out``: why the
        row has no benefit (no traffic; the baseline let nobody cross), or the empty string.
        The exact gate is closed where the mean throughput falls; the tested gate where it is not shown, at the
        significance, that less than :data:`MARGIN` of it was lost.
        A gated benefit is NaN in left-out rows only; where nothing crossed under the policy it is 0. So is the ungated
        one by approach, which says nothing then; by demand such a policy is charged (:data:`FORMS`).

    Raises:
        IzooError: there are no rows, or as :func:`pair` says.
    """
    if policy.empty:
        raise IzooError("there are no rows to compare; evaluate a policy, and human driving beside it.")
    joined = pair(policy, baseline)
    rows = [
        {**dict(zip(("context_hash", "approach"), key, strict=True)), **_compare(group)}
        for key, group in joined.groupby(["context_hash", "approach"], sort=False)
    ]
    table = pd.DataFrame(rows)
    counts = table["left_out"] == ""
    falls = {
        "exact": counts & (table["throughput_policy"] < table["throughput_baseline"]),
        "tested": counts & (table["throughput_p"] >= significance),
    }
    for gate, fell in falls.items():
        # With demand from all approaches a fall on one of them zeroes the whole intersection.
        anywhere = fell.groupby(table["context_hash"]).transform("any")
        gated = fell.where(table["demand"] == "one", anywhere) & counts
        table[f"gated_{gate}"] = gated
        for form in FORMS:
            table[f"benefit_{form}{gate}"] = table[f"benefit_{form}ungated"].mask(gated, 0.0).mask(~counts)
    return table


def _compare(group: pd.DataFrame) -> dict[str, object]:
    """Numbers of one (context, approach) over its seeds; ``group`` is a part of :func:`pair`'s result."""
    result: dict[str, object] = {column: group[column].iloc[0] for column in DESCRIPTION}
    for side in ("policy", "baseline"):
        result[f"throughput_{side}"] = float(group[f"crossed_{side}"].mean())
        for column in ("waiting", "unfinished"):
            result[f"{column}_{side}"] = float(group[f"{column}_{side}"].mean())
        collisions = group[f"collisions_cv_{side}"] + group[f"collisions_hdv_{side}"]
        result[f"collisions_{side}"] = float(collisions.mean())
        demand = float(sum(group[f"{name}_{side}"].sum() for name in DEMAND))
        kept_out = float(sum(group[f"{name}_{side}"].sum() for name in KEPT_OUT))
        result[f"served_{side}"] = float(group[f"crossed_{side}"].sum()) / demand if demand else math.nan
        result[f"kept_out_{side}"] = kept_out / demand if demand else math.nan
    arrivals = group[["entered_policy", "entered_baseline", "waiting_baseline"]].to_numpy(float)
    crossed_baseline = float(group["crossed_baseline"].sum())
    change = (group["crossed_policy"] - group["crossed_baseline"]).to_numpy(float)
    result["left_out"] = "no traffic" if not arrivals.any() else "" if crossed_baseline else "nobody crossed"
    result["seeds"] = len(group)
    result["throughput_p"] = not_inferior_p_value(change, MARGIN * float(group["crossed_baseline"].mean()))
    result["throughput_benefit"] = float(change.sum()) / crossed_baseline if crossed_baseline else math.nan
    for form in FORMS:
        result |= _saving(group, form)
    result["saturated"] = bool(group["waiting_baseline"].sum() > 0) or bool(result["volume_over_capacity"] > 1.0)  # type: ignore[operator]
    return result


def _saving(group: pd.DataFrame, form: str) -> dict[str, float]:
    """Emission per vehicle of both sides and the benefit, in one of :data:`FORMS`, over the seeds where both exist."""
    emission = {}
    for side in ("policy", "baseline"):
        count = group[f"{_VEHICLES[form]}_{side}"].to_numpy(float)
        burned_g = group[[f"{part}_{side}" for part in BURNED[form]]].to_numpy(float).sum(axis=1)
        if form == "demand_" and side == "policy":
            count = np.where(burned_g > 0.0, np.maximum(count, 1.0), count)
        emission[side] = burned_g / np.where(count > 0, count, np.nan)
    both = ~np.isnan(emission["policy"]) & ~np.isnan(emission["baseline"])
    result: dict[str, float] = {}
    for side, values in emission.items():
        # Where the policy lets nobody cross in any seed there are no pairs, but the baseline's emission still counts.
        shown = both if both.any() else ~np.isnan(values)
        result[f"{form}emission_{side}_g"] = float(values[shown].mean()) if shown.any() else math.nan
    policy_g, baseline_g = float(emission["policy"][both].sum()), float(emission["baseline"][both].sum())
    result[f"benefit_{form}ungated"] = 1.0 - policy_g / baseline_g if baseline_g > 0.0 else 0.0
    result[f"{form}emission_seeds"] = int(both.sum())
    return result


def emission_pairs(table: pd.DataFrame, gate: str, form: str = "") -> NDArray[np.float64]:
    """``[N, 2]``: g per vehicle under the policy and the baseline, the baseline's own where the approach is gated.

    A row in which the policy let nobody cross in any seed counts as gated: it has no emission to show.

    Args:
        form: one of :data:`FORMS`.
    """
    policy, baseline = (table[f"{form}emission_{side}_g"] for side in ("policy", "baseline"))
    kept = ~table[f"gated_{gate}"].to_numpy(bool) & policy.notna().to_numpy()
    own = baseline.fillna(0.0).to_numpy(float)
    return np.stack([np.where(kept, policy.to_numpy(float), own), own], axis=1)


def ratio_of_sums(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """``1 - sum(policy) / sum(baseline)``, ``[*R, N, 2] -> [*R]``: as the published figures are; 0 over nothing."""
    sums = pairs.sum(axis=-2)
    policy, baseline = sums[..., 0], sums[..., 1]
    known = baseline > 0.0
    return np.where(known, 1.0 - policy / np.where(known, baseline, 1.0), 0.0)
