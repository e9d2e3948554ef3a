"""Pictures of intersections and of the features of a set of them, as PNG files.

Every movement has the colour of its signal group: movements that are green in the same phases share one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.ticker import MaxNLocator

from izoo.contexts.cities.compare import feature_table
from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE
from izoo.contexts.spec import IntersectionSpec, SignalPlan
from izoo.errors import IzooError
from izoo.files import expanded, replacing
from izoo.networks.net.build import build_net
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet, read_road
from izoo.networks.signals.search import planned

GROUP_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f4fa0", "#8c564b")
NEVER_GREEN, YELLOW = "#c0392b", "#f2c300"
_ASPHALT, _INSIDE, _MARK, _TEXT = "#8d9299", "#b4b8bd", "#ffffff", "#222222"
_BARS = {"G": (0.72, 1.0, ""), "g": (0.72, 0.45, ""), "y": (0.72, 1.0, YELLOW), "s": (0.12, 1.0, "#999999")}
"""Height, opacity and colour of a signal bar; an empty colour is that of the group."""
_ARROWS = {
    "s": ((0.0, -3.0), (0.0, 3.0)),
    "r": ((0.0, -3.0), (0.0, 0.5), (1.3, 1.2)),
    "l": ((0.0, -3.0), (0.0, 0.5), (-1.3, 1.2)),
}
"""Strokes of the painted arrows: metres to the right and forward."""
SCALE_M = 20.0
"""Length of the bar that shows the scale."""
LANE_M = 3.2
REACH_M = 70.0
"""How much of each leg is drawn."""
_DPI = 150


def draw_intersection(spec: IntersectionSpec, path: Path | str, streets: Mapping[str, str] | None = None) -> Path:
    """Draw lanes, turn arrows, movements in the colours of their signal groups, leg names and the signal plan.

    Args:
        spec: the intersection; a plan and a net that it lacks are made.
        path: the PNG to write; its folder is made if need be. It is returned.
        streets: street names per leg, for the labels.
    """
    spec, plan = planned(spec)
    layout = layout_of(read_road(build_net(spec)), spec)
    colours = group_colours(plan, [(movement.origin, movement.exit) for movement in layout.movements])
    figure = Figure(figsize=(12.5, 7.6), facecolor="white")
    _draw_layout(figure.add_axes((0.0, 0.0, 0.69, 0.92)), spec, layout, colours, streets or {})
    _draw_plan(figure.add_axes((0.75, 0.10, 0.24, 0.76)), plan, colours)
    figure.text(0.02, 0.955, spec.name, fontsize=14, weight="bold", color=_TEXT)
    notes = [f"{len(spec.approach_names)} approaches, source {spec.source}"]
    if spec.imputed:
        kinds = sorted({name.rsplit(" of ", 1)[0] for name in spec.imputed})
        notes.append("imputed on some legs: " + ", ".join(kinds))
    figure.text(0.02, 0.928, "; ".join(notes), fontsize=9, color="#555555")
    return save_png(figure, path)


def draw_features(specs: Iterable[IntersectionSpec], path: Path | str, title: str = "") -> Path:
    """Draw histograms of the approach features of a set of intersections, for example a city.

    Args:
        specs: the intersections; at least one.
        path: the PNG to write.
        title: what the set is.
    """
    table = played_features(specs)
    figure = Figure(figsize=(12.5, 6.2), facecolor="white")
    panels = (
        ("lane_count", "lanes at the stop line", 1.0),
        ("lane_length_m", "approach length (m)", None),
        ("speed_limit_mps", "speed limit (m/s)", None),
        ("grade", "grade (%)", None),
        ("inflow_peak_vph", "peak inflow per lane (veh/h)", None),
        ("legs", "legs of the intersection", 1.0),
        ("phase_count", "phases that serve the approach", 1.0),
        ("signal_time_ratio", "green over cycle", None),
    )
    for number, (name, label, width) in enumerate(panels, start=1):
        axes = figure.add_subplot(2, 4, number)
        _histogram(axes, table[name].to_numpy(float), width)
        axes.set_xlabel(label, fontsize=9, color=_TEXT)
        if number in (1, 5):
            axes.set_ylabel("share of approaches", fontsize=9, color=_TEXT)
    figure.suptitle(
        f"{title or 'Approach features'} ({len(table)} approaches)", fontsize=13, weight="bold", color=_TEXT
    )
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.97))
    return save_png(figure, path)


def played_features(specs: Iterable[IntersectionSpec]) -> pd.DataFrame:
    """Return a row per approach of all intersections, with the flow that is played, grades in %, and ``legs``."""
    plans = [planned(spec)[0] for spec in specs]
    if not plans:
        raise IzooError("there is no intersection to draw; check the filter or the path that selected them.")
    table = feature_table(plans)
    flow_vph = table["inflow_peak_vph"].clip(upper=FLOW_CAP_VPH_PER_LANE)
    legs = np.repeat([len(spec.legs) for spec in plans], [len(spec.approach_names) for spec in plans])
    return table.assign(grade=100.0 * table["grade"], inflow_peak_vph=flow_vph, legs=legs)


def group_colours(plan: SignalPlan, movements: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """Colour of each movement ``(from leg, to leg)``: one per signal group."""
    found: dict[tuple[str, str], str] = {}
    groups: dict[tuple[int, ...], str] = {}
    for movement in sorted(set(movements)):
        pattern = tuple(k for k, phase in enumerate(plan.phases) if _colour(phase.states, movement) in ("G", "g"))
        if pattern and pattern not in groups:
            groups[pattern] = GROUP_COLOURS[len(groups) % len(GROUP_COLOURS)]
        found[movement] = groups[pattern] if pattern else NEVER_GREEN
    return found


def _colour(states: tuple[tuple[str, str, str], ...], movement: tuple[str, str]) -> str:
    return next((colour for origin, to, colour in states if (origin, to) == movement), "r")


def _draw_layout(
    axes: Axes,
    spec: IntersectionSpec,
    layout: Layout,
    colours: Mapping[tuple[str, str], str],
    streets: Mapping[str, str],
) -> None:
    shown = Circle((0.0, 0.0), layout.extent_m, transform=axes.transData)
    for lane in layout.lanes:
        ribbon = axes.add_patch(Polygon(_ribbon(lane.points), facecolor=_ASPHALT, edgecolor=_MARK, linewidth=0.7))
        ribbon.set_clip_path(shown)
    for movement in layout.movements:
        axes.add_patch(Polygon(_ribbon(movement.points), facecolor=_INSIDE, edgecolor="none", zorder=0))
    for movement in layout.movements:
        colour = colours[movement.origin, movement.exit]
        points = movement.points
        axes.plot(points[:, 0], points[:, 1], color=colour, linewidth=1.5, zorder=3, solid_capstyle="round")
        tip, back = points[-1], points[-2]
        axes.annotate("", tip, back, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2}, zorder=3)
    for lane in layout.lanes:
        if lane.turns:
            _draw_arrows(axes, lane.points, lane.turns)
            _draw_stop_line(axes, lane.points)
    for leg in spec.legs:
        _label(axes, spec, leg.name, streets.get(leg.name, ""), layout.extent_m)
    _draw_scale_and_north(axes, layout.extent_m)
    axes.set_xlim(-1.55 * layout.extent_m, 1.55 * layout.extent_m)
    axes.set_ylim(-1.2 * layout.extent_m, 1.2 * layout.extent_m)
    axes.set_aspect("equal")
    axes.axis("off")


def _draw_scale_and_north(axes: Axes, extent_m: float) -> None:
    """Draw a bar of 20 m in the lower left corner and an arrow to the north in the upper left one."""
    left, bottom, top = -1.5 * extent_m, -1.15 * extent_m, 1.15 * extent_m
    axes.plot([left, left + SCALE_M], [bottom, bottom], color=_TEXT, linewidth=2.0, solid_capstyle="butt")
    axes.text(left + SCALE_M / 2.0, bottom + 1.5, f"{SCALE_M:.0f} m", fontsize=8, ha="center", va="bottom", color=_TEXT)
    arrow = {"arrowstyle": "-|>", "color": _TEXT, "lw": 1.2}
    axes.annotate("", (left + 2.0, top), (left + 2.0, top - 14.0), arrowprops=arrow)
    axes.text(left + 2.0, top - 15.0, "N", fontsize=9, weight="bold", ha="center", va="top", color=_TEXT)


def _ribbon(points: np.ndarray, width: float = LANE_M) -> np.ndarray:
    """Outline ``[2n, 2]`` of a lane of ``width`` m around the line ``points`` ``[n, 2]``."""
    direction = np.gradient(points, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1) * width / 2.0
    return np.concatenate([points + normal, (points - normal)[::-1]])


def _frame(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """End of a lane, its direction of travel, and the direction to its right."""
    along = points[-1] - points[-2]
    along = along / max(float(np.linalg.norm(along)), 1e-9)
    return points[-1], along, np.array([along[1], -along[0]])


def _draw_arrows(axes: Axes, points: np.ndarray, turns: str) -> None:
    """Paint the lane's arrow 5 m before the stop line."""
    end, along, right = _frame(points)
    head = {"arrowstyle": "-|>", "color": _MARK, "lw": 0.9, "mutation_scale": 6, "shrinkA": 0, "shrinkB": 0}
    for turn in turns:
        stroke = np.array([end + (forward - 5.0) * along + side * right for side, forward in _ARROWS[turn]])
        axes.plot(stroke[:, 0], stroke[:, 1], color=_MARK, linewidth=1.3, zorder=4)
        last = stroke[-1] - stroke[-2]
        axes.annotate("", stroke[-1] + 0.6 * last / np.linalg.norm(last), stroke[-2], arrowprops=head, zorder=4)


