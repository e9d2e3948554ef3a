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


def forest(scored: Sequence[Scored]) -> Figure:
    """Mean and interquartile mean of the benefit under both gates, with intervals where there are any."""
    data, names = [], [escaped(s.name) for s in scored][::-1]
    for gate, symbol in (("exact", "circle"), ("tested", "diamond-open")):
        for statistic, label, shift in (("mean", "mean", 0.12), ("iqm", "interquartile mean", -0.12)):
            estimates = [s.summary["all"][gate][statistic] for s in scored][::-1]
            x = [in_percent(e["value"]) for e in estimates]
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": f"{label}, {gate} gate",
                    "x": x,
                    "y": [k + shift + (0.03 if gate == "tested" else -0.03) for k in range(len(names))],
                    "error_x": error_bars(estimates),
                    "text": [f"{name}: n = {e['n']}" for name, e in zip(names, estimates, strict=True)],
                    "hovertemplate": "%{text}<br>%{x:.2f} %<extra>%{fullData.name}</extra>",
                    "marker": {"symbol": symbol, "size": 9, "color": PALETTE[0] if statistic == "mean" else PALETTE[1]},
                    "visible": True if gate == "exact" else "legendonly",
                }
            )
    ticks = {"tickvals": list(range(len(names))), "ticktext": names, "range": [-0.6, len(names) - 0.4]}
    layout = {
        "xaxis": axis("emission benefit (%)", zeroline=True),
        "yaxis": {**ticks, "automargin": True, "zeroline": False},
    }
    words = [f"{s.name} {in_words(s.summary['all']['exact']['mean'])}" for s in scored]
    caption = "Benefit with 95 % intervals, where there are any. The tested gate can be switched on in the legend."
    alt = f"Mean benefit, exact gate: {'; '.join(words)}."
    return Figure("forest", "Benefit", caption, alt, data, layout, max(360, 150 + 52 * len(names)))


def profiles(scored: Sequence[Scored]) -> Figure:
    """Performance profiles: the share of approaches above each benefit."""
    data, tint = [], colours(scored)
    for s in scored:
        share = profile(s)
        if share.size:
            dash = "dot" if s.entry.policy == UNCOMMANDED else "solid"
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
        "xaxis": axis("emission benefit, exact gate (%)", zeroline=True, range=[-50, 50]),
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
