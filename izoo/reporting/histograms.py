"""The paper's histograms, and its figures beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from izoo.reporting.drawing import PALETTE, QUIET, Figure, axis, colours, error_bars, escaped, in_percent, in_words
from izoo.reporting.published import PUBLISHED
from izoo.reporting.scored import Scored

BINS, LIMIT_PCT = 150, 100.0
"""The published histogram: benefit clipped to +-100 %, 150 bins."""


def histogram(benefit: ArrayLike, title: str, name: str, colour: str = PALETTE[0]) -> Figure:
    """Return the histogram over approaches; bars far above the others are cut and their count printed.

    Args:
        benefit: ``[N]`` as fractions.
        title: such as ``train -> test``.
        name: of the figure.
        colour: of the bars.
    """
    counts, edges = histogram_counts(benefit)
    percent = 100.0 * np.asarray(benefit, dtype=float)
    cut = cut_height(counts)
    middles = 0.5 * (edges[:-1] + edges[1:])
    bars = {
        "type": "bar",
        "x": np.round(middles, 4).tolist(),
        "y": np.minimum(counts, cut).tolist(),
        "width": float(edges[1] - edges[0]),
        "customdata": counts.tolist(),
        "marker": {"color": colour, "line": {"width": 0}},
        "hovertemplate": "%{customdata} approaches<br>about %{x:.1f} %<extra></extra>",
    }
    notes = [
        {"x": float(x), "y": cut, "text": str(count), "showarrow": False, "yanchor": "bottom", "font": {"size": 12}}
        for x, count in zip(middles, counts, strict=True)
        if count > cut
    ]
    layout = {
        "bargap": 0,
        "xaxis": axis("emission benefit per approach (%)", range=[-LIMIT_PCT, LIMIT_PCT], zeroline=True),
        "yaxis": axis("approaches", range=[0, 1.15 * cut], **({"dtick": 1} if cut <= 6 else {})),
        "annotations": notes,
        "showlegend": False,
    }
    zero = zero_count(benefit)
    alt = f"Histogram of the benefit of {percent.size} approaches, {title}; {zero} lie in the bar at 0"
    if percent.size:
        alt += f", median {np.median(percent):.1f} %"
    return Figure(name, f"{title} (n = {percent.size})", "", alt + ".", [bars], layout, 260)


def histogram_counts(benefit: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return counts and edges (in %) of the published histogram, for benefits as fractions."""
    percent = np.clip(100.0 * np.asarray(benefit, dtype=float), -LIMIT_PCT, LIMIT_PCT)
    return np.histogram(percent, bins=BINS, range=(-LIMIT_PCT, LIMIT_PCT))


def zero_count(benefit: ArrayLike) -> int:
    """Return how many approaches lie in the histogram's bar that begins at 0."""
    return int(histogram_counts(benefit)[0][BINS // 2])


def cut_height(counts: np.ndarray) -> float:
    """Height at which bars are cut: that of the tallest, unless it is over three times the second tallest."""
    tallest = np.sort(counts)[::-1]
    if tallest[0] > 3 * max(int(tallest[1]), 1):
        return float(max(2 * tallest[1], 1))
    return float(max(tallest[0], 1))


def histograms(scored: Sequence[Scored], title: str) -> list[Figure]:
    """Per policy the histogram over all its training seeds and, of several, that of the best, labelled."""
    found, tint = [], colours(scored)
    for k, s in enumerate(scored):
        every = s.matrix("benefit_exact").to_numpy()
        label = f"{s.name}: {title}" if s.name != title else title
        runs = every.shape[0]
        pooled = label if runs == 1 else f"{label}, all {runs} seeds"
        found.append(histogram(every.ravel(), pooled, f"histogram-{k}", tint[s.name]))
        if s.best_summary is not None:
            best = every[s.best]
            words = f"{label}, best of {runs} seeds (the paper's form)"
            found.append(histogram(best, words, f"histogram-{k}-best", tint[s.name]))
    return found


def beside_published(scored: Sequence[Scored]) -> Figure:
    """Ratio of sums after gating: the published figures and ours."""
    published = [(f"{p.algorithm}, {p.protocol} (paper)", p.benefit) for p in PUBLISHED if p.benefit is not None]
    ours = [(f"{s.name} (here)", s.summary["all"]["exact"]["ratio_of_sums"]) for s in scored]
    data: list[dict[str, Any]] = [
        {
            "type": "bar",
            "orientation": "h",
            "name": "published",
            "y": [escaped(label) for label, _ in published][::-1],
            "x": [100.0 * value for _, value in published][::-1],
            "marker": {"color": QUIET, "opacity": 0.6},
            "hovertemplate": "%{x:.2f} %<extra></extra>",
        },
        {
            "type": "bar",
            "orientation": "h",
            "name": "this evaluation",
            "y": [escaped(label) for label, _ in ours][::-1],
            "x": [in_percent(e["value"]) for _, e in ours][::-1],
            "error_x": error_bars([e for _, e in ours][::-1]),
            "marker": {"color": PALETTE[0]},
            "hovertemplate": "%{x:.2f} %<extra></extra>",
        },
    ]
    layout = {
        "xaxis": axis("emission benefit, ratio of sums after gating (%)", zeroline=True),
        "yaxis": {"automargin": True, "type": "category"},
        "barmode": "overlay",
    }
    caption = "Only the ratio of sums after gating compares with the published figures, and only on the same protocol."
    words = [f"{s.name} {in_words(s.summary['all']['exact']['ratio_of_sums'])}" for s in scored]
    height = 130 + 30 * (len(published) + len(ours))
    return Figure("published", "", caption, f"Ratio of sums here: {'; '.join(words)}.", data, layout, height)
