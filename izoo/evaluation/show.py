"""A summary as tables to read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from izoo.console import counted, plain
from izoo.envs.config import SIMULATOR_NAMES
from izoo.evaluation.policies import HUMAN
from izoo.metrics.scores import SCORES
from izoo.metrics.statistics import MIN_EVAL_SEEDS, MIN_INTERSECTIONS, MIN_TRAIN_SEEDS

SHOWN_SCORES = (
    "emission_g_per_vehicle",
    "throughput",
    "travel_time_s_per_vehicle",
    "approach_speed_mps",
    "stopped_time_s_per_vehicle",
    "region_emission_g_per_vehicle",
    "demand_emission_g_per_vehicle",
    "served_share",
    "unfinished_share",
    "waiting_vehicles",
    "dropped_vehicles",
    "min_ttc_s",
    "collisions",
    "deferred_share",
)
LINES = (
    ("benefit, mean", "exact", "mean"),
    ("benefit, interquartile mean", "exact", "iqm"),
    ("benefit, ratio of sums", "exact", "ratio_of_sums"),
    ("approaches with benefit", "exact", "share_positive"),
    ("approaches gated to 0", "exact", "share_gated"),
    ("whole region: benefit, mean", "region_exact", "mean"),
    ("whole region: interquartile mean", "region_exact", "iqm"),
    ("whole demand: benefit, mean", "demand_exact", "mean"),
    ("tested gate: benefit, mean", "tested", "mean"),
    ("tested gate: gated to 0", "tested", "share_gated"),
    ("no gate: benefit, mean", "ungated", "mean"),
    ("no gate: over uncommanded CVs", "over_uncommanded", "mean"),
    ("no gate: the same, whole region", "region_over_uncommanded", "mean"),
    ("no gate: the same, whole demand", "demand_over_uncommanded", "mean"),
    ("throughput, mean change", "throughput", "mean"),
    ("approaches that kept it", "throughput", "share_kept"),
    ("demand served, mean", "served", "policy"),
    ("the same under the baseline", "served", "baseline"),
    ("demand kept out, mean", "kept_out", "policy"),
    ("the same under the baseline", "kept_out", "baseline"),
)
"""Lines of a comparison: label, block and statistic."""


def print_summary(summary: dict[str, Any], console: Console | None = None) -> None:
    """Print what :func:`izoo.evaluation.summarise` returned: scores per policy, then each comparison."""
    console = console or Console()
    n = summary["n"]
    console.print(score_table(summary))
    for name, policy in summary["policies"].items():
        for baseline, comparison in policy["against"].items():
            main, share = baseline == policy["headline"], summary["scores"][name]["nan_share"]
            played = summary["simulator"]
            console.print(benefit_table(name, baseline, comparison, main=main, nan_share=share, simulator=played))
            for what, entries in (("saturated", comparison["saturated"]), ("left out", comparison["left_out"])):
                if entries:
                    more = ", ..." if len(entries) > 3 else ""
                    listed = plain(f"{len(entries)} ({', '.join(entries[:3])}{more})")
                    console.print(f"  {what}: {listed}", highlight=False, markup=False)
    for name, scores in summary["scores"].items():
        if scores["nan_share"]:
            console.print(nan_in_words(plain(name), scores["nan_share"]), highlight=False, markup=False)
    console.print(
        f"{places_in_words(n)}, {n['seeds']} paired seeds, {n['episodes']} episodes.{counted_in_words(summary)}",
        highlight=False,
    )
    if n["seeds"] < MIN_EVAL_SEEDS:
        console.print(f"Only {counted(n['seeds'], 'seed')} per context: three or more are needed to judge throughput.")


def score_table(summary: dict[str, Any]) -> Table:
    """Scores side by side."""
    played = SIMULATOR_NAMES[summary["simulator"]]
    return _rich(f"Scores on {played} (all vehicles that crossed)", *score_rows(summary))


def benefit_table(
    name: str,
    baseline: str,
    comparison: dict[str, Any],
    main: bool,
    nan_share: float | None = None,
    simulator: str = "sumo",
) -> Table:
    """One policy against one baseline; what SUMO drove because the commands were NaN is not the policy's benefit."""
    mark = " (headline)" if main else ""
    if nan_share:
        mark += f"; {100.0 * nan_share:.3g} % of the commands NaN, driven by SUMO"
    return _rich(f"{name} against {baseline} on {SIMULATOR_NAMES[simulator]}{mark}", *comparison_rows(comparison))


