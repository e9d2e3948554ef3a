"""Where traffic drives on the left: rough outlines, true to some ten kilometres at the borders on land."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Side = Literal["left", "right"]
SIDES: tuple[Side, ...] = ("left", "right")
_Outline = tuple[tuple[float, float], ...]


def _box(west: float, south: float, east: float, north: float) -> _Outline:
    return (west, south), (east, south), (east, north), (west, north)


def _boxes(corners: str) -> tuple[_Outline, ...]:
    return tuple(_box(*map(float, box.split(","))) for box in corners.split())


def _outline(points: str) -> _Outline:
    pairs = (point.split(",") for point in points.split())
    return tuple((float(lon), float(lat)) for lon, lat in pairs)


LEFT: dict[str, Sequence[_Outline]] = {
    "Great Britain and Ireland": (
        _outline("-11,51 -6.6,49.7 -1.5,50.3 0.5,50.5 1.4,51 2.2,51.5 2.2,53 0,61.2 -4,61.2 -14,57.5"),
        _box(-2.75, 49.1, -2.0, 49.75),
    ),
    "Malta": (_box(14.1, 35.75, 14.6, 36.1),),
    "Cyprus": (_box(32.2, 34.5, 34.65, 35.75),),
    "Japan": (
        _outline(
            "122.8,24 132,24 143,24 146.2,43.2 145.4,43.6 145.3,44.4 141.9,45.65 140.5,45.6 138.5,42 135.5,37.5 "
            "131.5,36.5 129.3,34.8 128.5,34 127.9,33.2 127.5,30 122.8,24.9"
        ),
    ),
    "Hong Kong": (
        _outline(
            "113.82,22.13 113.82,22.35 113.93,22.44 114.03,22.5 114.1,22.525 114.16,22.55 114.5,22.55 114.5,22.13"
        ),
    ),
    "Macau": (_box(113.528, 22.105, 113.602, 22.214),),
    "South Asia": (
        _outline(
            "61.6,24.5 61.8,26.2 63.3,27.2 62.8,28.3 60.9,29.8 66.3,29.9 66.42,30.9 67.7,31.4 69.3,31.9 69.3,33.1 "
            "70.3,33.4 69.9,34 71.1,34.15 71.6,36.4 74.9,37.1 77.8,35.5 79,34.5 78.9,33.3 79.5,32.5 78.7,31.3 81,30.2 "
            "84.2,28.9 86,28 88.1,27.9 88.8,28.05 89,27.4 90,28.2 91.7,27.9 94,29.2 96.2,29.4 97.3,28.3 97.1,27.7 "
            "95.2,26.5 94.7,25.5 94.3,24.24 93.4,24 93.3,23 93.1,22 92.6,21.9 92.33,20.8 92,20 83,13 82.5,5 74.5,-1 "
            "72,-1 66,8"
        ),
    ),
    "Thailand, Malaysia and Singapore": (
        _outline(
            "97.5,9.5 98.6,9.97 99.6,11.8 99.1,13.8 98.2,15.2 98.54,16.7 97.8,17.7 97.35,18.5 97.8,19.5 98.9,19.8 "
            "99.88,20.44 100.1,20.35 100.6,20.2 100.5,19.5 101.3,19.5 101,18.4 101.2,17.5 102.1,18.2 102.6,17.93 "
            "103.2,18.35 104,18.3 104.7,17.4 104.74,16.55 105.6,15.7 105.5,14.4 103,14.3 102.4,13.6 102.9,11.7 "
            "102.5,9.5 105.5,5 105.5,1 97,4"
        ),
    ),
    "Indonesia, Brunei, Timor and New Guinea": (
        _outline(
            "94.5,6.3 94.5,-2 104,-11.5 156,-12 160,-3 140,0.5 128,5 119.3,4.4 119.4,5.4 117,7.5 109,5 103,1.5 98,6.3"
        ),
    ),
    "Australia": (_box(112.0, -44.5, 154.5, -9.0),),
    "New Zealand": (_box(166.0, -47.5, 179.5, -34.0),),
    "islands of the South Pacific": _boxes(
        "155.5,-12.3,168,-6.5 176.8,-19.5,180,-12 -172.9,-14.1,-171.3,-13.4 -176.3,-22,-173.6,-15.5 -161,-22,-157,-18"
    ),
    "southern and eastern Africa": (
        _outline(
            "41.6,-1.7 41,-0.9 41,2.9 41.9,3.95 39.06,3.53 38.1,3.6 36.9,4.45 35.9,4.6 34,4.2 33.5,3.75 31.8,3.8 "
            "30.9,3.5 31.3,2.15 29.75,0.15 29.6,-1.38 30.45,-1.08 30.9,-2.3 30.5,-2.4 30.8,-3.3 30,-4.4 29.4,-4.45 "
            "29.3,-6 30.5,-8.2 28.7,-8.6 28.4,-9.2 28.6,-10.5 28.45,-11.6 29,-12.4 29.8,-12.2 29.8,-13.45 29,-13.4 "
            "28.65,-12.85 28.4,-12.55 27.8,-12.28 27.2,-11.75 25.4,-11.7 24.3,-11 24,-10.9 24,-13 22,-13 22,-16.2 "
            "23.4,-17.6 21.4,-17.9 18.5,-17.4 14.2,-17.4 13.5,-17 11.7,-17.25 10,-30 17,-36 28,-36 36,-27 41.5,-15 "
            "41.5,-8"
        ),
        _box(56.5, -21.0, 64.0, -19.0),
        _box(46.0, -10.5, 56.5, -3.5),
    ),
    "the Bahamas": (
        _outline("-79.5,27.5 -79.5,23.9 -77.5,22.6 -75,21.4 -74,20.85 -71,20.85 -71,22.2 -72.6,24.5 -77,27.5"),
    ),
    "islands of the Caribbean, and Bermuda": _boxes(
        "-78.5,17.6,-76.1,18.6 -81.5,19.2,-79.7,19.8 -65.1,17.6,-64.25,18.8 -63.2,18.14,-62.9,18.3 "
        "-62.9,17.05,-62.5,17.45 -62,16.9,-61.6,17.8 -62.25,16.65,-62.1,16.85 -61.5,15.2,-61.2,15.65 "
        "-61.1,13.68,-60.85,14.13 -61.5,12.5,-61.1,13.4 -61.85,11.95,-61.35,12.6 -59.7,13,-59.4,13.4 "
        "-61.85,10,-60.4,11.4 -65,32.2,-64.6,32.45"
    ),
    "Guyana and Suriname": (
        _outline(
            "-60,8.6 -59.8,8.3 -60.7,7.6 -60.4,7.1 -61.4,6 -60.75,5.2 -60,5 -59.9,4.5 -59.82,3.37 -59.9,2.4 -59.3,1.4 "
            "-57,1.9 -54.6,2.3 -54.2,3.2 -54.45,4.3 -54.45,5.2 -54.04,5.5 -54,6.3 -57,6.6"
        ),
    ),
    "the Falkland Islands": (_box(-61.5, -52.5, -57.5, -51.0),),
}
"""Outlines ``(longitude, latitude)`` in degrees by the name of the region."""


def left_hand_region(lon: float, lat: float) -> str | None:
    """Return the region where traffic drives on the left that holds a place, or ``None``."""
    return next((name for name, outlines in LEFT.items() if any(_inside(lon, lat, o) for o in outlines)), None)


def _inside(lon: float, lat: float, outline: _Outline) -> bool:
    inside = False
    for (x0, y0), (x1, y1) in zip(outline, (*outline[1:], outline[0]), strict=True):
        if (y0 > lat) != (y1 > lat) and lon < x0 + (lat - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside
