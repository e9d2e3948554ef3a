"""The paper's histograms as one picture: the benefit of every approach, a panel per entry of a leaderboard."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from izoo.files import replacing
from izoo.reporting.drawing import PALETTE, QUIET
from izoo.reporting.histograms import LIMIT_PCT, cut_height, histogram_counts, zero_count
from izoo.reporting.standing import labels, published_for
from izoo.reporting.submissions import Checked, rows_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANELS_PER_ROW = 2


def draw_histograms(checked: Sequence[Checked], path: Path) -> None:
    """Write :func:`histogram_panels` as PNG."""
    with replacing(path) as partial:
        histogram_panels(checked).savefig(partial, dpi=150, format="png")


def histogram_panels(checked: Sequence[Checked]) -> Figure:
    """Draw how many approaches have which benefit (exact gate), over all training seeds of an entry.

    As in the paper, benefits are clipped to ±100 % and bars far above the others are cut. Of the published histograms
    only the bar at 0 is known as a number; its share of the approaches stands beside that of its namesake.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Drawing

    rows = math.ceil(len(checked) / PANELS_PER_ROW)
    figure = Drawing(figsize=(10.0, 2.1 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, PANELS_PER_ROW, squeeze=False, sharex=True).ravel()
    names = labels([each.submission for each in checked])
    for panel, each, name in zip(axes, checked, names, strict=False):
        _panel(panel, each.submission, name)
    for panel in axes[len(checked) :]:
        panel.set_axis_off()
    for panel in axes[max(len(checked) - PANELS_PER_ROW, 0) : len(checked)]:
        panel.set_xlabel("benefit over human driving, exact gate (%)")
        panel.tick_params(labelbottom=True)
    return figure


def _panel(axes: Axes, submission: dict[str, Any], name: str) -> None:
    table = rows_of(submission)
    benefit = table.loc[table["left_out"] == "", "benefit_exact"].to_numpy()
    counts, edges = histogram_counts(benefit)
    cut = cut_height(counts)
    axes.bar(edges[:-1], np.minimum(counts, cut), width=float(edges[1] - edges[0]), align="edge", color=PALETTE[0])
    for edge, count in zip(edges, counts, strict=False):
        if count > cut:
            axes.annotate(str(count), (edge, cut), ha="center", va="bottom", fontsize=8)
    axes.set(xlim=(-LIMIT_PCT, LIMIT_PCT), ylim=(0.0, 1.2 * cut), ylabel="approaches, all seeds")
    axes.axvline(0.0, color=QUIET, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{name}: {submission['protocol']['title']}".replace("_", " "), fontsize=9, parse_math=False)
    algorithm = submission["policy"]["name"].removesuffix("_paper")
    beside = [each for each in published_for(submission["protocol"], "at_zero") if each.algorithm.lower() == algorithm]
    said = [f"at 0: {_share(zero_count(benefit), len(benefit))}"]
    said += [f"published: {_share(each.at_zero, each.approaches)}" for each in beside]
    axes.text(0.02, 0.95, "\n".join(said), transform=axes.transAxes, va="top", fontsize=8)


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.0f} %)"
