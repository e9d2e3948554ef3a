"""The fleet and the drivers against the published tables."""

import numpy as np
import pandas as pd
import pytest

from izoo.emissions.classes import CLASSES, DATA
from izoo.traffic.drivers import built_in_population, mean_and_factor, sample_drivers
from izoo.traffic.fleet import CLASS_SOURCE_TYPE, class_shares, lengths_m, sample_classes
from izoo.traffic.sampling import sample_traffic
from tests.traffic.worlds import Roads, make_context

YEAR, SOURCE, FUEL = np.array(CLASSES).T
TYPES = [21, 31, 32, 42]


def _table(name: str) -> pd.DataFrame:
    return pd.read_csv(DATA / f"{name}.csv")


def test_source_types_are_shared_by_their_2019_population():
    table = _table("source_type_population")
    table = table[(table.yearID == 2019) & table.sourceTypeID.isin(TYPES)].set_index("sourceTypeID")
    expected = table.sourceTypePopulation / table.sourceTypePopulation.sum()
    for source_type in TYPES:
        assert class_shares()[source_type == SOURCE].sum() == pytest.approx(expected[source_type], rel=1e-9)
    assert class_shares()[SOURCE == 11].sum() == 0.0
    assert np.count_nonzero(class_shares()) == 88


@pytest.mark.parametrize("source_type", TYPES)
def test_ages_over_ten_count_as_ten(source_type):
    table = _table("age_distribution")
    table = table[(table.yearID == 2019) & (table.sourceTypeID == source_type)]
    expected = table.ageFraction.groupby(table.ageID.clip(upper=10)).sum()
    of_type = class_shares()[source_type == SOURCE].sum()
    for age in range(11):
        share = class_shares()[(source_type == SOURCE) & (2019 - age == YEAR)].sum() / of_type
        assert share == pytest.approx(expected[age], rel=1e-6)


@pytest.mark.parametrize(("source_type", "year"), [(21, 2009), (31, 2012), (32, 2019), (42, 2013)])
def test_fuel_is_gasoline_or_diesel_renormalised(source_type, year):
    table = _table("sample_vehicle_population")
    table = table[(table.sourceTypeID == source_type) & (table.modelYearID == year) & table.fuelTypeID.isin([1, 2])]
    fuels = table.groupby("fuelTypeID").stmyFraction.sum()
    cell = (source_type == SOURCE) & (year == YEAR)
    share = class_shares()[cell & (FUEL == 2)].sum() / class_shares()[cell].sum()
    assert share == pytest.approx(fuels[2] / fuels.sum(), rel=1e-9)


def test_drawn_classes_follow_the_shares():
    drawn = np.bincount(sample_classes(np.random.default_rng(0), 200_000), minlength=len(CLASSES))
    expected = class_shares() * 200_000
    assert (drawn[expected == 0] == 0).all()
    assert (np.abs(drawn - expected) <= 5 * np.sqrt(expected) + 5).all()


def test_lengths_belong_to_the_source_types():
    np.testing.assert_array_equal(lengths_m(np.array([42, 21, 31, 32])), [12.0, 5.0, 6.0, 7.1])
    assert np.isfinite(lengths_m(CLASS_SOURCE_TYPE[np.flatnonzero(class_shares())])).all()


@pytest.mark.parametrize(("source_type", "row"), [(21, 0), (31, 0), (32, 1), (42, 1)])
def test_drivers_follow_their_log_normal(source_type, row):
    drivers = sample_drivers(np.random.default_rng(3), np.full(100_000, source_type))
    logs = np.log(drivers)
    mean, factor = mean_and_factor(built_in_population())
    covariance = (factor[row] @ factor[row].T)[1:, 1:]
    scale = np.sqrt(np.diag(covariance))
    assert (np.abs(logs.mean(axis=1) - mean[row, 1:]) < 5 * scale / np.sqrt(100_000)).all()
    assert (np.abs(np.cov(logs) - covariance) < 0.03 * np.outer(scale, scale)).all()


def test_a_drivers_draw_depends_on_its_place_and_type_alone():
    few = sample_drivers(np.random.default_rng(5), np.array([21, 32, 31]))
    many = sample_drivers(np.random.default_rng(5), np.array([42, 32, 31, 21, 21]))
    np.testing.assert_array_equal(few[:, 1:], many[:, 1:3])
    assert (few[:, 0] != many[:, 0]).all()


def test_a_fleet_of_ones_own() -> None:
    """Types by the given shares; model years and fuels within a type as ever."""
    own = (0.5, 0.0, 0.3, 0.2)
    shares, default = class_shares(own), class_shares()
    for source_type, share in zip((21, 31, 32, 42), own, strict=True):
        of_type = source_type == SOURCE
        assert shares[of_type].sum() == pytest.approx(share)
        if share:
            np.testing.assert_allclose(shares[of_type] / share, default[of_type] / default[of_type].sum())
    drawn = CLASS_SOURCE_TYPE[sample_classes(np.random.default_rng(0), 20_000, own)]
    assert not (drawn == 31).any() and (drawn == 42).mean() == pytest.approx(0.2, abs=0.01)
    context = make_context()
    road = Roads()
    assert (sample_traffic(context.replace(fleet=(0.0, 0.0, 0.0, 1.0)), road, 0, 600.0).source_type == 42).all()
    assert context.replace(fleet=None).content_hash == context.content_hash
    assert context.replace(fleet=[1, 0, 0, 0]).content_hash != context.content_hash
