"""Weather by city and season against MOVES' county meteorology."""

import itertools

import pandas as pd
import pytest

from izoo.contexts.cities.weather import CITY_COUNTIES, SEASON_MONTHS, weather
from izoo.contexts.context import SEASONS
from izoo.emissions.classes import DATA


def test_weather_is_the_mean_of_the_seasons_months():
    table = pd.read_csv(DATA / "county_meteorology.csv")
    for city, season in itertools.product(CITY_COUNTIES, SEASONS):
        rows = table[(table.countyID == CITY_COUNTIES[city]) & table.monthID.isin(SEASON_MONTHS[season])]
        assert len(rows) == 3
        expected = ((rows.temperature_F - 32.0) / 1.8).mean(), rows.relHumidity_pct.mean()
        assert weather(city, season) == pytest.approx(expected), (city, season)


def test_seasons_share_the_year_and_look_like_the_cities():
    assert sorted(month for months in SEASON_MONTHS.values() for month in months) == list(range(1, 13))
    assert set(SEASON_MONTHS) == set(SEASONS) and len(CITY_COUNTIES) == 10
    assert weather("chicago", "winter")[0] < 2.0 < weather("houston", "winter")[0]
    assert weather("salt_lake_city", "summer")[1] < weather("atlanta", "summer")[1]
