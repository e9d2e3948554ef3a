"""Charts, described once and drawn as PNG here or on a report's page (:mod:`izoo.report.plots`); learning curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from izoo.files import replacing
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import UNCOMMANDED
from izoo.training.loggers import IMITATION, MetricsTable

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f4fa0", "#8c564b")
"""Okabe and Ito's colours, which colour-blind readers can tell apart, and two more."""
QUIET = "#8a8f98"
FRAMES = "environment steps"
CURVES = {
    "return": "return per episode",
    "emission_g_per_vehicle": "CO2 per vehicle (g)",
    "throughput_veh_per_episode": "vehicles through per episode",
    "stopped_time_s_per_vehicle": "stopped time per vehicle (s)",
    "co2_saved": "training: CO2 saved, over uncommanded (%)",
    "co2_saved_over_human": "training: CO2 saved, over human (%)",
}
"""Columns of ``metrics.csv`` that are drawn: what their axis says."""
COMPARED = ("co2_saved", "return", "emission_g_per_vehicle")
"""Columns that are drawn where several choices stand side by side."""
SMOOTHING_POINTS, BAND_POINTS, CURVE_POINTS = 20, 100, 400
LEGEND_CHARACTERS = 40
"""Longer names of choices lose their middle, so that the legend leaves room for the panels."""
Array = NDArray[np.float64]
Line = tuple[Array, Array]
"""Environment steps and values, ``[N]`` each."""


@dataclass(frozen=True)
class Series:
    """One mark of a chart: a line, points, a band, steps, bars, or a shaded span of x, in data coordinates.

    Attributes:
        x, y: ``[N]`` each.
        name: in the legend, shared by what belongs together; only the first series of a name is listed.
        kind: what is drawn; ``band`` fills between ``low`` and ``high``, ``step`` falls after each point.
        low, high: ends of vertical intervals (of horizontal ones in a chart with ``rows``).
        colour: of the mark.
        faint: drawn thin, beside something that sums it up.
        dash: of lines, as Matplotlib writes it.
        text: ``[N]`` words about the points.
    """

    x: ArrayLike
    y: ArrayLike
    name: str = ""
    kind: Literal["line", "points", "band", "step", "bars", "span"] = "line"
    low: Sequence[float | None] | Array | None = None
    high: Sequence[float | None] | Array | None = None
    colour: str = PALETTE[0]
    faint: bool = False
    dash: str = "-"
    text: Sequence[str] | None = None

    @property
    def listed(self) -> bool:
        """Whether it may stand in the legend."""
        return bool(self.name) and not self.faint and self.kind != "band"


@dataclass(frozen=True)
class Chart:
    """A chart: what is drawn, and what is said about it.

    Attributes:
        name: its place on a page, ``[a-z0-9-]``.
        title, caption: above and below it; may be empty.
        alt: what it shows, in words, for readers who do not see it.
        series: the marks.
        x_label, y_label: of the axes.
        rows: names of rows, where ``y`` counts rows from the top.
        x_range, y_range: of the axes; ``None``: what the data need.
        log_x: whether the x axis is logarithmic.
        zero: mark the line at 0 of the measured axis.
    """

    name: str
    title: str
    series: Sequence[Series]
    x_label: str = ""
    y_label: str = ""
    caption: str = ""
    alt: str = ""
    rows: Sequence[str] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    log_x: bool = False
    zero: bool = False


def learning_curve(table: MetricsTable, path: Path, title: str, validation: MetricsTable | None = None) -> None:
    """Save what :func:`curves` draws of a run as PNG."""
    save(draw(curves({title: [(table, validation)]}), title), path)


def compare_curves(runs: Mapping[str, Sequence[MetricsTable]], path: Path, title: str) -> None:
    """Save the :data:`COMPARED` columns of several choices, each with its training runs, as PNG."""
    pairs = {_shortened(choice): [(table, None) for table in tables] for choice, tables in runs.items()}
    save(draw(curves(pairs, COMPARED), title), path)