def _draw_stop_line(axes: Axes, points: np.ndarray) -> None:
    end, _, right = _frame(points)
    ends = np.array([end - 0.46 * LANE_M * right, end + 0.46 * LANE_M * right])
    axes.plot(ends[:, 0], ends[:, 1], color=_MARK, linewidth=2.2, zorder=4)


def _label(axes: Axes, spec: IntersectionSpec, name: str, street: str, extent_m: float) -> None:
    leg = spec.leg(name)
    out = np.array([math.sin(math.radians(leg.bearing_deg)), math.cos(math.radians(leg.bearing_deg))])
    lines = [street] if street else []
    if leg.approach is None:
        lines.append("leads away only")
    else:
        approach = leg.approach
        lines.append(
            f"{approach.length_m:.0f} m, {approach.speed_limit_mps:.1f} m/s, {100 * approach.grade + 0.0:+.1f} %"
        )
        lines.append(f"{approach.aadt_per_lane:,.0f} veh/day per lane")
    if leg.exit_lanes == 0:
        lines.append("leads in only")
    x, y = out * (extent_m + 3.0)
    across = "left" if out[0] > 0.35 else "right" if out[0] < -0.35 else "center"
    up = "bottom" if out[1] > 0.35 else "top" if out[1] < -0.35 else "center"
    axes.text(x, y, "\n".join(lines), fontsize=8, ha=across, va=up, color=_TEXT, linespacing=1.25)
    x, y = out * (extent_m - 7.0)
    badge = {"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": _TEXT, "linewidth": 0.8}
    axes.text(x, y, name, fontsize=12, weight="bold", ha="center", va="center", color=_TEXT, bbox=badge, zorder=6)


