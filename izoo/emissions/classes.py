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

_INDEX = {triple: row for row, triple in enumerate(CLASSES)}


def moves_class_index(model_year: ArrayLike, source_type: ArrayLike, fuel: ArrayLike) -> Any:
    """Return the index into :data:`CLASSES`, an int64 of the arguments' broadcast shape.

    Args:
        model_year: 2009 to 2019.
        source_type: MOVES source type: 11, 21, 31, 32 or 42.
        fuel: MOVES fuel type: 1 gasoline, 2 diesel.

    Raises:
        IzooError: there is no surrogate for one of the combinations.
    """
    try:
        return np.vectorize(lambda *triple: _INDEX[triple], otypes=[np.int64])(model_year, source_type, fuel)[()]
    except KeyError as error:
        year, source, burnt = error.args[0]
        raise IzooError(
            f"no MOVES surrogate for model year {year}, source type {source}, fuel {burnt}; model years are "
            f"{MODEL_YEARS[0]} to {MODEL_YEARS[-1]}, source types {SOURCE_TYPES}, fuels {FUELS} (no diesel "
            "motorcycles)."
        ) from None


DATA = Path(__file__).parent / "data"


def read_moves_table(name: str) -> list[dict[str, str]]:
    """Return the rows of ``data/<name>.csv``; values are strings as in the file."""
    with (DATA / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
