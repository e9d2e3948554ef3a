"""Statistics against rliable 1.2.0 (numbers computed with it once), by hand, and where they give no interval."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from izoo.errors import IzooError
from izoo.metrics.benefit import ratio_of_sums
from izoo.metrics.statistics import (
    MIN_INTERSECTIONS,
    MIN_TRAIN_SEEDS,
    PLACES,
    PLACES_AND_SEEDS,
    estimate,
    improvement,
    iqm,
    mean,
    paired_saving,
    performance_profile,
    share_positive,
)
from izoo.metrics.student import student_t_below, student_t_quantile

GENERATOR = np.random.default_rng(0)
X = np.round(GENERATOR.normal(size=(4, 11)), 3)
Y = np.round(GENERATOR.normal(0.3, 1, size=(5, 11)), 3)
PLACES_OF_X = [f"x/{k}" for k in range(11)]


def test_probability_of_improvement_equals_rliable() -> None:
    assert improvement(X, Y, PLACES_OF_X).value == pytest.approx(0.35227273, abs=1e-8)
    assert improvement(X, X, PLACES_OF_X).value == 0.5


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 101])
def test_iqm_is_the_mean_of_the_sorted_middle(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    cut = int(0.25 * count)
    assert iqm(values) == pytest.approx(np.sort(values)[cut : count - cut].mean())


def test_iqm_ignores_one_wild_value() -> None:
    assert iqm(np.array([1.0, 1.0, 1.0, 1e9])) == 1.0


def test_of_one_seed_and_single_approaches_it_is_the_interval_of_every_textbook() -> None:
    found = estimate(X[:1], mean, PLACES_OF_X)
    half = 2.228 * X[0].std(ddof=1) / math.sqrt(11)  # t at 97.5 %, ten degrees of freedom
    assert (found.low, found.high) == pytest.approx((X[0].mean() - half, X[0].mean() + half), abs=1e-3)
    assert (found.n, found.groups, found.seeds, found.over, found.missing) == (11, 11, 1, PLACES, "")


def test_a_figure_is_the_mean_over_training_seeds_of_each_ones_figure() -> None:
    assert estimate(X, iqm, PLACES_OF_X).value == pytest.approx(np.mean([iqm(x) for x in X]))


def test_training_seeds_widen_the_interval_by_what_they_differ() -> None:
    shifted = X + np.array([[-1.0], [1.0], [-2.0], [2.0]])
    near, far = estimate(X, mean, PLACES_OF_X), estimate(shifted, mean, PLACES_OF_X)
    assert near.over == far.over == PLACES_AND_SEEDS
    assert far.value == pytest.approx(near.value)
    # Four seeds with this spread alone: t at three degrees of freedom times their standard error.
    alone = 3.182 * shifted.mean(axis=1).std(ddof=1) / 2.0
    assert alone < far.high - far.value < 1.15 * alone


def test_below_four_training_seeds_the_interval_says_what_it_leaves_out() -> None:
    shifted = X[:3] + np.array([[-5.0], [0.0], [5.0]])
    found = estimate(shifted, mean, PLACES_OF_X)
    assert found.over == PLACES
    assert f"needs {MIN_TRAIN_SEEDS}" in found.missing
    assert found.high - found.low == pytest.approx(estimate(X[:3], mean, PLACES_OF_X).high * 2 - X[:3].mean() * 2)


def test_below_six_intersections_there_is_none_and_it_says_why() -> None:
    few = [f"x/{k % (MIN_INTERSECTIONS - 1)}" for k in range(11)]
    for found in (estimate(X, mean, few), improvement(X, Y, few), estimate(X, share_positive, few, share=True)):
        assert math.isnan(found.low) and math.isnan(found.high) and found.over == ""
        assert found.missing == "no interval: 5 intersections, and one needs 6"
        assert not math.isnan(found.value)


def test_approaches_of_an_intersection_are_left_out_together() -> None:
    values = np.repeat(np.random.default_rng(4).normal(size=20), 4)[None]
    alone, together = estimate(values, mean, list(range(80))), estimate(values, mean, [k // 4 for k in range(80)])
    assert together.high - together.low > 1.8 * (alone.high - alone.low)
    assert (together.n, together.groups, alone.groups) == (80, 20, 80)


def test_a_share_of_none_or_all_still_has_an_interval() -> None:
    none = estimate(np.zeros((1, 20)), mean, list(range(20)), share=True)
    assert (none.value, none.low) == (0.0, 0.0)
    assert 0.1 < none.high < 0.25  # Wilson: t^2 / (n + t^2)
    everyone = estimate(np.ones((1, 20)), mean, list(range(20)), share=True)
    assert everyone.low == pytest.approx(1.0 - none.high) and everyone.high == pytest.approx(1.0)


@pytest.mark.parametrize("value", [0.0, 0.1, -0.3])
@pytest.mark.parametrize("seeds", [1, 4])
def test_a_figure_that_no_intersection_changes_has_no_interval(value: float, seeds: int) -> None:
    """As where the gate is closed on every approach: "0.0 [0.0, 0.0]" would claim certainty."""
    scores = np.full((seeds, 20), value)
    few = np.where(np.arange(20) == 7, 0.4, scores)  # one in twenty moves a mean, and not an interquartile mean
    for found in (estimate(scores, mean, list(range(20))), estimate(few, iqm, list(range(20)))):
        assert found.value == pytest.approx(value)
        assert math.isnan(found.low) and math.isnan(found.high) and found.over == ""
        assert found.missing == "no interval: the same figure without any of its 20 intersections"
    assert estimate(few, mean, list(range(20))).low < float(few.mean())
    same = paired_saving(np.full(5, 90.0), np.full(5, 100.0))
    assert same.value == pytest.approx(0.1) and math.isnan(same.low)
    assert same.missing == "no interval: the same ratio in each of 5 episodes"


def test_sums_of_several_numbers_per_approach() -> None:
    pairs = np.random.default_rng(1).uniform(50.0, 150.0, (2, 12, 2))
    found = estimate(pairs, ratio_of_sums, list(range(12)))
    each = [1.0 - seed[:, 0].sum() / seed[:, 1].sum() for seed in pairs]
    assert found.value == pytest.approx(np.mean(each))
    assert found.low < found.value < found.high


def test_the_same_numbers_give_the_same_interval_in_any_order() -> None:
    order = np.random.default_rng(0).permutation(11)
    first = estimate(X, iqm, PLACES_OF_X)
    second = estimate(X[::-1, order], iqm, [PLACES_OF_X[k] for k in order])
    assert (first.value, first.low, first.high) == pytest.approx((second.value, second.low, second.high))


def test_a_saving_keeps_its_pairs() -> None:
    baseline = np.array([100.0, 140.0, 90.0, 180.0])
    found = paired_saving(0.9 * baseline + np.array([0.01, -0.01, 0.01, -0.01]), baseline)
    assert (found.value, found.low, found.high) == pytest.approx((0.1, 0.1, 0.1), abs=3e-4)
    few = paired_saving(0.9 * baseline[:2], baseline[:2])
    assert few.value == pytest.approx(0.1) and math.isnan(few.low)
    assert few.missing == "no interval: 2 episode seeds, and one needs 3"
    assert math.isnan(paired_saving(baseline, 0.0 * baseline).value)


def test_no_observations_are_reported_as_none_of_them() -> None:
    for found in (estimate(np.empty((1, 0)), mean, []), improvement(np.empty((2, 0)), np.empty((1, 0)), [])):
        assert found.n == 0 and math.isnan(found.value)
        assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["value"] is None


def test_share_and_profile() -> None:
    values = np.array([-1.0, 0.0, 0.5, 2.0])
    assert share_positive(values) == 0.5
    assert performance_profile(values, [-2.0, 0.0, 0.5, 3.0]).tolist() == [1.0, 0.5, 0.25, 0.0]


@pytest.mark.parametrize(
    ("degrees", "t", "below"),
    # Quantiles of Student's t as printed in any table (Abramowitz and Stegun, table 26.10).
    [(1, 6.314, 0.95), (2, 2.920, 0.95), (2, 4.303, 0.975), (3, 2.353, 0.95), (9, 1.833, 0.95), (30, 1.697, 0.95)],
)
def test_student_t_agrees_with_the_printed_table(degrees: int, t: float, below: float) -> None:
    assert student_t_below(t, degrees) == pytest.approx(below, abs=2e-4)
    assert student_t_below(-t, degrees) == pytest.approx(1 - below, abs=2e-4)
    assert student_t_below(0.0, degrees) == pytest.approx(0.5)
    assert student_t_quantile(below, degrees) == pytest.approx(t, abs=2e-3)


@pytest.mark.parametrize("degrees", range(1, 41))
def test_student_t_stays_a_probability(degrees: int) -> None:
    for t in (8.0, 25.0, 35.0, 1e3, 1e6):
        assert 0.0 <= student_t_below(-t, degrees) < 0.05 and 0.95 < student_t_below(t, degrees) <= 1.0


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(IzooError, match=r"\[seeds, approaches\]"):
        estimate(X[0], mean, PLACES_OF_X)
    with pytest.raises(IzooError, match="10 group labels"):
        estimate(X, mean, PLACES_OF_X[:-1])
    with pytest.raises(IzooError, match="over the same"):
        improvement(X, Y[:, :3], PLACES_OF_X)
    with pytest.raises(IzooError, match="labels"):
        improvement(X, Y, ["a"])
    with pytest.raises(IzooError, match="shapes"):
        paired_saving([1.0], [1.0, 2.0])