def curves(
    runs: Mapping[str, Sequence[tuple[MetricsTable, MetricsTable | None]]],
    columns: Sequence[str] = tuple(CURVES),
    colours: Mapping[str, str] | None = None,
) -> list[Chart]:
    """Return a chart per column that any run has, validations first.

    Training batches are noisy: lines are running means over a fifth of a run's batches, at most 20. Of several runs of
    one choice thin lines are the runs, the thick one their mean, and a band reaches from the lowest to the highest, as
    far as all of them have come. A single run's validations have their intervals. The steps of imitation are shaded.

    Args:
        runs: metrics and, where there are any, validations of the runs of each choice.
        columns: of ``metrics.csv``.
        colours: by choice; others have those of :data:`PALETTE` that are left.
    """
    free = [c for c in PALETTE if c not in (colours or {}).values()] or list(PALETTE)
    tint = {choice: free[k % len(free)] for k, choice in enumerate(runs)} | dict(colours or {})
    validations = {c: [v for _, v in pairs if v is not None] for c, pairs in runs.items()}
    measured = {c: [table for table, _ in pairs] for c, pairs in runs.items()}
    names = dict.fromkeys(name for tables in validations.values() for table in tables for name in table.columns)
    parts = [(name, f"validation: {_label(name)}", validations, 1) for name in names if f"{name}_low" in names]
    parts += [(name, CURVES[name], measured, SMOOTHING_POINTS) for name in columns]
    ends = [t.series(IMITATION)[0][-1] for of in measured.values() for t in of if t.series(IMITATION)[0]]
    imitates = [Series([0.0, max(ends)], [0.0, 0.0], "imitation", "span", colour=QUIET)] if ends else []
    charts = []
    for name, label, tables, window in parts:
        kept = {c: [t for t in of if t.series(name)[1]] for c, of in tables.items()}
        series = [mark for c, of in kept.items() for mark in _of_choice(c, of, name, window, tint[c])]
        if series:
            last = [f"{c} ends at {t.series(name)[1][-1]:.4g}" for c, of in kept.items() for t in of]
            alt, kind = f"{label} against {FRAMES}; {'; '.join(last)}.", "validation-" if window == 1 else ""
            place = f"curve-{kind}{name.replace('_', '-')}"
            charts.append(Chart(place, label, [*imitates, *series], FRAMES, alt=alt))
    return charts


def _of_choice(choice: str, tables: Sequence[MetricsTable], name: str, window: int, colour: str) -> list[Series]:
    lines = [smoothed(table, name, window) for table in tables]
    between = band(lines)
    marks = []
    for table, (x, y) in zip(tables, lines, strict=True):
        low, high = (dict(zip(*table.series(f"{name}_{end}"), strict=True)) for end in ("low", "high"))
        ends = [[end.get(int(step)) for step in x] if low and between is None else None for end in (low, high)]
        keep = np.unique(np.linspace(0, len(x) - 1, CURVE_POINTS).astype(int)) if len(x) > CURVE_POINTS else slice(None)
        faint = between is not None
        marks.append(Series(x[keep], y[keep], choice, "line", ends[0], ends[1], colour, faint))
    if between is not None:
        x, lowest, mean, highest = between
        marks += [Series(x, mean, choice, "band", lowest, highest, colour), Series(x, mean, choice, colour=colour)]
    return marks


