"""The vehicle classes of the MOVES surrogates, as a stable integer index, and MOVES default tables."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from izoo.errors import IzooError

MODEL_YEARS = tuple(range(2009, 2020))
MOTORCYCLE, PASSENGER_CAR, PASSENGER_TRUCK, LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS = 11, 21, 31, 32, 42
SOURCE_TYPES = (MOTORCYCLE, PASSENGER_CAR, PASSENGER_TRUCK, LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS)
GASOLINE, DIESEL = 1, 2
FUELS = (GASOLINE, DIESEL)

CLASSES: tuple[tuple[int, int, int], ...] = tuple(
    (year, source_type, fuel)
    for year in MODEL_YEARS
    for source_type in SOURCE_TYPES
    for fuel in FUELS
    if (source_type, fuel) != (MOTORCYCLE, DIESEL)
)
"""The 99 triples ``(model_year, source_type, fuel)`` in ascending order; a class is its place in this table."""

_INDEX = np.full((len(MODEL_YEARS), max(SOURCE_TYPES) + 1, max(FUELS) + 1), -1, dtype=np.int64)
for _row, (_year, _source_type, _fuel) in enumerate(CLASSES):
    _INDEX[_year - MODEL_YEARS[0], _source_type, _fuel] = _row


def moves_class_index(model_year: ArrayLike, source_type: ArrayLike, fuel: ArrayLike) -> Any:
    """Return the index into :data:`CLASSES`, an int64 of the arguments' broadcast shape.

    Args:
        model_year: 2009 to 2019.
        source_type: MOVES source type: 11, 21, 31, 32 or 42.
        fuel: MOVES fuel type: 1 gasoline, 2 diesel.

    Raises:
        IzooError: there is no surrogate for one of the combinations.
    """
    year, source, fuel = np.broadcast_arrays(np.asarray(model_year), np.asarray(source_type), np.asarray(fuel))
    row = year - MODEL_YEARS[0]
    inside = (row >= 0) & (row < _INDEX.shape[0])
    inside &= (source >= 0) & (source < _INDEX.shape[1]) & (fuel >= 0) & (fuel < _INDEX.shape[2])
    index = np.where(
        inside, _INDEX[np.where(inside, row, 0), np.where(inside, source, 0), np.where(inside, fuel, 0)], -1
    )
    if (index < 0).any():
        first = tuple(np.argwhere(index < 0)[0])
        raise IzooError(
            f"no MOVES surrogate for model year {year[first]}, source type {source[first]}, fuel {fuel[first]}; "
            f"model years are {MODEL_YEARS[0]} to {MODEL_YEARS[-1]}, source types {SOURCE_TYPES}, fuels {FUELS} "
            "(no diesel motorcycles)."
        )
    return index[()]


DATA = Path(__file__).parent / "data"


def read_moves_table(name: str) -> list[dict[str, str]]:
    """Return the rows of ``data/<name>.csv``; values are strings as in the file."""
    with (DATA / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
