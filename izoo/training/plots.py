"""Learning curves as pictures: of a run, and of several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from izoo.files import replacing
from izoo.training.records import MetricsTable

PANELS = (
    ("return", "return per episode"),
    ("emission_g_per_vehicle", "CO2 per vehicle, g"),
    ("throughput_veh_per_episode", "vehicles through per episode"),
    ("stopped_time_s_per_vehicle", "stopped time per vehicle, s"),
)
COMPARED_PANELS = (
    ("%", (("co2_saved", "CO2 saved over uncommanded CVs"), ("co2_saved_over_human", "CO2 saved over human driving"))),
    ("s", (("delay_change_s", "delay added to that of uncommanded CVs"),)),
)
"""Unit, columns and labels: training episodes beside the same ones without the policy (:mod:`izoo.training.paired`),
and validations."""
SMOOTHING_POINTS = 20
BAND_POINTS = 100
LEGEND_CHARACTERS = 40
"""Longer names of choices lose their middle, so that the legend leaves room for the panels."""


def learning_curve(table: MetricsTable, path: Path, title: str, validation: MetricsTable | None = None) -> None:
    """Save what :func:`draw_learning_curve` draws as PNG."""
    _save(draw_learning_curve(table, title, validation), path)


def draw_learning_curve(table: MetricsTable, title: str, validation: MetricsTable | None = None) -> Figure:
    """Draw return, emission, throughput and stopped time against environment steps.

    Thin lines are single batches; thick ones their running mean over a fifth of the points, at most 20. Where the run
    has validated, two more panels show CO2 saved and delay added, with their intervals as vertical lines; where its
    episodes were compared with the same ones without the policy, two more show the same for these.
    """
    validated = validation is not None and bool(validation.rows)
    paired = bool(table.series(COMPARED_PANELS[0][1][0][0])[1])
    columns = 2 + paired + validated
    figure = Figure(figsize=(2 + 4 * columns, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    grid = figure.subplots(2, columns)
    if paired:
        _compared_panels(list(grid[:, 2]), table, "training")
    if validation is not None and validated:
        _compared_panels(list(grid[:, -1]), validation, "validation")
        best = [int(row["frames"]) for row in validation.rows if row.get("best") == "1"]
        if best:
            grid[0, -1].axvline(best[-1], color="tab:green", alpha=0.3, linestyle="--")
    for axes, (name, label) in zip(grid[:, :2].flat, PANELS, strict=True):
        frames, values = table.series(name)
        axes.plot(frames, values, color="tab:blue", alpha=0.3, linewidth=1)
        axes.plot(frames, _running_mean(values), color="tab:blue", linewidth=2)
        _label(axes, label)
    return figure


def compare_curves(runs: Mapping[str, Sequence[MetricsTable]], path: Path, title: str) -> None:
    """Save what :func:`draw_compared` draws as PNG."""
    _save(draw_compared(runs, title), path)


def draw_compared(runs: Mapping[str, Sequence[MetricsTable]], title: str) -> Figure:
    """Draw return and emission of several runs against environment steps.

    Where all have been compared with the same episodes without the policy, what they saved stands beside.

    Lines are running means over a fifth of a run's batches, at most 20, without the first of them, which would be means
    of fewer. Of several runs of one choice the mean is drawn, and a band from the lowest to the highest, as far as all
    of them have come.

    Args:
        runs: metrics of the runs of every choice, such as the training seeds of an algorithm.
        title: of the picture.
    """
    unit, saved = COMPARED_PANELS[0]
    compared = all(table.series(saved[0][0])[1] for tables in runs.values() for table in tables)
    panels = (*((name, f"{label}, {unit}") for name, label in saved if compared), *PANELS[:2])
    figure = Figure(figsize=(3 + 4 * len(panels), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    for axes, (name, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for (choice, tables), colour in zip(runs.items(), cycle(matplotlib.color_sequences["tab10"]), strict=False):
            choice = _shortened(choice)
            lines = [_smooth_line(table, name) for table in tables if table.series(name)[1]]
            between = band(lines)
            if between is None:
                for number, (frames, values) in enumerate(lines):
                    axes.plot(frames, values, color=colour, linewidth=1.6, label=None if number else choice)
            else:
                frames, low, mean, high = between
                axes.fill_between(frames, low, high, color=colour, alpha=0.18, linewidth=0)
                axes.plot(frames, mean, color=colour, linewidth=1.8, label=f"{choice}, {len(lines)} runs")
        _label(axes, label)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def band(lines: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...] | None:
    """Return steps, and at each the lowest, the mean and the highest of several lines, where all of them are.

    Args:
        lines: steps, ascending, and values of each.

    Returns:
        Four arrays ``[100]``, or ``None`` for a single line, or lines that have no steps in common.
    """
    if len(lines) < 2 or any(len(x) == 0 for x, _ in lines):
        return None
    begin, end = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    if end <= begin:
        return None
    x = np.linspace(begin, end, BAND_POINTS)
    values = np.stack([np.interp(x, own, y) for own, y in lines])
    return x, values.min(0), values.mean(0), values.max(0)


def _smooth_line(table: MetricsTable, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and running mean of a column, from the first mean of a full width on."""
    frames, values = table.series(name)
    begin = _width(values) - 1
    return np.array(frames[begin:], float), np.array(_running_mean(values)[begin:], float)


def _save(figure: Figure, path: Path) -> None:
    """Write the picture whole or not at all."""
    with replacing(path, durable=False) as partial:
        figure.savefig(partial, format="png", dpi=110)


def _compared_panels(panels: list[Axes], table: MetricsTable, what: str) -> None:
    """Draw :data:`COMPARED_PANELS`: validations as dots with their intervals, training as a line and its mean."""
    for axes, (unit, columns) in zip(panels, COMPARED_PANELS, strict=True):
        for (name, label), colour in zip(columns, ("tab:green", "tab:gray"), strict=False):
            frames, values = table.series(name)
            if what == "training":
                axes.plot(frames, values, color=colour, alpha=0.3, linewidth=1)
                axes.plot(frames, _running_mean(values), color=colour, linewidth=2, label=label)
                continue
            axes.plot(frames, values, "o-", markersize=4, color=colour, label=label)
            low, high = (dict(zip(*table.series(f"{name}_{end}"), strict=True)) for end in ("low", "high"))
            known = [number for number in frames if number in low and number in high]
            ends = [[end[number] for number in known] for end in (low, high)]
            axes.vlines(known, *ends, color=colour, alpha=0.5, linewidth=1.5)
        _label(axes, f"{what}, {unit}")
        axes.axhline(0.0, color="black", linewidth=0.8)
        # Above the panel, where it covers no curve.
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=1, frameon=False, fontsize="small")


def _label(axes: Axes, label: str) -> None:
    """Name the axes; steps are written short (``150k``, ``1.5M``) and far enough apart to be told from each other."""
    axes.set_xlabel("environment steps")
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _shortened(text: str) -> str:
    half = LEGEND_CHARACTERS // 2
    return text if len(text) <= LEGEND_CHARACTERS else f"{text[: half - 1]}…{text[-half:]}"


def _width(values: list[float]) -> int:
    return max(1, min(SMOOTHING_POINTS, len(values) // 5))


def _running_mean(values: list[float]) -> list[float]:
    width = _width(values)
    return [sum(part) / len(part) for end in range(1, len(values) + 1) if (part := values[max(0, end - width) : end])]
