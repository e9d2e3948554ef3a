"""Figures of a report as plotly.js specifications; the page adds size and colours of its theme."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from izoo.evaluation.across import THRESHOLDS
from izoo.evaluation.policies import UNCOMMANDED
from izoo.reporting.curves import learning_curves, pareto
from izoo.reporting.drawing import PALETTE, Figure, axis, colours, error_bars, escaped, in_percent, in_words
from izoo.reporting.histograms import beside_published, histograms
from izoo.reporting.material import Material
from izoo.reporting.scored import Scored, profile

MARKS = (
    ("mean, exact gate", "exact", "mean", "circle", PALETTE[0], True),
    ("over uncommanded, no gate", "over_uncommanded", "mean", "square", PALETTE[1], True),
    ("interquartile mean, exact gate", "exact", "iqm", "circle-open", PALETTE[0], False),
    ("mean, tested gate", "tested", "mean", "diamond-open", PALETTE[2], False),
    ("interquartile mean, tested gate", "tested", "iqm", "diamond-wide-open", PALETTE[2], False),
)
"""Marks per policy: label, part and statistic of its summary, symbol, colour, and whether it is shown at first."""


def forest(scored: Sequence[Scored]) -> Figure:
    """Benefits over human driving under both gates, and over uncommanded CVs, with intervals where there are any."""
    data, names = [], [escaped(s.name) for s in scored][::-1]
    for number, (label, part, statistic, symbol, colour, shown) in enumerate(MARKS):
        marked = [
            (k, s.summary["all"][part][statistic]) for k, s in enumerate(scored[::-1]) if part in s.summary["all"]
        ]
        estimates = [estimate for _, estimate in marked]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": label,
                "x": [in_percent(e["value"]) for e in estimates],
                "y": [k + 0.1 * (2 - number) for k, _ in marked],
                "error_x": error_bars(estimates),
                "text": [f"{names[k]}: n = {e['n']}" for k, e in marked],
                "hovertemplate": "%{text}<br>%{x:.2f} %<extra>%{fullData.name}</extra>",
                "marker": {"symbol": symbol, "size": 9, "color": colour},
                "visible": True if shown else "legendonly",
            }
        )
    ticks = {"tickvals": list(range(len(names))), "ticktext": names, "range": [-0.6, len(names) - 0.4]}
    layout = {
        "xaxis": axis("emission benefit (%)", zeroline=True),
        "yaxis": {**ticks, "automargin": True, "zeroline": False},
    }
    words = [f"{s.name} {in_words(s.summary['all']['exact']['mean'])}" for s in scored]
    caption = (
        "Benefit over human driving, and over CVs that nobody commands, with 95 % intervals where there are any. The "
        "legend switches marks on and off."
    )
    alt = f"Mean benefit, exact gate: {'; '.join(words)}."
    return Figure("forest", "Benefit", caption, alt, data, layout, max(360, 150 + 52 * len(names)))


def profiles(scored: Sequence[Scored]) -> Figure:
    """Performance profiles: the share of approaches above each benefit."""
    data, tint, reach = [], colours(scored), 0.05
    for s in scored:
        share = profile(s)
        if share.size:
            dash = "dot" if s.entry.policy == UNCOMMANDED or s.untrained else "solid"
            between = np.flatnonzero((share > 0.0) & (share < 1.0))
            if between.size:
                reach = max(reach, *np.abs(np.array(THRESHOLDS)[between[[0, -1]]]))
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": f"{escaped(s.name)} (n = {s.matrix('benefit_exact').size})",
                    "x": np.round(100.0 * np.array(THRESHOLDS), 3).tolist(),
                    "y": np.round(100.0 * share, 3).tolist(),
                    "line": {"color": tint[s.name], "dash": dash, "shape": "hv"},
                    "hovertemplate": "%{y:.1f} % of approaches above %{x:.1f} %<extra></extra>",
                }
            )
    layout = {
        "xaxis": axis("emission benefit, exact gate (%)", zeroline=True, range=[-110.0 * reach, 110.0 * reach]),
        "yaxis": axis("approaches above it (%)", range=[0, 101]),
    }
    caption = (
        "Higher is better, and a curve above another everywhere is better everywhere. Curves are of these approaches "
        "and training seeds, without intervals."
    )
    alt = "Share of approaches above each benefit, a line per policy."
    return Figure("profiles", "Performance profiles", caption, alt, data, layout, 360)


def figures(material: Material, scored: Sequence[Scored]) -> dict[str, list[Figure]]:
    """Return the figures of a report by section."""
    found: dict[str, list[Figure]] = {"summary": [], "histograms": [], "published": [], "curves": []}
    if scored:
        found["summary"] = [forest(scored), profiles(scored)]
        found["histograms"] = histograms(scored, material.title)
        found["published"] = [beside_published(scored)]
    found["tradeoffs"] = [] if material.tradeoffs is None else [pareto(material.tradeoffs)]
    found["curves"] = learning_curves(material.curves, colours(scored))
    return found
