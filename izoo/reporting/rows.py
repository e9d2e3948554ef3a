"""The per-approach table of a report, column by column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from izoo.evaluation.aggregates import TASK
from izoo.reporting.scored import Scored

FEATURES = {
    "volume_over_capacity": "volume over capacity",
    "green_share": "green share of the cycle",
    "cycle_s": "cycle (s)",
    "lane_length_m": "approach length (m)",
    "speed_limit_mps": "speed limit (m/s)",
    "lane_count": "lanes",
    "flow_vph_per_lane": "inflow (veh/h per lane)",
    "grade": "road grade (rise over run)",
    "adoption": "adoption (share of CVs)",
}
"""Features of approaches that the benefit is drawn against; those that do not vary are left out by the page."""


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        key: in the rows.
        label: in the header.
        digits: after the point; ``None`` for text.
        scale: what numbers are multiplied by to be shown.
        meaning: on the header, for those who ask.
    """

    key: str
    label: str
    digits: int | None = None
    scale: float = 1.0
    meaning: str = ""


COLUMNS = (
    Column("context", "context"),
    Column("approach", "leg", meaning="the approach's leg"),
    Column("policy", "policy"),
    Column("benefit_exact", "benefit (%)", 2, 100.0, "exact gate: 0 where the mean throughput falls"),
    Column("benefit_region_exact", "region (%)", 2, 100.0, "the same for CO2 in the whole region, exits included"),
    Column("benefit_demand_exact", "demand (%)", 2, 100.0, "the same with those who have not crossed or come yet"),
    Column("benefit_tested", "tested gate (%)", 2, 100.0, "0 where a t-test cannot show that under 2 % was lost"),
    Column("benefit_ungated", "no gate (%)", 2, 100.0),
    Column("low", "low (%)", 2, 100.0, "95 % over episode seeds, no gate; of several training seeds, the lowest"),
    Column("high", "high (%)", 2, 100.0, "95 % over episode seeds, no gate; of several training seeds, the highest"),
    Column("throughput_benefit", "throughput (%)", 2, 100.0, "change of the vehicles that crossed"),
    Column("emission_policy_g", "g per vehicle", 1, meaning="CO2 per vehicle over its approach"),
    Column("emission_baseline_g", "baseline g", 1, meaning="the same of the baseline"),
    Column("throughput_policy", "crossed", 1, meaning="vehicles per episode that crossed the stop line"),
    Column("throughput_baseline", "baseline crossed", 1),
    Column("served_policy", "served (%)", 1, 100.0, "share of the demand that crossed"),
    Column("served_baseline", "baseline served (%)", 1, 100.0),
    Column("kept_out_policy", "kept out (%)", 1, 100.0, "share of the demand that has not come to the region"),
    Column("kept_out_baseline", "baseline kept out (%)", 1, 100.0),
    Column("unfinished_policy", "unfinished", 1, meaning="vehicles per episode that had not crossed at the end"),
    Column("unfinished_baseline", "baseline unfinished", 1),
    Column("collisions_policy", "collisions", 2, meaning="per episode"),
    Column("collisions_baseline", "baseline collisions", 2),
    Column("saturated", "saturated"),
    Column("seeds", "seeds", 0, meaning="paired episodes per training seed"),
    Column("runs", "runs", 0, meaning="training seeds"),
    Column("left_out", "left out", meaning="why the approach does not count"),
)
_MEANS = tuple(c.key for c in COLUMNS if c.digits is not None and c.key not in {"low", "high", "seeds", "runs"})


def approach_rows(scored: Sequence[Scored]) -> dict[str, list[Any]]:
    """Return the table as columns: those of :data:`COLUMNS`, :data:`FEATURES`, and ``gated``.

    Of several training seeds the numbers are means, and an approach is gated where it is in more than half of them.
    """
    parts = [_rows(s) for s in scored]
    if not parts:
        return {name: [] for name in (*(c.key for c in COLUMNS), *FEATURES, "gated")}
    table = pd.concat(parts, ignore_index=True)
    rounded = {name: table[name].map(_short).tolist() for name in (*_MEANS, *FEATURES, "low", "high")}
    texts = {name: table[name].astype(str).tolist() for name in ("policy", "context", "approach", "left_out")}
    saturated = ["yes" if flag else "" for flag in table["saturated"]]
    flags = {"saturated": saturated, "gated": (table["gated_exact"] > 0.5).tolist()}
    return {**texts, **rounded, **flags, "seeds": table["seeds"].tolist(), "runs": table["runs"].tolist()}


def _rows(scored: Scored) -> pd.DataFrame:
    entry, count = scored.entry, len(scored.tables)
    first = scored.tables[0]
    pooled = pd.concat(scored.tables).groupby(TASK, sort=False)
    means = pooled[[*_MEANS, "gated_exact"]].mean()
    if count > 1:
        means["low"], means["high"] = pooled["benefit_ungated"].min(), pooled["benefit_ungated"].max()
    else:
        means[["low", "high"]] = first.set_index(TASK)[["low", "high"]]
    own = entry.runs[0].table
    own = own[own["policy"] == entry.policy].drop_duplicates(TASK).set_index(TASK)
    texts = first.set_index(TASK)[["context", "saturated", "left_out", "seeds"]]
    table = means.join(texts).join(own[list(FEATURES)]).reset_index()
    table.loc[table["left_out"] != "", ["benefit_ungated", "low", "high"]] = np.nan
    return table.assign(policy=scored.name, runs=count)


def _short(value: Any) -> float | None:
    """Six digits are more than is shown, and keep the page small."""
    return float(f"{value:.6g}") if np.isfinite(value) else None
