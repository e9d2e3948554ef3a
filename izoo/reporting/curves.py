"""Learning curves of training runs, and the Pareto plot of a trade-off sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from izoo.reporting.drawing import PALETTE, QUIET, Figure, axis, escaped
from izoo.reporting.material import Curve
from izoo.training.plots import band

CURVES = {
    "co2_saved_over_uncommanded": "training: CO2 saved over uncommanded CVs (share)",
    "co2_saved_over_human": "training: CO2 saved over human driving (share)",
    "return": "return per episode",
    "emission_g_per_vehicle": "CO2 per vehicle (g)",
    "throughput_veh_per_episode": "vehicles through per episode",
    "stopped_time_s_per_vehicle": "stopped time per vehicle (s)",
}
"""Columns of ``metrics.csv`` that are drawn."""
CURVE_POINTS = 400
BAND_CAPTION = "The band reaches from the lowest to the highest training seed, the thick line is their mean."
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
    """Lines against environment steps; training batches are noisy, so their running mean is drawn.

    Where a policy has several training seeds, a band beside their lines reaches from the lowest to the highest; the
    validations of a single one have their intervals over intersections.
    """
    data: list[dict[str, Any]] = []
    ends: list[str] = []
    families: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for run, table in tables:
        x, y = _smoothed(table, column, window)
        family, keep = _family(run), np.unique(np.linspace(0, max(len(x) - 1, 0), CURVE_POINTS).astype(int))[: len(x)]
        families.setdefault(family, []).append((x, y))
        line = {
            "mode": "lines+markers" if window == 1 else "lines",
            "showlegend": len(families[family]) == 1,
            "x": x[keep].tolist(),
            "y": _short(y[keep]),
            "hovertemplate": f"{escaped(run)}<br>%{{x}}: %{{y:.4g}}<extra></extra>",
            "line": {"color": shades[family], "width": 1.7},
            "opacity": 0.85,
        }
        bars = _interval_bars(table, column, x, y)
        if bars is not None:
            line["error_y"] = bars
        data.append(_trace(family, line))
        if len(y):
            ends.append(f"{run} ends at {y[-1]:.4g}")
    banded = {family: lines for family, lines in families.items() if len(lines) > 1}
    for trace in data:
        if trace["legendgroup"] in map(escaped, banded):
            trace |= {"opacity": 0.35, "line": {**trace["line"], "width": 1.0}}
            trace.pop("error_y", None)
    for family, lines in banded.items():
        data += _band(family, lines, shades[family])
    layout = {"xaxis": axis("environment steps"), "yaxis": {"automargin": True}, "showlegend": len(tables) > 1}
    alt = f"{label} against environment steps; {'; '.join(ends)}."
    return Figure(name, label, BAND_CAPTION if banded else "", alt, data, layout, 280)


def _interval_bars(table: Any, column: str, x: np.ndarray, y: np.ndarray) -> dict[str, Any] | None:
    """Return the intervals that stand beside a column of validations as error bars; ``None`` where there are none."""
    ends = [f"{column}_{end}" for end in ("low", "high")]
    if not all(end in table and table[end].notna().any() for end in ends) or len(x) > CURVE_POINTS:
        return None
    table = table.drop_duplicates("frames", keep="last").set_index("frames")
    low, high = (table[end].reindex(x).to_numpy(float) for end in ends)
    above, below = (np.nan_to_num(part) for part in (high - y, y - low))
    return {"type": "data", "symmetric": False, "array": _short(above), "arrayminus": _short(below), "width": 3}


def _smoothed(table: Any, column: str, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and running mean of a column, without the rows that lack it."""
    series = table[["frames", column]].dropna() if column in table else pd.DataFrame({"frames": [], column: []})
    width = max(1, min(window, len(series) // 5))
    smooth = series[column].rolling(width, min_periods=1).mean()
    return series["frames"].to_numpy(float), smooth.to_numpy(float)


def _band(family: str, lines: Sequence[tuple[np.ndarray, np.ndarray]], colour: str) -> list[dict[str, Any]]:
    """Return what lies between the lowest and the highest of several lines, and their mean, where all of them are."""
    between = band(lines)
    if between is None:
        return []
    x, low, middle, high = between
    area = {
        "x": [*x.tolist(), *x[::-1].tolist()],
        "y": _short(np.concatenate([low, high[::-1]])),
        "fill": "toself",
        "fillcolor": colour,
        "line": {"width": 0},
        "mode": "lines",
        "opacity": 0.18,
        "hoverinfo": "skip",
    }
    text = f"{escaped(family)}, mean of {len(lines)} seeds<br>%{{x:.0f}}: %{{y:.4g}}<extra></extra>"
    mean = {"x": x.tolist(), "y": _short(middle), "mode": "lines", "line": {"color": colour, "width": 2.6}}
    return [_trace(family, {**part, "showlegend": False}) for part in (area, {**mean, "hovertemplate": text})]


def _trace(family: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "scatter", "name": escaped(family), "legendgroup": escaped(family), **values}


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


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