def smoothed(table: MetricsTable, name: str, window: int = SMOOTHING_POINTS) -> Line:
    """Return steps and running mean of a column over a fifth of its values, at most ``window``."""
    frames, values = table.series(name)
    width = max(1, min(window, len(values) // 5))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(0, ends - width)
    return np.array(frames, float), (sums[ends] - sums[begins]) / (ends - begins)


def band(lines: Sequence[Line]) -> tuple[Array, ...] | None:
    """Return steps, and at each the lowest, the mean and the highest of several lines, where all of them are.

    Args:
        lines: steps, ascending, and values of each.

    Returns:
        Four arrays ``[100]``, or ``None`` for a single line, or lines that have no steps in common.
    """
    lines = [line for line in lines if len(line[0])]
    begin, end = max((x[0] for x, _ in lines), default=0.0), min((x[-1] for x, _ in lines), default=0.0)
    if len(lines) < 2 or end <= begin:
        return None
    x = np.linspace(begin, end, BAND_POINTS)
    values = np.stack([np.interp(x, own, y) for own, y in lines])
    return x, values.min(0), values.mean(0), values.max(0)


def draw(charts: Sequence[Chart], title: str = "", columns: int = 4) -> Figure:
    """Draw charts side by side, at most ``columns`` in a row, with one legend where they have several names."""
    columns = max(1, min(columns, len(charts)))
    lines = max(1, math.ceil(len(charts) / columns))
    tall = max((len(chart.rows) for chart in charts), default=0)
    figure = Figure(figsize=(2 + 4.2 * columns, max(3.4, 0.34 * tall + 1.6) * lines), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    listed: dict[str, Artist] = {}
    for chart, axes in zip(charts, panels, strict=False):
        _draw_chart(axes, chart)
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            listed.setdefault(name, handle)
    for axes in panels[len(charts) :]:
        axes.set_axis_off()
    if len(listed) > 1:
        figure.legend(list(listed.values()), list(listed), loc="outside right center", frameon=False)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write the picture whole or not at all."""
    with replacing(path, durable=False) as partial:
        figure.savefig(partial, format="png", dpi=110)


def _draw_chart(axes: Axes, chart: Chart) -> None:
    named: set[str] = set()
    for series in chart.series:
        label = series.name if series.listed and series.name not in named else "_"
        named |= {series.name} if label != "_" else set()
        _draw_series(axes, series, label, bool(chart.rows))
    axes.set_title(chart.title, fontsize=10, parse_math=False)
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if chart.rows:
        axes.set_yticks(range(len(chart.rows)), chart.rows, parse_math=False)
        axes.set_ylim(len(chart.rows) - 0.4, -0.6)
    if chart.zero:
        axes.axvline(0.0, color=QUIET, linewidth=0.8)
    if chart.x_range:
        axes.set_xlim(chart.x_range)
    if chart.y_range:
        axes.set_ylim(chart.y_range)
    if chart.log_x:
        axes.set_xscale("log")
    if chart.x_label == FRAMES:  # steps are written short (150k, 1.5M), and far enough apart
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_series(axes: Axes, series: Series, label: str, across: bool) -> None:
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    style: dict[str, Any] = {"color": series.colour, "label": label}
    ends = None if series.low is None or series.high is None else np.array([series.low, series.high], float)
    if series.kind == "band" and ends is not None:
        axes.fill_between(x, *ends, color=series.colour, alpha=0.18, linewidth=0)
        return
    if series.kind == "span":
        axes.axvspan(x[0], x[-1], color=series.colour, alpha=0.18, linewidth=0, label=label)
        return
    if series.kind == "bars":
        axes.bar(x, y, width=x[1] - x[0] if len(x) > 1 else 1.0, **style)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        return
    if ends is not None:
        known = np.isfinite(ends).all(0)
        lines = axes.hlines if across else axes.vlines
        lines((y if across else x)[known], *ends[:, known], color=series.colour, linewidth=1.5)
    if series.kind == "points":
        axes.plot(x, y, "o", **style)
        for place in zip(x, y, series.text or (), strict=False):
            axes.annotate(place[2], place[:2], fontsize=8, parse_math=False)
        return
    shape = "steps-post" if series.kind == "step" else "default"
    style |= {"linewidth": 0.8, "alpha": 0.35} if series.faint else {"linewidth": 1.8}
    axes.plot(x, y, drawstyle=shape, linestyle=series.dash, **style)


def _label(column: str) -> str:
    """What the axis of a column says that is a figure over a baseline, uncommanded where it names none."""
    name, _, baseline = column.partition("_over_")
    figure = FIGURES[name]
    return f"{figure.label}, over {baseline or UNCOMMANDED}" + (f" ({figure.unit})" if figure.unit else "")


def _shortened(text: str) -> str:
    half = LEGEND_CHARACTERS // 2
    return text if len(text) <= LEGEND_CHARACTERS else f"{text[: half - 1]}…{text[-half:]}"
