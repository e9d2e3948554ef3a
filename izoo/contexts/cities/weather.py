"""Temperature and relative humidity by city and season, from MOVES' county meteorology."""

from __future__ import annotations

import functools
from types import MappingProxyType

from izoo.contexts.context import SEASONS
from izoo.emissions.classes import read_moves_table
from izoo.errors import check_choice

CITY_COUNTIES = MappingProxyType(
    {
        "atlanta": 13121,
        "boston": 25025,
        "chicago": 17031,
        "dallas_fort_worth": 48113,
        "houston": 48201,
        "los_angeles": 6037,
        "salt_lake_city": 49035,
        "new_york_manhattan": 36061,
        "san_francisco": 6075,
        "seattle": 53033,
    }
)
"""FIPS code of the county whose weather a city has."""

SEASON_MONTHS = MappingProxyType({"winter": (12, 1, 2), "spring": (3, 4, 5), "summer": (6, 7, 8), "fall": (9, 10, 11)})

WEATHER_PUBLISHED = MappingProxyType({"salt_lake_city": (20.0, 46.0), "atlanta": (22.8, 83.0)})
"""``(temperature_c, humidity_pct)`` of the published experiments, for ``weather=published``."""


@functools.cache
def weather(city: str, season: str) -> tuple[float, float]:
    """Return ``(temperature_c, humidity_pct)``: the mean of the season's monthly values of the city's county.

    Raises:
        IzooError: the city or the season is unknown.
    """
    check_choice("city", city, CITY_COUNTIES)
    check_choice("season", season, SEASONS)
    rows = [_monthly_weather()[CITY_COUNTIES[city], month] for month in SEASON_MONTHS[season]]
    fahrenheit, humidity = (sum(column) / len(rows) for column in zip(*rows, strict=True))
    return (fahrenheit - 32.0) * 5.0 / 9.0, humidity


@functools.lru_cache(maxsize=1)
def _monthly_weather() -> dict[tuple[int, int], tuple[float, float]]:
    """Return ``{(county, month): (temperature_f, humidity_pct)}`` of the cities' counties."""
    return {
        (int(row["countyID"]), int(row["monthID"])): (float(row["temperature_F"]), float(row["relHumidity_pct"]))
        for row in read_moves_table("county_meteorology")
    }