def _draw_plan(axes: Axes, plan: SignalPlan, colours: Mapping[tuple[str, str], str]) -> None:
    """Bars of green, yellow and right on red over the cycle, one row per movement."""
    movements = sorted(colours)
    begin = 0.0
    for phase in plan.phases:
        for row, movement in enumerate(movements):
            colour = _colour(phase.states, movement)
            if colour in _BARS:
                height, alpha, fixed = _BARS[colour]
                axes.barh(
                    row, phase.duration_s, left=begin, height=height, alpha=alpha, color=fixed or colours[movement]
                )
        begin += phase.duration_s
        axes.axvline(begin, color="#dddddd", linewidth=0.7, zorder=0)
    axes.set_yticks(range(len(movements)), [f"{origin} to {to}" for origin, to in movements], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0.0, plan.cycle_s)
    axes.set_xlabel("seconds of the cycle", fontsize=9)
    axes.set_title(
        "Signal plan: green (pale: permissive), yellow,\nthin grey: right turn on red", fontsize=9, loc="left"
    )
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _histogram(axes: Axes, values: np.ndarray, width: float | None) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    bins: int | list[float] = 20
    if width is not None:
        bins = np.arange(values.min() - width / 2.0, values.max() + width, width).tolist()
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.hist(values, bins=bins, weights=np.full(values.size, 1.0 / values.size), color=GROUP_COLOURS[0], rwidth=0.92)


