"""Where traffic drives on the left: rough outlines, true to some ten kilometres at the borders on land."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from importlib import resources
from typing import Literal

Side = Literal["left", "right"]
SIDES: tuple[Side, ...] = ("left", "right")
REGIONS_FILE = "left_hand_regions.json"
"""By the name of the region, outlines of ``[longitude, latitude]`` in degrees."""


@functools.cache
def _regions() -> dict[str, list[list[list[float]]]]:
    return json.loads(resources.files(__package__).joinpath(REGIONS_FILE).read_text("utf-8"))


def left_hand_region(lon: float, lat: float) -> str | None:
    """Return the region where traffic drives on the left that holds a place, or ``None``."""
    return next((name for name, outlines in _regions().items() if any(_inside(lon, lat, o) for o in outlines)), None)


def _inside(lon: float, lat: float, outline: Sequence[Sequence[float]]) -> bool:
    inside = False
    for (x0, y0), (x1, y1) in zip(outline, (*outline[1:], outline[0]), strict=True):
        if (y0 > lat) != (y1 > lat) and lon < x0 + (lat - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside
