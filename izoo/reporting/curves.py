"""Learning curves of training runs, and the Pareto plot of a trade-off sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from izoo.reporting.drawing import PALETTE, QUIET, Figure, axis, escaped
from izoo.reporting.material import Curve

CURVES = {
    "return": "return per episode",
    "emission_g_per_vehicle": "CO2 per vehicle (g)",
    "throughput_veh_per_episode": "vehicles through per episode",
    "stopped_time_s_per_vehicle": "stopped time per vehicle (s)",
}
"""Columns of ``metrics.csv`` that are drawn."""
CURVE_POINTS = 400
TRADED = ("emission_g_per_vehicle", "travel_time_s_per_vehicle")
"""Columns of ``tradeoffs.csv`` that the Pareto plot shows."""


def learning_curves(runs: Sequence[Curve], tint: Mapping[str, str] | None = None) -> list[Figure]:
    """One figure per column that any run has, a line per run; validations come first.

    Args:
        tint: colours of policies by name.
    """
    families = dict.fromkeys(_family(curve.name) for curve in runs)
    free = [colour for colour in PALETTE if colour not in (tint or {}).values()] or list(PALETTE)
    shades = {name: free[k % len(free)] for k, name in enumerate(families)} | dict(tint or {})
    found: list[Figure] = []
    for column in _validation_columns(runs):
        tables = [(c.name, c.validation) for c in runs if c.validation is not None]
        found.append(
            _curve(f"curve-validation-{len(found)}", tables, column, f"validation: {_readable(column)}", shades, 1)
        )
    for column, label in CURVES.items():
        tables = [(c.name, c.metrics) for c in runs if column in c.metrics and c.metrics[column].notna().any()]
        if tables:
            found.append(_curve(f"curve-{column.replace('_', '-')}", tables, column, label, shades, 20))
    return found


def _validation_columns(runs: Sequence[Curve]) -> list[str]:
    columns = [name for c in runs if c.validation is not None for name in c.validation if "benefit" in name]
    return [name for name in dict.fromkeys(columns) if not name.endswith(("_low", "_high"))][:4]


def _family(run: str) -> str:
    """What the training seeds of one policy have in common."""
    return run.partition(" seed ")[0]


def _curve(
    name: str, tables: Sequence[tuple[str, Any]], column: str, label: str, shades: Mapping[str, str], window: int
) -> Figure:
    """Lines against environment steps; training batches are noisy, so their running mean is drawn."""
    data: list[dict[str, Any]] = []
    for run, table in tables:
        series = table[["frames", column]].dropna() if column in table else pd.DataFrame({"frames": [], column: []})
        width = max(1, min(window, len(series) // 5))
        smooth = series[column].rolling(width, min_periods=1).mean().to_numpy(float)
        keep = np.unique(np.linspace(0, max(len(series) - 1, 0), CURVE_POINTS).astype(int))[: len(series)]
        family = _family(run)
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers" if window == 1 else "lines",
                "name": escaped(family),
                "legendgroup": escaped(family),
                "showlegend": all(line["legendgroup"] != escaped(family) for line in data),
                "x": series["frames"].to_numpy(float)[keep].tolist(),
                "y": [float(f"{value:.6g}") for value in smooth[keep]],
                "hovertemplate": f"{escaped(run)}<br>%{{x}}: %{{y:.4g}}<extra></extra>",
                "line": {"color": shades[family], "width": 1.7},
                "opacity": 0.85,
            }
        )
    layout = {"xaxis": axis("environment steps"), "yaxis": {"automargin": True}, "showlegend": len(tables) > 1}
    ends = [f"{run} ends at {line['y'][-1]:.4g}" for (run, _), line in zip(tables, data, strict=True) if line["y"]]
    alt = f"{label} against environment steps; {'; '.join(ends)}."
    return Figure(name, label, "", alt, data, layout, 280)


def _readable(column: str) -> str:
    return column.replace("_", " ")


def pareto(table: pd.DataFrame) -> Figure:
    """Emission against travel time of a trade-off sweep, with its front (columns: ``izoo.benchmarks.pareto``)."""
    x, y = TRADED
    data: list[dict[str, Any]] = []
    for kind, colour in (("human", QUIET), ("scripted", PALETTE[1]), ("trained", PALETTE[0])):
        for kept, symbol in ((True, "circle"), (False, "circle-open")):
            chosen = table[(table["kind"] == kind) & (table["throughput_kept"] == kept)]
            if len(chosen):
                words = [escaped(str(point)) for point in chosen["point"]]
                data.append(
                    {
                        "type": "scatter",
                        "mode": "markers+text",
                        "name": kind if kept else f"{kind}, lost throughput",
                        "x": chosen[x].tolist(),
                        "y": chosen[y].tolist(),
                        "text": words,
                        "textposition": "top center",
                        "textfont": {"size": 10},
                        "hovertemplate": "%{text}<br>%{x:.1f} g, %{y:.1f} s<extra></extra>",
                        "marker": {"size": 10, "color": colour, "symbol": symbol},
                        "cliponaxis": False,
                    }
                )
    front = table[table["on_front"]].sort_values(x)
    line = {"color": QUIET, "shape": "hv", "dash": "dot"}
    points = {"x": front[x].tolist(), "y": front[y].tolist()}
    data.append(
        {"type": "scatter", "mode": "lines", "name": "Pareto front", **points, "line": line, "hoverinfo": "skip"}
    )
    layout = {"xaxis": axis("CO2 per vehicle (g)"), "yaxis": axis("travel time per vehicle (s)")}
    caption = "Lower is better on both axes. Hollow points lost throughput against human driving and are on no front."
    names = ", ".join(front["point"].astype(str))
    alt = f"{len(table)} points of emission and travel time; on the Pareto front: {names or 'none'}."
    return Figure("pareto", "", caption, alt, data, layout, 460)
