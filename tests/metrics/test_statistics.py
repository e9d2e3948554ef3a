"""Statistics against rliable 1.2.0 (numbers computed with it once), coverage by simulation, and reproducibility."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from izoo.errors import IzooError
from izoo.metrics.benefit import ratio_of_sums
from izoo.metrics.statistics import (
    bootstrap,
    improvement_estimate,
    iqm,
    mean,
    paired_bootstrap,
    performance_profile,
    probability_of_improvement,
    relative_saving,
    share_positive,
    stratified_bootstrap,
)

GENERATOR = np.random.default_rng(0)
X = np.round(GENERATOR.normal(size=(4, 11)), 3)
Y = np.round(GENERATOR.normal(0.3, 1, size=(5, 11)), 3)


@pytest.mark.parametrize(
    # get_interval_estimates of rliable on X, 50,000 repetitions.
    ("statistic", "value", "low", "high"),
    [(mean, -0.00081818, -0.2309, 0.2252), (iqm, -0.02872727, -0.2745, 0.2406)],
)
def test_stratified_bootstrap_equals_rliable(statistic, value: float, low: float, high: float) -> None:
    result = stratified_bootstrap(X, statistic, np.random.default_rng(1), resamples=20_000)
    assert result.value == pytest.approx(value, abs=1e-8)
    assert result.low == pytest.approx(low, abs=0.01)
    assert result.high == pytest.approx(high, abs=0.01)
    assert (result.n, result.groups) == (44, 4)


def test_probability_of_improvement_equals_rliable() -> None:
    assert probability_of_improvement(X, Y) == pytest.approx(0.35227273, abs=1e-8)
    result = improvement_estimate(X, Y, np.random.default_rng(1), resamples=5000)
    assert result.low == pytest.approx(0.2455, abs=0.01)
    assert result.high == pytest.approx(0.4636, abs=0.01)
    assert probability_of_improvement(X, X) == 0.5


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 101])
def test_iqm_is_the_mean_of_the_sorted_middle(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    cut = int(0.25 * count)
    assert iqm(values) == pytest.approx(np.sort(values)[cut : count - cut].mean())


def test_iqm_ignores_one_wild_value() -> None:
    assert iqm(np.array([1.0, 1.0, 1.0, 1e9])) == 1.0


def test_same_generator_state_same_numbers() -> None:
    first, second = (bootstrap(X[0], iqm, np.random.default_rng(7)) for _ in range(2))
    assert first == second
    assert first != bootstrap(X[0], iqm, np.random.default_rng(8))


def test_coverage_of_the_mean_is_about_nominal() -> None:
    generator = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        result = bootstrap(generator.normal(size=40), mean, generator, resamples=300)
        hits += result.low <= 0.0 <= result.high
    assert 0.88 <= hits / 200 <= 0.99


def test_resampling_by_intersection_is_wider_where_approaches_agree() -> None:
    generator = np.random.default_rng(4)
    values = np.repeat(generator.normal(size=20), 4)
    groups = [f"x/{k // 4}" for k in range(80)]
    alone = bootstrap(values, mean, np.random.default_rng(0))
    together = bootstrap(values, mean, np.random.default_rng(0), groups)
    assert together.high - together.low > 1.5 * (alone.high - alone.low)
    assert (together.n, together.groups, alone.groups) == (80, 20, 80)


def test_paired_bootstrap_keeps_the_pairs() -> None:
    baseline = np.array([100.0, 140.0, 90.0, 180.0])
    result = paired_bootstrap(0.9 * baseline, baseline, relative_saving, np.random.default_rng(0))
    assert result.value == pytest.approx(0.1)
    assert result.low == pytest.approx(0.1)
    assert result.high == pytest.approx(0.1)


def test_bootstrap_of_several_numbers_per_observation() -> None:
    pairs = np.array([[50.0, 100.0], [300.0, 300.0]])
    result = bootstrap(pairs, ratio_of_sums, np.random.default_rng(0))
    assert result.value == pytest.approx(1 - 350 / 400)
    assert 0.0 <= result.low <= result.value <= result.high <= 0.5


def test_groups_of_one_are_no_groups() -> None:
    labels = [str(k) for k in range(11)]
    assert bootstrap(X[0], iqm, np.random.default_rng(0), labels) == bootstrap(X[0], iqm, np.random.default_rng(0))


def test_no_observations_are_reported_as_none_of_them() -> None:
    result = bootstrap([], mean, np.random.default_rng(0))
    assert result.n == 0
    assert math.isnan(result.value)
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["value"] is None


def test_share_and_profile() -> None:
    values = np.array([-1.0, 0.0, 0.5, 2.0])
    assert share_positive(values) == 0.5
    assert performance_profile(values, [-2.0, 0.0, 0.5, 3.0]).tolist() == [1.0, 0.5, 0.25, 0.0]


def test_wrong_shapes_are_refused() -> None:
    generator = np.random.default_rng(0)
    with pytest.raises(IzooError, match="runs, tasks"):
        stratified_bootstrap([1.0, 2.0], mean, generator)
    with pytest.raises(IzooError, match="same tasks"):
        probability_of_improvement(X, Y[:, :3])
    with pytest.raises(IzooError, match="labels"):
        bootstrap([1.0, 2.0], mean, generator, groups=["a"])
    with pytest.raises(IzooError, match="resamples"):
        bootstrap([1.0], mean, generator, resamples=0)
    with pytest.raises(IzooError, match="shapes"):
        paired_bootstrap([1.0], [1.0, 2.0], relative_saving, generator)
