"""Two optional tables for an OpenStreetMap extract: heights from an elevation raster, and traffic counts."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.osm.csv_tables import number, read_rows
from izoo.networks.osm.streets import StreetMap, Way

_LONLAT = "EPSG:4326"


class Elevation:
    """Heights in m from a raster that rasterio reads (GeoTIFF and others), interpolated between its pixels.

    Args:
        path: the raster; its first band holds heights in m. A raster that names no coordinate system must be in
            degrees.
    """

    def __init__(self, path: Path | str) -> None:
        path = expanded(path)
        if not path.is_file():
            raise IzooError(f"the elevation raster {path} does not exist; give the path of a GeoTIFF.")
        rasterio = _rasterio()
        try:
            with _own_projections(), rasterio.open(path) as raster:
                self._heights = raster.read(1, masked=True).astype(float).filled(np.nan)
                self._inverse = (~raster.transform)[:6]
                self._crs = raster.crs
                bounds = raster.bounds
        except rasterio.errors.RasterioError as error:
            raise IzooError(f"{path} cannot be read as an elevation raster ({error}); give a GeoTIFF.") from error
        if self._crs is None and not (-180.0 <= bounds.left < bounds.right <= 180.0 and abs(bounds.top) <= 90.0):
            raise IzooError(f"{path} names no coordinate system; give a GeoTIFF with one.")

    def at(self, lonlat: tuple[float, float]) -> float:
        """Height in m at a place in degrees; NaN outside the raster and where it has no data."""
        x, y = lonlat
        if self._crs is not None:
            with _own_projections():
                xs, ys = _rasterio().warp.transform(_LONLAT, self._crs, [x], [y])
            x, y = xs[0], ys[0]
        a, b, c, d, e, f = self._inverse
        column, row = a * x + b * y + c, d * x + e * y + f
        return self._bilinear(row - 0.5, column - 0.5)

    def _bilinear(self, row: float, column: float) -> float:
        rows, columns = self._heights.shape
        if not (-0.5 <= row <= rows - 0.5 and -0.5 <= column <= columns - 0.5):
            return math.nan
        row, column = min(max(row, 0.0), rows - 1.0), min(max(column, 0.0), columns - 1.0)
        i, j = min(int(row), max(rows - 2, 0)), min(int(column), max(columns - 2, 0))
        patch = self._heights[i : i + 2, j : j + 2]
        down, right = np.array([1.0 - (row - i), row - i]), np.array([1.0 - (column - j), column - j])
        return float(down[: patch.shape[0]] @ patch @ right[: patch.shape[1]])


@dataclass(frozen=True)
class TrafficCounts:
    """Annual average daily traffic in veh/day by way id and by street name (lower case).

    A value by id is that of the way: of both directions for a two-way one. A value by name is that of the street: of
    both directions where traffic runs both ways.
    """

    by_way: Mapping[int, float] = field(default_factory=dict)
    by_name: Mapping[str, float] = field(default_factory=dict)

    def directional(self, ways: list[Way], *, both_ways: bool) -> float | None:
        """AADT of the arriving direction; ``None`` where the table says nothing.

        Args:
            ways: the approach's ways, nearest to the stop line first.
            both_ways: whether the leg also has outgoing lanes.
        """
        for way in ways:
            if way.id in self.by_way:
                return self.by_way[way.id] / (1.0 if way.oneway else 2.0)
        for way in ways:
            if way.name.lower() in self.by_name:
                return self.by_name[way.name.lower()] / (2.0 if both_ways else 1.0)
        return None


def read_counts(path: Path | str, streets: StreetMap) -> TrafficCounts:
    """Read a CSV table with the columns ``way`` (OpenStreetMap id) or ``name`` (street), and ``aadt`` (veh/day).

    Raises:
        IzooError: the file is missing, lacks the columns, holds something that is not a count, contradicts itself, or
            names a way or street that the extract does not have.
    """
    by_way: dict[int, float] = {}
    by_name: dict[str, float] = {}
    names = {way.name.lower() for way in streets.ways.values() if way.name}
    unknown: list[str] = []
    for place, row in read_rows(path, "the AADT table", ("aadt",), ("way", "name")):
        value = number(row["aadt"], 1e6, "AADT", "vehicles per day", place)
        way, name = row["way"], row["name"]
        if not way and not name:
            raise IzooError(f"{place}: a way id or a street name is missing.")
        if way and not way.removeprefix("-").isdecimal():  # editors number what is new below zero
            raise IzooError(f"{place}: {way!r} is not the id of a way; put street names in the column name.")
        known = int(way) in streets.ways if way else name.lower() in names
        if not known:
            unknown.append(way or name)
        elif way:
            _put(by_way, int(way), value, place)
        else:
            _put(by_name, name.lower(), value, place)
    if unknown:
        raise IzooError(
            f"{path} names {len(unknown)} ways that are not drivable streets of the extract "
            f"({', '.join(unknown[:5])}); correct or remove those lines."
        )
    return TrafficCounts(by_way, by_name)


def _put(table: dict[Any, float], key: Any, value: float, place: str) -> None:
    if table.setdefault(key, value) != value:
        raise IzooError(f"{place}: {key} has two different values, {table[key]:g} and {value:g}; keep one line.")


@contextlib.contextmanager
def _own_projections() -> Iterator[None]:
    """Let rasterio use its own table of projections: importing SUMO points it to one that it cannot read."""
    set_by_sumo = {
        name: os.environ.pop(name)
        for name in ("PROJ_DATA", "PROJ_LIB")
        if Path(os.environ.get(name, "")).parts[-3:] == ("sumo", "data", "proj")
    }
    try:
        with _rasterio().Env():
            yield
    finally:
        os.environ.update(set_by_sumo)


def _rasterio() -> Any:
    try:
        importlib.import_module("rasterio.warp")
        return importlib.import_module("rasterio")
    except ImportError as error:
        raise IzooError("elevation needs the package rasterio; install it with: pip install 'izoo[osm]'") from error