def save_png(figure: Figure, path: Path | str) -> Path:
    """Write a picture, whole or not at all; return its path."""
    path = expanded(path)
    if path.suffix.lower() != ".png":
        raise IzooError(f"pictures are written as PNG; {path} must end in .png.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        FigureCanvasAgg(figure).print_figure(partial, dpi=_DPI, facecolor="white", format="png")
    return path


class Drawn(NamedTuple):
    """A line ``[n, 2]`` in the direction of travel: a lane, with its turns if it ends at the stop line, or a way from
    one leg to another."""

    points: np.ndarray
    turns: str = ""
    origin: str = ""
    exit: str = ""


class Layout(NamedTuple):
    """All there is to draw, up to ``extent_m`` from the middle."""

    lanes: list[Drawn]
    movements: list[Drawn]
    extent_m: float


def layout_of(road: RoadNet, spec: IntersectionSpec) -> Layout:
    """Lay out a net: the shapes of its lanes around the middle of its junction."""
    place, shapes = road.lane_location, [shape[:, :2] for shape in road.shapes]
    ways = [(k, shapes[k], int(road.lane_exit[k])) for k in np.flatnonzero(place == INSIDE)]
    for k, q in np.argwhere(road.next_lane >= 0):
        onward = road.next_lane[k, q]
        if place[k] == APPROACHING and place[onward] == LEAVING:  # a net without lanes inside its junction
            ways.append((k, np.array([shapes[k][-1], shapes[onward][0]]), int(q)))
    junction = np.concatenate([points for _, points, _ in ways])
    middle = (junction.min(axis=0) + junction.max(axis=0)) / 2.0
    lanes = [
        Drawn(shapes[k] - middle, "" if place[k] == LEAVING else _turns_at_stop(road, spec, int(k)))
        for k in np.flatnonzero(place != INSIDE)
    ]
    movements = [
        Drawn(points - middle, "", road.approaches[road.lane_approach[k]], road.exits[q]) for k, points, q in ways
    ]
    return Layout(lanes, movements, float(np.abs(junction - middle).max()) + REACH_M)


def _turns_at_stop(road: RoadNet, spec: IntersectionSpec, lane: int) -> str:
    """Turns of an approach lane that ends at the stop line, otherwise an empty string."""
    leg = road.approaches[road.lane_approach[lane]]
    approach = spec.leg(leg).approach
    edge = road.lane_ids[lane].rsplit("_", 1)[0]
    if approach is None or edge != road.incoming_edges[road.approaches.index(leg)][-1]:
        return ""
    return approach.lanes[int(road.lane_index[lane])]
