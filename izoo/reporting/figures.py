"""Plots of a report, as SVG text to be put into a page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

BINS, LIMIT_PCT = 150, 100.0
"""The published histogram: benefit clipped to +-100 %, 150 bins (spec 11)."""
FEATURES = {
    "volume_over_capacity": "volume over capacity",
    "green_share": "green share",
    "lane_length_m": "approach length (m)",
    "speed_limit_mps": "speed limit (m/s)",
    "lane_count": "lanes",
    "flow_vph_per_lane": "inflow (veh/h per lane)",
}
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def histogram(benefit: ArrayLike, title: str) -> str:
    """Return the histogram over approaches; bars far above the others are cut and their count printed.

    Args:
        benefit: ``[N]`` as fractions.
        title: such as ``train -> test``.
    """
    percent = np.clip(100.0 * np.asarray(benefit, dtype=float), -LIMIT_PCT, LIMIT_PCT)
    counts, edges = np.histogram(percent, bins=BINS, range=(-LIMIT_PCT, LIMIT_PCT))
    cut = cut_height(counts)
    with mpl.rc_context({**_STYLE, "svg.hashsalt": f"histogram {title}"}):
        figure = Figure(figsize=(7.0, 3.0), layout="constrained")
        axes = figure.subplots()
        axes.bar(edges[:-1], np.minimum(counts, cut), width=np.diff(edges), align="edge", color="#2b6cb0")
        for left, right, count in zip(edges[:-1], edges[1:], counts, strict=True):
            if count > cut:
                axes.text((left + right) / 2, cut, str(count), ha="center", va="bottom", fontsize=9)
        axes.axvline(0.0, color="#444", linewidth=0.8)
        axes.set(xlim=(-LIMIT_PCT, LIMIT_PCT), ylim=(0.0, 1.12 * cut), title=f"{title} (n = {percent.size})")
        axes.set(xlabel="emission benefit per approach (%)", ylabel="approaches")
        return _svg(figure)


def cut_height(counts: np.ndarray) -> float:
    """Height at which bars are cut: that of the tallest, unless it is over three times the second tallest."""
    tallest = np.sort(counts)[::-1]
    if tallest[0] > 3 * max(int(tallest[1]), 1):
        return float(max(2 * tallest[1], 1))
    return float(max(tallest[0], 1))


def scatter(table: pd.DataFrame, features: Sequence[str], gate: str = "exact") -> str:
    """Return the benefit against each feature of the approaches; gated ones hollow."""
    columns = 3
    rows = -(-len(features) // columns)
    gated = table[f"gated_{gate}"].to_numpy(bool)
    percent = 100.0 * table["benefit_ungated"].clip(-LIMIT_PCT / 100.0, LIMIT_PCT / 100.0).to_numpy(float)
    with mpl.rc_context({**_STYLE, "svg.hashsalt": "scatter"}):
        figure = Figure(figsize=(9.0, 2.6 * rows), layout="constrained")
        axes = np.atleast_1d(figure.subplots(rows, columns, sharey=True, squeeze=False)).reshape(-1)
        for ax, name in zip(axes, features, strict=False):
            x = table[name].to_numpy(float)
            ax.scatter(x[~gated], percent[~gated], s=14, color="#2b6cb0", label="throughput kept")
            ax.scatter(x[gated], percent[gated], s=14, facecolors="none", edgecolors="#c05621", label="gated to 0")
            ax.axhline(0.0, color="#444", linewidth=0.8)
            ax.set_xlabel(FEATURES.get(name, name))
        for ax in axes[len(features) :]:
            ax.set_visible(False)
        axes[0].set_ylabel("benefit without gate (%)")
        axes[0].legend(fontsize=8, frameon=False)
        return _svg(figure)


def _svg(figure: Figure) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    content = text.getvalue()
    return content[content.index("<svg") :]
