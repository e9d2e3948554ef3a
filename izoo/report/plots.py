"""Charts of summaries, and any :class:`~izoo.training.plots.Chart`, which is drawn as PNG there, for plotly.js."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import BASELINES, UNCOMMANDED
from izoo.metrics.statistics import performance_profile
from izoo.report.tables import SAVED, Cell, Table, compared
from izoo.training.plots import PALETTE, QUIET, Chart, Series

DELAY = "delay_change_s"
BINS, LIMIT_PCT = 150, 100.0
"""The published histogram: values clipped to +-100 %, 150 bins."""
THRESHOLDS_PCT = np.arange(-100.0, 100.5, 0.5)
UNTRAINED = "_untrained"
_DASH = {"line": "lines", "step": "lines", "points": "markers"}


def colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour per policy: weights before training have that of the trained ones, baselines are grey."""
    families = dict.fromkeys(name.removesuffix(UNTRAINED) for name in names if name not in BASELINES)
    tint = {family: PALETTE[k % len(PALETTE)] for k, family in enumerate(families)}
    return {name: tint.get(name.removesuffix(UNTRAINED), QUIET) for name in names}


def forest(table: Table, name: str = "forest", column: int = 0) -> Chart:
    """Return a column of a table with its intervals, a row per entry."""
    cells = [(row.label, row.cells[column]) for row in table.rows]
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
    return Chart(
        name, table.title, [marks], heading + unit, rows=rows, zero=True, alt=alt, height_px=120 + 36 * len(rows)
    )


def tradeoff(summary: Mapping[str, Any]) -> Chart | None:
    """Return CO2 saved against the change of delay, both over uncommanded; ``None`` with a single entry."""
    block, series = summary["block"], []
    tint = colours(list(summary["entries"]))
    for name in compared(summary):
        found = summary["entries"][name]["against"].get(UNCOMMANDED, {}).get(block, {}).get("figures", {})
        x, y = (found.get(key) for key in (DELAY, SAVED))
        if x and y and None not in (x["value"], y["value"]):
            ends = [y["low"]], [y["high"]]
            series.append(Series([x["value"]], [y["value"]], name, "points", *ends, colour=tint[name], text=[name]))
    if len(series) < 2:
        return None
    labels = [f"{FIGURES[key].label}, over {UNCOMMANDED} ({FIGURES[key].unit})" for key in (DELAY, SAVED)]
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
            series.append(Series(THRESHOLDS_PCT, share, name, "step", colour=tint[name], hollow=quiet))
    caption = "Higher is better: a curve above another everywhere is better everywhere. Curves have no intervals."
    label, alt = figure_label(SAVED), "Share of contexts above each value, a line per policy."
    range_ = (-min(1.1 * reach, 100.0), min(1.1 * reach, 100.0))
    return Chart(
        "profiles",
        "Performance profiles",
        series,
        label,
        "contexts above it (%)",
        caption,
        alt,
        x_range=range_,
        zero=True,
    )


def histogram(
    values: ArrayLike, title: str, name: str, label: str = "", colour: str = PALETTE[0], note: str = ""
) -> Chart:
    """Return how many contexts have which value; bars far above the others are cut and carry their count.

    Args:
        values: any shape, in per cent.
        title, name, note: of the chart; the note stands below.
        label: of the axis; empty: CO2 saved over uncommanded.
        colour: of the bars.
    """
    x = np.asarray(values, float).ravel()
    counts, edges = np.histogram(np.clip(x, -LIMIT_PCT, LIMIT_PCT), BINS, (-LIMIT_PCT, LIMIT_PCT))
    cut = cut_height(counts)
    words = [str(count) if count > cut else "" for count in counts]
    bars = Series(0.5 * (edges[:-1] + edges[1:]), np.minimum(counts, cut), kind="bars", colour=colour, text=words)
    alt = f"Histogram of {x.size} values, {title}" + (f", median {np.median(x):.1f} %." if x.size else ".")
    axis = label or figure_label(SAVED)
    return Chart(
        name,
        f"{title} (n = {x.size})",
        [bars],
        axis,
        "contexts",
        note,
        alt,
        (),
        (-LIMIT_PCT, LIMIT_PCT),
        cut,
        True,
        260,
    )


