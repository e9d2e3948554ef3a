"""Which vehicles drive: source type, model year and fuel, from the MOVES default tables of calendar year 2019."""

from __future__ import annotations

import functools
from collections import defaultdict

import numpy as np

from izoo.emissions.classes import (
    CLASSES,
    FUELS,
    LIGHT_COMMERCIAL_TRUCK,
    PASSENGER_CAR,
    PASSENGER_TRUCK,
    TRANSIT_BUS,
    moves_class_index,
    read_moves_table,
)

CALENDAR_YEAR = 2019
OLDEST_AGE = 10
LENGTH_M = {PASSENGER_CAR: 5.0, PASSENGER_TRUCK: 6.0, LIGHT_COMMERCIAL_TRUCK: 7.1, TRANSIT_BUS: 12.0}
FLEET_TYPES = tuple(LENGTH_M)

CLASS_SOURCE_TYPE = np.array([source_type for _, source_type, _ in CLASSES])
"""``[99]`` source type of each MOVES class."""


@functools.lru_cache(maxsize=64)
def class_shares(fleet: tuple[float, ...] | None = None) -> np.ndarray:
    """Return the share of the fleet in each MOVES class, ``[99]`` float64, summing to 1; motorcycles have none.

    Source type by population among the four, times age (model year) by the age distribution of the type, times
    gasoline or diesel by their shares of the type's model year, renormalised.

    Args:
        fleet: shares of :data:`FLEET_TYPES` to take instead of their population.
    """
    shares = np.zeros(len(CLASSES))
    type_share = _type_shares() if fleet is None else dict(zip(FLEET_TYPES, fleet, strict=True))
    age_share, fuel_share = _age_shares(), _fuel_shares()
    for source_type in FLEET_TYPES:
        for age in range(OLDEST_AGE + 1):
            year = CALENDAR_YEAR - age
            for fuel in FUELS:
                share = type_share[source_type] * age_share[source_type, age] * fuel_share[source_type, year, fuel]
                shares[moves_class_index(year, source_type, fuel)] = share
    shares /= shares.sum()
    shares.flags.writeable = False
    return shares


def sample_classes(generator: np.random.Generator, count: int, fleet: tuple[float, ...] | None = None) -> np.ndarray:
    """Draw MOVES classes, ``[count]`` int64; a longer draw from the same state starts with the shorter one."""
    cumulative = np.cumsum(class_shares(fleet))
    cumulative /= cumulative[-1]
    return np.searchsorted(cumulative, generator.random(count), side="right")


def lengths_m(source_type: np.ndarray) -> np.ndarray:
    """Return the vehicle lengths of source types 21, 31, 32 and 42."""
    table = np.full(max(FLEET_TYPES) + 1, np.nan)
    table[list(LENGTH_M)] = list(LENGTH_M.values())
    return table[source_type]


def _type_shares() -> dict[int, float]:
    """Return ``{source_type: share of the population}``."""
    rows = read_moves_table("source_type_population")
    population = {int(row["sourceTypeID"]): float(row["sourceTypePopulation"]) for row in rows}
    total = sum(population[source_type] for source_type in FLEET_TYPES)
    return {source_type: population[source_type] / total for source_type in FLEET_TYPES}


def _age_shares() -> dict[tuple[int, int], float]:
    """Return ``{(source_type, age): share}`` for ages 0 to 10; 10 stands for everything older too."""
    shares: dict[tuple[int, int], float] = defaultdict(float)
    for row in read_moves_table("age_distribution"):
        shares[int(row["sourceTypeID"]), min(int(row["ageID"]), OLDEST_AGE)] += float(row["ageFraction"])
    return shares


def _fuel_shares() -> dict[tuple[int, int, int], float]:
    """Return ``{(source_type, model_year, fuel): share}`` among gasoline and diesel of that type and year."""
    shares: dict[tuple[int, int, int], float] = defaultdict(float)
    totals: dict[tuple[int, int], float] = defaultdict(float)
    for row in read_moves_table("sample_vehicle_population"):
        key = (int(row["sourceTypeID"]), int(row["modelYearID"]), int(row["fuelTypeID"]))
        shares[key] += float(row["stmyFraction"])
    for (source_type, year, _), share in shares.items():
        totals[source_type, year] += share
    return {key: share / totals[key[:2]] for key, share in shares.items()}
