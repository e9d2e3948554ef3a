"""Adds heights to a flat net, so that every lane has exactly the grade of its leg.

``netconvert`` lays junctions flat and draws lanes from rim to rim, which makes lanes steeper than the road that was
asked for. Lengths of lanes are known only afterwards; hence heights are added to its result.
"""

from __future__ import annotations

import re

import numpy as np

from izoo.contexts.spec import IntersectionSpec
from izoo.networks.road import run_m

_SHAPE = re.compile(r'<lane id="([^"]+)_\d+" [^>]*?shape="([^"]+)"')
_LEG_EDGE = re.compile(
    r"(?P<main>[A-F])2TL|(?P<pocket>[A-F])2TL_intern|:(?P<joint>[A-F])_intern_\d+|TL2(?P<exit>[A-F])"
    r"|:(?P<ghost>[A-F])[AB]?_\d+|(?P<source>[A-F])[AB]2[A-F]|(?P<gate>[A-F])2[A-F][AB]"
)


def add_heights(text: str, spec: IntersectionSpec) -> str:
    """Return the net ``text`` with heights in its lane shapes.

    The main signal lies at 0 m and is flat. Approach, pocket part and exit of a leg rise by its grade towards the
    signal; the ghost junction and all beyond it are flat at the height of the approach's beginning.
    """
    grades = {leg.name: leg.approach.grade for leg in spec.legs if leg.approach is not None}
    if not any(grades.values()):
        return text
    runs = {edge: run_m(_points(shape)) for edge, shape in _SHAPE.findall(text)}
    pocket = {leg: runs.get(f"{leg}2TL_intern", 0.0) for leg in grades}
    before = {leg: pocket[leg] + runs.get(f":{leg}_intern_0", 0.0) for leg in grades}
    beyond = {"pocket": dict.fromkeys(grades, 0.0), "joint": pocket, "main": before}

    def lift(match: re.Match[str]) -> str:
        edge, shape = match.groups()
        place = _LEG_EDGE.fullmatch(edge)
        kind = place.lastgroup if place else None
        if place is None or kind is None:
            return match.group(0)
        leg = place.group(kind)
        if leg not in grades:
            return match.group(0)
        points = _points(shape)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        if kind == "exit":
            to_signal = along
        elif kind in beyond:
            to_signal = beyond[kind][leg] + along[-1] - along
        else:
            to_signal = np.full(len(along), runs[f"{leg}2TL"] + beyond["main"][leg])
        heights = -grades[leg] * to_signal
        lifted = " ".join(f"{x:.6f},{y:.6f},{z:.6f}" for (x, y), z in zip(points, heights, strict=True))
        return match.group(0)[: match.start(2) - match.start(0)] + lifted + '"'

    return _SHAPE.sub(lift, text)


def _points(shape: str) -> np.ndarray:
    return np.array([[float(value) for value in point.split(",")[:2]] for point in shape.split()])
