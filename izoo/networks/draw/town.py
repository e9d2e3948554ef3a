"""A map of intersections at their places, as PNG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from izoo.contexts.context import Context
from izoo.contexts.spec import IntersectionSpec

METRES_PER_DEGREE = 111_320.0
ATTRIBUTION = "Contains information from OpenStreetMap (ODbL 1.0)"
_STREET, _TEXT, _CIRCLE = "#b4b8bd", "#222222", "#0072b2"
_LARGEST_PT2 = 500.0
"""Area of the circle with the largest volume."""
LONGEST_LEG_M = 150.0
"""No more of a leg is drawn."""


def peak_volume_vph(spec: IntersectionSpec) -> float:
    """Return what comes to an intersection in the peak hour, as played."""
    context = Context(spec, temperature_c=20.0, humidity_pct=50.0)
    return sum(context.flow_vph_per_lane(leg.name) * leg.approach.main_lane_count for leg in spec.legs if leg.approach)


def places_m(specs: Sequence[IntersectionSpec]) -> np.ndarray:
    """Return metres east and north of the middle of the town, ``[N, 2]``; every spec has its ``lonlat``."""
    degrees = np.array([spec.lonlat for spec in specs], float)
    middle = degrees.mean(0)
    return (degrees - middle) * METRES_PER_DEGREE * [math.cos(math.radians(middle[1])), 1.0]


def draw_town(
    specs: Sequence[IntersectionSpec],
    title: str,
    words: Mapping[str, str] | None = None,
    colours: Mapping[str, str] | None = None,
    legend: Mapping[str, str] | None = None,
) -> Figure:
    """Return a map: a circle per intersection, as large as its peak volume, and its legs as wide as their lanes.

    Args:
        specs: with their ``lonlat``; one or more.
        title: of the map.
        words: beneath each intersection's name; without them, its volume.
        colours: of the circles, by intersection.
        legend: what the colours mean.
    """
    figure = Figure(figsize=(9.0, 7.6), facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    volumes = {spec.name: peak_volume_vph(spec) for spec in specs}
    most = max(max(volumes.values()), 1.0)
    for spec, (x, y) in zip(specs, places_m(specs), strict=True):
        for leg in spec.legs:
            length_m = min(leg.approach.length_m if leg.approach else leg.exit_length_m, LONGEST_LEG_M)
            lanes = (leg.approach.lane_count if leg.approach else 0) + leg.exit_lanes
            east, north = (f(math.radians(leg.bearing_deg)) for f in (math.sin, math.cos))
            ends = [x, x + length_m * east], [y, y + length_m * north]
            axes.plot(*ends, color=_STREET, linewidth=0.8 * lanes, solid_capstyle="round", zorder=1)
        area, colour = _LARGEST_PT2 * volumes[spec.name] / most, (colours or {}).get(spec.name, _CIRCLE)
        axes.scatter(x, y, s=max(area, 20.0), color=colour, edgecolors="white", zorder=2)
        word = (words or {}).get(spec.name, f"{volumes[spec.name]:,.0f} veh/h")
        text = f"{spec.name.rpartition('/')[2]}\n{word}"
        style: dict[str, Any] = {"fontsize": 8, "color": _TEXT, "va": "bottom", "parse_math": False, "zorder": 3}
        away = 2.0 + 0.4 * math.sqrt(area)
        axes.annotate(text, (x, y), (away, away), textcoords="offset points", **style)
    for label, colour in (legend or {}).items():
        axes.scatter([], [], color=colour, label=label)
    if legend:
        axes.legend(frameon=False, fontsize=8, ncols=len(legend), loc="upper center", bbox_to_anchor=(0.5, -0.06))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("m east", fontsize=9)
    axes.set_ylabel("m north", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(title, fontsize=12, color=_TEXT, parse_math=False)
    figure.text(0.995, 0.005, ATTRIBUTION, ha="right", fontsize=7, color="#555555")
    return figure
