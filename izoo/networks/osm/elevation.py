"""Heights from an elevation raster."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from izoo.errors import IzooError
from izoo.files import expanded

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