def counted_in_words(summary: dict[str, Any]) -> str:
    """Return what the brackets of a summary's tables mean, after a space; nothing where there are no policies."""
    counts = [policy["intersections"] for policy in summary["policies"].values()]
    if not counts:
        return ""
    left_out = min(counts) < summary["n"]["intersections"]
    some = f" {counted(min(counts), 'intersection')} with a figure." if left_out else ""
    return f"{some} {intervals_in_words(counts)}"


def places_in_words(n: dict[str, int]) -> str:
    """Return on how many contexts and intersections an evaluation rests; ``n`` is that of its summary."""
    return f"{counted(n['contexts'], 'context')} on {counted(n['intersections'], 'intersection')}"


def nan_in_words(name: str, share: float) -> str:
    """What is said of a policy some of whose commands were NaN: its figures are in part those of SUMO's driver."""
    return f"{name}: {100.0 * share:.3g} % of its commands were NaN; SUMO drove those vehicles."


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
        [label, *(percent(comparison[name][part][statistic]) for name in blocks)]
        for label, part, statistic in LINES
        if part in comparison["all"]
    ]
    lines.append(["approaches (n)", *(str(comparison[name]["exact"]["mean"]["n"]) for name in blocks)])
    return ["", *blocks.values()], lines


def _rich(title: str, header: list[str], lines: list[list[str]]) -> Table:
    table = Table(title=Text(plain(title)), title_justify="left")
    for column, word in enumerate(header):
        table.add_column(Text(plain(word)), justify="right" if column else "left")
    for line in lines:
        table.add_row(*(Text(plain(cell)) for cell in line))
    return table


def percent(estimate: dict[str, Any]) -> str:
    """An estimate as per cent, with its interval where it has one."""
    if estimate["value"] is None:
        return "-"
    value = f"{rounded_percent(estimate['value']):.1f} %"
    if estimate["low"] is None:
        return value
    return f"{value} [{rounded_percent(estimate['low']):.1f}, {rounded_percent(estimate['high']):.1f}]"


def stacked(estimate: dict[str, Any] | None) -> str:
    """An estimate as per cent with its interval below it, for narrow columns."""
    return "-" if estimate is None else percent(estimate).replace(" [", "\n[")


def figure_table(title: str, rows: str, columns: Sequence[str]) -> Table:
    """Return an empty table of :func:`stacked` figures, of which only the names of the rows may be broken."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(rows, overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def rounded_percent(share: float) -> float:
    """Return a share in per cent, to one decimal."""
    return round(100.0 * share, 1) + 0.0  # no "-0.0"


def intervals_in_words(intersections: Sequence[int], trained_seeds: Sequence[int] = ()) -> str:
    """Return what the brackets of a table mean, and where there are none.

    Args:
        intersections: of each entry of the table.
        trained_seeds: training seeds of each entry that was trained.
    """
    words = []
    if max(intersections, default=0) >= MIN_INTERSECTIONS:
        words.append("Brackets: 95 % intervals over other intersections")
        if max(trained_seeds, default=0) >= MIN_TRAIN_SEEDS:
            words[-1] += ", and other training seeds where there are any"
        words[-1] += "; none where the figure is the same without any intersection"
    if min(intersections, default=0) < MIN_INTERSECTIONS:
        words.append(f"No intervals with fewer than {MIN_INTERSECTIONS} intersections")
    if min(trained_seeds, default=MIN_TRAIN_SEEDS) < MIN_TRAIN_SEEDS:
        words.append(
            f"Of entries with fewer than {MIN_TRAIN_SEEDS} training seeds the figures are those of these very weights: "
            "no interval says what other seeds would give"
        )
    return ". ".join(words) + "."