def cut_height(counts: np.ndarray) -> float:
    """Height at which bars are cut: that of the tallest, unless it is over three times the second tallest."""
    tallest = np.sort(counts)[::-1]
    return float(max(2 * tallest[1], 1) if tallest[0] > 3 * max(int(tallest[1]), 1) else max(tallest[0], 1))


def to_plotly(chart: Chart) -> dict[str, Any]:
    """Return a chart as data and layout of plotly.js; the page adds colours of its theme. Text in it is escaped."""
    listed: set[str] = set()
    data = []
    for series in chart.series:
        shown = series.listed and series.name not in listed
        listed |= {series.name} if shown else set()
        name = {"name": _escaped(series.name), "legendgroup": _escaped(series.name), "showlegend": shown}
        data.append({**name, **_trace(series, bool(chart.rows))})
    y_axis = _axis(chart.y_label)
    if chart.rows:
        count = len(chart.rows)
        ticks = {"tickvals": list(range(count)), "ticktext": [_escaped(row) for row in chart.rows]}
        y_axis |= {**ticks, "range": [count - 0.4, -0.6]}
    if chart.y_most:
        y_axis |= {"range": [0, 1.15 * chart.y_most], **({"dtick": 1} if chart.y_most <= 6 else {})}
    x_axis = _axis(chart.x_label) | {
        "zeroline": chart.zero,
        **({"range": list(chart.x_range)} if chart.x_range else {}),
    }
    layout: dict[str, Any] = {"xaxis": x_axis, "yaxis": y_axis, "showlegend": len(listed) > 1, "bargap": 0}
    return {"name": chart.name, "data": data, "layout": layout}


def _trace(series: Series, across: bool) -> dict[str, Any]:
    x, y = _short(series.x), _short(series.y)
    if series.kind == "band" and series.low is not None and series.high is not None:
        area = {"x": [*x, *x[::-1]], "y": [*_short(series.low), *_short(series.high)[::-1]], "fill": "toself"}
        quiet = {"fillcolor": series.colour, "line": {"width": 0}, "opacity": 0.18, "hoverinfo": "skip"}
        return {"type": "scatter", "mode": "lines", **area, **quiet}
    if series.kind == "bars":
        text = {"text": list(series.text or ()), "textposition": "outside", "cliponaxis": False}
        return {
            "type": "bar",
            "x": x,
            "y": y,
            **text,
            "marker": {"color": series.colour},
            "hovertemplate": "%{y} at %{x:.1f}<extra></extra>",
        }
    trace: dict[str, Any] = {"type": "scatter", "mode": _DASH[series.kind], "x": x, "y": y}
    trace["hovertemplate"] = f"{_escaped(series.name)}<br>%{{x:.4g}}: %{{y:.4g}}<extra></extra>"
    if series.low is not None and series.high is not None:
        middle = np.asarray(series.x if across else series.y, float)
        low, high = (np.asarray(end, float) for end in (series.low, series.high))
        bars = {"type": "data", "symmetric": False, "array": _short(high - middle), "arrayminus": _short(middle - low)}
        trace["error_x" if across else "error_y"] = {**bars, "thickness": 1.6, "width": 4}
    if series.kind == "points":
        trace["marker"] = {"color": series.colour, "size": 9, "symbol": "circle-open" if series.hollow else "circle"}
        if series.text:
            trace |= {
                "mode": "markers+text",
                "text": [_escaped(word) for word in series.text],
                "textposition": "top center",
            }
        return trace
    width, opacity = (1.0, 0.35) if series.faint else (2.2, 0.9)
    shape = {"shape": "hv" if series.kind == "step" else "linear", "dash": "dot" if series.hollow else "solid"}
    return trace | {"line": {"color": series.colour, "width": width, **shape}, "opacity": opacity}


def figure_label(figure: str) -> str:
    """What an axis of a figure over uncommanded says."""
    return f"{FIGURES[figure].label}, over {UNCOMMANDED} ({FIGURES[figure].unit})"


def _axis(title: str) -> dict[str, Any]:
    return {"title": {"text": _escaped(title)}, "zeroline": False, "automargin": True}


def _short(values: ArrayLike | Sequence[float | None]) -> list[float | None]:
    """Six digits are more than is shown, and keep the page small."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values, float)]


def _escaped(text: str) -> str:
    return html.escape(text, quote=False)
