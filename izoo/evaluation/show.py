"""A summary as tables to read."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from izoo.evaluation.policies import HUMAN
from izoo.metrics.scores import SCORES

SHOWN_SCORES = (
    "emission_g_per_vehicle",
    "throughput",
    "travel_time_s_per_vehicle",
    "approach_speed_mps",
    "stopped_time_s_per_vehicle",
    "unfinished_share",
    "waiting_vehicles",
    "dropped_vehicles",
    "min_ttc_s",
    "collisions",
    "deferred_share",
)
_LINES = (
    ("benefit, mean", "exact", "mean"),
    ("benefit, interquartile mean", "exact", "iqm"),
    ("benefit, ratio of sums", "exact", "ratio_of_sums"),
    ("approaches with benefit", "exact", "share_positive"),
    ("approaches gated to 0", "exact", "share_gated"),
    ("tested gate: benefit, mean", "tested", "mean"),
    ("tested gate: gated to 0", "tested", "share_gated"),
    ("no gate: benefit, mean", "ungated", "mean"),
    ("throughput, mean change", "throughput", "mean"),
    ("approaches that kept it", "throughput", "share_kept"),
)
"""Lines of a comparison: label, block and statistic."""


def print_summary(summary: dict[str, Any], console: Console | None = None) -> None:
    """Print what :func:`izoo.evaluation.summarise` returned: scores per policy, then each comparison."""
    console = console or Console()
    n = summary["n"]
    console.print(score_table(summary))
    for name, policy in summary["policies"].items():
        for baseline, comparison in policy["against"].items():
            console.print(benefit_table(name, baseline, comparison, main=baseline == policy["headline"]))
            for what, entries in (("saturated", comparison["saturated"]), ("left out", comparison["left_out"])):
                if entries:
                    more = ", ..." if len(entries) > 3 else ""
                    console.print(f"  {what}: {len(entries)} ({', '.join(entries[:3])}{more})", highlight=False)
    for name, scores in summary["scores"].items():
        if scores["nan_share"]:
            share = f"{100.0 * scores['nan_share']:.3g} %"
            console.print(f"{name}: {share} of its commands were NaN; SUMO drove those vehicles.", highlight=False)
    console.print(
        f"{n['contexts']} contexts on {n['intersections']} intersections, {n['seeds']} paired seeds, "
        f"{n['episodes']} episodes; brackets: 95 % bootstrap intervals over intersections.",
        highlight=False,
    )
    if n["seeds"] < 3:
        console.print(f"Only {n['seeds']} seed(s) per context: three or more are needed to judge throughput.")


def score_table(summary: dict[str, Any]) -> Table:
    """Scores side by side."""
    return _rich("Scores (all vehicles that crossed)", *score_rows(summary))


def benefit_table(name: str, baseline: str, comparison: dict[str, Any], main: bool) -> Table:
    """One policy against one baseline."""
    mark = " (headline)" if main else ""
    return _rich(f"{name} against {baseline}{mark}", *comparison_rows(comparison))


def score_rows(summary: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of the scores, human driving first; counts are means per episode and approach."""
    scores = summary["scores"]
    names = sorted(scores, key=lambda name: name != HUMAN)
    lines = []
    for key in SHOWN_SCORES:
        unit = f" ({SCORES[key].unit})" if SCORES[key].unit else ""
        values = [scores[name][key] for name in names]
        lines.append([SCORES[key].label + unit, *("-" if value is None else f"{value:.4g}" for value in values)])
    return ["", *names], lines


def comparison_rows(comparison: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of a comparison, with and without saturated approaches."""
    blocks = {"all": "all"}
    if comparison["saturated"]:
        blocks["unsaturated"] = "without saturated"
    lines = [
        [label, *(percent(comparison[name][block][statistic]) for name in blocks)] for label, block, statistic in _LINES
    ]
    lines.append(["approaches (n)", *(str(comparison[name]["exact"]["mean"]["n"]) for name in blocks)])
    return ["", *blocks.values()], lines


def _rich(title: str, header: list[str], lines: list[list[str]]) -> Table:
    table = Table(title=title, title_justify="left")
    for column, word in enumerate(header):
        table.add_column(word, justify="right" if column else "left")
    for line in lines:
        table.add_row(*line)
    return table


def percent(estimate: dict[str, Any]) -> str:
    """An estimate as per cent with its interval."""
    if estimate["value"] is None:
        return "-"
    value, low, high = (round(100.0 * estimate[key], 1) + 0.0 for key in ("value", "low", "high"))  # no "-0.0"
    return f"{value:.1f} %" + (f" [{low:.1f}, {high:.1f}]" if estimate["groups"] > 1 else "")
