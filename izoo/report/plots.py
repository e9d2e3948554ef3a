"""Charts of summaries, and any :class:`~izoo.training.plots.Chart`, which is drawn as PNG there, as SVG for a page."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import ArrayLike

from izoo.metrics.cell import Cell
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import BASELINES, UNCOMMANDED
from izoo.metrics.statistics import performance_profile
from izoo.report.tables import SAVED, Table, compared, ranking
from izoo.training.plots import PALETTE, QUIET, Chart, Series, draw

DELAY = "delay_change_s"
BINS, LIMIT_PCT = 150, 100.0
"""The published histogram: values clipped to +-100 %, 150 bins."""
THRESHOLDS_PCT = np.arange(-100.0, 100.5, 0.5)
FAR = 10.0
"""An interval this many times as wide as the median one runs off a chart of intervals."""
UNTRAINED = "_untrained"
"""Ends the name of an entry that is played as its training begins."""
SVG_STYLE: Any = {
    **{"svg.fonttype": "none", "svg.hashsalt": "izoo", "legend.frameon": False},
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color", "grid.color"), QUIET),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), "black"),
}
"""The same results give the same file; what is black has the colour of the page's text."""


def colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour per policy: weights before training have that of the trained ones, baselines are grey."""
    families = dict.fromkeys(name.removesuffix(UNTRAINED) for name in names if name not in BASELINES)
    tint = {family: PALETTE[k % len(PALETTE)] for k, family in enumerate(families)}
    return {name: tint.get(name.removesuffix(UNTRAINED), QUIET) for name in names}


def forest(table: Table, name: str = "forest", column: int = 0) -> Chart:
    """Return a column of a table with its intervals, a row per entry; its label names the group.

    An interval :data:`FAR` times as wide as the median one runs off the chart: else it would hide what the others say.
    """
    cells = [
        (f"{row.label}, {group}" if group else row.label, row.cells[column])
        for group, rows in table.groups
        for row in rows
    ]
    known = [(label, cell) for label, cell in cells if isinstance(cell, Cell) and cell.value is not None]
    marks = Series(
        np.array([cell.value for _, cell in known], float),
        list(range(len(known))),
        kind="points",
        low=[cell.low for _, cell in known],
        high=[cell.high for _, cell in known],
    )
    unit = next((f" ({cell.unit})" for _, cell in known if cell.unit), "")
    heading, rows = table.columns[column + 1], [label for label, _ in known]
    alt = f"{heading}: {'; '.join(f'{label} {cell}' for label, cell in known)}."
    return Chart(name, table.title, [marks], heading + unit, rows=rows, zero=True, alt=alt, x_range=_reach(marks))


def _reach(marks: Series) -> tuple[float, float] | None:
    """Return the range of a chart that some intervals run out of; ``None``: all are shown whole."""
    values, low, high = (np.array(ends, float) for ends in (marks.x, marks.low, marks.high))
    widths = high - low
    usual = np.median(widths[np.isfinite(widths)]) if np.isfinite(widths).any() else 0.0
    shown = ~(widths > FAR * usual)
    if usual == 0.0 or shown.all():
        return None
    ends = np.concatenate([values, low[shown], high[shown], [0.0]])
    least, most = np.nanmin(ends), np.nanmax(ends)
    return least - 0.05 * (most - least), most + 0.05 * (most - least)


def tradeoff(summary: Mapping[str, Any]) -> Chart | None:
    """Return CO2 saved against the change of delay, both over uncommanded; ``None`` with a single entry."""
    block, series = summary["block"], []
    tint = colours(ranking(summary))
    for name in compared(summary):
        found = summary["entries"][name]["against"].get(UNCOMMANDED, {}).get(block, {}).get("figures", {})
        x, y = (found.get(key) for key in (DELAY, SAVED))
        if x and y and None not in (x["value"], y["value"]):
            ends = [y["low"]], [y["high"]]
            series.append(Series([x["value"]], [y["value"]], name, "points", *ends, colour=tint[name], text=[name]))
    if len(series) < 2:
        return None
    labels = [figure_label(key) for key in (DELAY, SAVED)]
    points = "; ".join(f"{s.name} {np.ravel(s.y)[0]:.1f} at {np.ravel(s.x)[0]:+.1f}" for s in series)
    caption = "Upwards: less CO2. To the left: less delay."
    alt = f"{labels[1]} against {labels[0]}: {points}."
    return Chart("tradeoff", "CO2 and delay", series, labels[0], labels[1], caption, alt)


def profiles(values: Mapping[str, ArrayLike]) -> Chart:
    """Return performance profiles: the share of contexts above each value of CO2 saved.

    Args:
        values: ``[S, N]`` or ``[N]`` per policy, in per cent.
    """
    series, tint, reach = [], colours(list(values)), 5.0
    for name, found in values.items():
        x = np.asarray(found, float).ravel()
        if x.size:
            share = 100.0 * performance_profile(x, THRESHOLDS_PCT)
            between = np.abs(THRESHOLDS_PCT[(share > 0.0) & (share < 100.0)])
            reach = max(reach, *between) if between.size else reach
            quiet = name in BASELINES or name.endswith(UNTRAINED)
            series.append(Series(THRESHOLDS_PCT, share, name, "step", colour=tint[name], dash=":" if quiet else "-"))
    caption = "Higher is better: a curve above another everywhere is better everywhere. Curves have no intervals."
    label, alt = figure_label(SAVED), "Share of contexts above each value, a line per policy."
    range_ = (-min(1.1 * reach, 100.0), min(1.1 * reach, 100.0))
    axes = (label, "contexts above it (%)")
    return Chart("profiles", "Performance profiles", series, *axes, caption, alt, x_range=range_, zero=True)


def histogram(values: ArrayLike, title: str, name: str, colour: str) -> Chart:
    """Return how many contexts have which value of CO2 saved.

    Args:
        values: any shape, in per cent.
        title, name: of the chart.
        colour: of the bars.
    """
    x = np.asarray(values, float).ravel()
    counts, edges = np.histogram(np.clip(x, -LIMIT_PCT, LIMIT_PCT), BINS, (-LIMIT_PCT, LIMIT_PCT))
    bars = Series(0.5 * (edges[:-1] + edges[1:]), counts, kind="bars", colour=colour)
    alt = f"Histogram of {x.size} values, {title}" + (f", median {np.median(x):.1f} %." if x.size else ".")
    axes, reach = (figure_label(SAVED), "contexts"), (-LIMIT_PCT, LIMIT_PCT)
    return Chart(name, f"{title} (n = {x.size})", [bars], *axes, alt=alt, x_range=reach, zero=True)


def svg(chart: Chart) -> str:
    """Return a chart without its title as SVG that stands in a page: its text has the page's colour."""
    text, plain = io.StringIO(), dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context(SVG_STYLE):
        draw([dataclasses.replace(chart, title="")]).savefig(text, format="svg", transparent=True, metadata=plain)
    return text.getvalue()[text.getvalue().index("<svg") :]


def figure_label(figure: str) -> str:
    """What an axis of a figure over uncommanded says."""
    return f"{FIGURES[figure].label}, over {UNCOMMANDED} ({FIGURES[figure].unit})"
