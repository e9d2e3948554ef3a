import dataclasses
import hashlib
import json

import numpy as np
import pytest

from izoo.contexts.cities import rebuilt as cities
from izoo.contexts.cities.compare import feature_table, total_variation
from izoo.contexts.cities.copula import FEATURES, MPH, Marginal, marginal
from izoo.contexts.cities.shapes import share_out_lanes
from izoo.contexts.movements import conflict
from izoo.errors import IzooError

# Intersection 7 of each city. A change here changes what catalogue ids mean: it must never happen by accident.
GOLDEN = {
    "atlanta": "e2d6eb9de3f0976c",
    "boston": "6376dd5457bc4415",
    "chicago": "31c2e65dbf4934b9",
    "dallas_fort_worth": "c347188155ebe1b0",
    "houston": "5c894ab6d21a9169",
    "los_angeles": "51c30def893b911c",
    "salt_lake_city": "dcb913fa2017c523",
    "new_york_manhattan": "61424ee3448e658a",
    "san_francisco": "3e28b4ee65aff59e",
    "seattle": "a53382aaf516b17a",
}


def test_sizes_are_the_published_ones():
    lengths = [len(cities.get(city)) for city in cities.CITIES]
    assert lengths == [621, 917, 2864, 1570, 1014, 4276, 282, 2586, 1209, 995]
    assert sum(lengths) == 16334


@pytest.mark.parametrize("city", cities.CITIES)
def test_golden_intersections(city):
    spec = cities.get(city)[7]
    fields = dataclasses.asdict(spec)
    assert fields.pop("lonlat") is None
    assert not any(leg["approach"].pop("exit_counts") for leg in fields["legs"] if leg["approach"])
    assert hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()[:16] == GOLDEN[city]


def test_names_are_forgiving_and_unknown_ones_are_refused():
    assert cities.get("Salt-Lake-City")[0].name == "salt_lake_city/0"
    with pytest.raises(IzooError, match="Did you mean 'seattle'"):
        cities.get("seatle")
    with pytest.raises(IndexError):
        cities.get("seattle")[995]
    assert cities.get("seattle")[-1].name == "seattle/994"


LARGE = ("los_angeles", "chicago", "new_york_manhattan", "dallas_fort_worth")


@pytest.mark.parametrize(
    "city", [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in cities.CITIES]
)
def test_marginals_are_met(city):
    distances = total_variation(feature_table(cities.get(city)), city)
    assert max(distances.values()) <= 0.05
    assert max(value for name, value in distances.items() if name != "signal_time_ratio") <= 0.01


def test_salt_lake_city_has_the_published_shape():
    specs = list(cities.get("salt_lake_city"))
    legs = np.bincount([len(spec.legs) for spec in specs], minlength=7)
    incoming = np.bincount([len(spec.approach_names) for spec in specs], minlength=6)
    assert {str(count): legs[count] for count in (3, 4, 5, 6)} == {"3": 44, "4": 231, "5": 6, "6": 1}
    assert list(incoming[2:6]) == [4, 75, 200, 3]
    assert sum(len(spec.approach_names) for spec in specs) == 1048


def test_joint_structure_of_salt_lake_city():
    table = cities.city_table("salt_lake_city")
    cross = np.flatnonzero(table.shape == 0)
    rows = table.first[cross]
    rank = np.argsort(np.argsort(table.features, axis=0, kind="stable"), axis=0)

    def correlation(name, step):
        column = rank[:, FEATURES.index(name)]
        return np.corrcoef(column[rows], column[rows + step])[0, 1]

    assert correlation("lane_count", 2) == pytest.approx(0.79, abs=0.15)
    assert correlation("speed_limit_mps", 2) == pytest.approx(0.80, abs=0.15)
    assert correlation("signal_time_ratio", 1) < -0.5


@pytest.mark.parametrize("city", ["salt_lake_city", "boston"])
def test_intersections_are_sound(city):
    for spec in cities.get(city):
        bearings = {leg.name: leg.bearing_deg for leg in spec.legs}
        exits = {leg.name for leg in spec.legs if leg.exit_lanes}
        assert (spec.city, spec.source, spec.right_on_red) == (city, "city", True)
        assert spec.signal_plan.cycle_s <= 112.0
        for phase in spec.signal_plan.phases:
            protected = [(bearings[a], bearings[b]) for a, b, colour in phase.states if colour == "G"]
            assert not any(conflict(one, two) for one in protected for two in protected if one != two)
            assert {b for _, b, _ in phase.states} <= exits
        for leg in spec.legs:
            if leg.approach is not None:
                mph = leg.approach.speed_limit_mps / MPH
                assert mph == pytest.approx(5 * round(mph / 5), abs=1e-3)
                assert 50.0 <= leg.approach.length_m <= 700.0
                assert leg.approach.aadt_per_lane > 0.0


@pytest.mark.parametrize(
    ("turns", "count", "left_phase", "chance", "lanes"),
    [
        ("rsl", 1, True, 0.0, ("rs",)),
        ("sl", 1, False, 0.0, ("sl",)),
        ("rl", 1, False, 0.0, ("rl",)),
        ("rsl", 2, False, 0.1, ("rs", "sl")),
        ("rsl", 2, True, 0.1, ("rs", "l")),
        ("rsl", 3, False, 0.9, ("rs", "s", "l")),
        ("rs", 3, False, 0.0, ("rs", "s", "s")),
        ("rl", 2, False, 0.0, ("rl", "l")),
        ("s", 2, False, 0.0, ("s", "s")),
        ("rsl", 6, False, 0.0, ("r", "s", "s", "s", "l", "l")),
    ],
)
def test_lanes(turns, count, left_phase, chance, lanes):
    assert share_out_lanes(turns, count, left_phase, chance) == lanes


def test_marginal_inverse_and_histogram_agree():
    published = marginal("atlanta", "lane_length_m")
    sample = published.at((np.arange(20000) + 0.5) / 20000)
    assert np.abs(published.histogram(sample) - published.prob).max() < 1e-3
    discrete = Marginal(np.array([0.25, 0.75]), values=np.array([1.0, 2.0]))
    assert list(discrete.at(np.array([0.0, 0.2, 0.3, 0.99]))) == [1.0, 1.0, 2.0, 2.0]
