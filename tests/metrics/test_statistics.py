"""Statistics by hand, and where they give no interval. Whether intervals hold is in ``test_coverage.py``."""

import json
import math

import numpy as np
import pytest

from izoo.errors import IzooError
from izoo.metrics import statistics as st
from izoo.metrics.statistics import difference, estimate, iqm, student_t_quantile

GENERATOR = np.random.default_rng(0)
X = GENERATOR.normal(1.0, 1.0, (4, 11))
Y = GENERATOR.normal(0.3, 1.0, (5, 11))


def test_the_interquartile_mean_cuts_a_quarter_from_each_end() -> None:
    assert iqm([1.0, 2.0, 3.0, 100.0]) == 2.5
    assert iqm([5.0]) == 5.0
    assert iqm([0.0, 1.0, 5.0]) == pytest.approx((0.25 * 0.0 + 1.0 + 0.25 * 5.0) / 1.5)
    values = np.random.default_rng(1).normal(size=(3, 40))
    assert iqm(values) == pytest.approx(np.sort(values)[:, 10:30].mean(axis=1))


def test_values_of_contexts_are_averaged_by_intersection() -> None:
    found = st.pooled([[1.0, 3.0, 5.0], [0.0, 2.0, 4.0]], ["b", "a", "b"])
    assert found.tolist() == [[3.0, 3.0], [2.0, 2.0]]


def by_leaving_out(values: np.ndarray) -> float:
    """Variance over intersections, one after the other left out."""
    count = values.shape[1]
    return (count - 1) * float(np.var([iqm(iqm(np.delete(values, k, axis=1))) for k in range(count)]))


def test_without_training_it_is_the_jackknife_of_the_interquartile_mean() -> None:
    found = estimate(X[:1])
    half = student_t_quantile(0.975, 11 // 2 - 1) * math.sqrt(by_leaving_out(X[:1]))
    assert found.value == pytest.approx(iqm(X[0]))
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half))
    assert found.over == st.INTERSECTIONS


def test_training_seeds_widen_the_interval_by_what_they_differ() -> None:
    shifted = X + np.array([[-1.0], [1.0], [-20.0], [20.0]])
    near, far = estimate(X), estimate(shifted)
    assert near.over == far.over == st.INTERSECTIONS_AND_SEEDS
    assert near.value == pytest.approx(iqm(iqm(X)))
    # Four seeds with this spread alone: t at three degrees of freedom times their standard error.
    alone = 3.182 * iqm(shifted).std(ddof=1) / 2.0
    assert alone < far.high - far.value < 1.15 * alone
    assert near.high - near.value < 0.2 * alone


def test_below_four_training_seeds_the_interval_says_what_it_leaves_out() -> None:
    found = estimate(X[:3])
    assert found.over == st.INTERSECTIONS
    half = student_t_quantile(0.975, 11 // 2 - 1) * math.sqrt(by_leaving_out(X[:3]))
    assert found.high - found.value == pytest.approx(half)


def test_a_difference_is_not_over_seeds_where_one_side_has_few() -> None:
    assert difference(X[:2], Y[:4]).over == st.INTERSECTIONS
    assert difference(X[:1], Y[:4]).over == st.INTERSECTIONS_AND_SEEDS, "one side was not trained"


def test_where_there_is_no_interval() -> None:
    few = estimate(X[:, : st.MIN_INTERSECTIONS - 1])
    assert math.isnan(few.low) and math.isnan(few.p)
    same = estimate(np.full((1, 20), 3.0))
    assert same.value == pytest.approx(3.0) and math.isnan(same.high)
    nothing = estimate(np.empty((2, 0)))
    assert math.isnan(nothing.value)
    assert json.loads(json.dumps(nothing.to_dict(), allow_nan=False))["value"] is None
    with pytest.raises(IzooError, match="training seeds, intersections"):
        estimate([1.0, 2.0])


def test_a_difference_is_paired() -> None:
    places = np.random.default_rng(3).normal(0.0, 50.0, 11)
    apart, alone = difference(X + places, Y + places), difference(X, Y)
    assert (apart.low, apart.high, apart.p) == pytest.approx((alone.low, alone.high, alone.p))
    assert apart.value == pytest.approx(-difference(Y, X).value)
    assert difference(X, X[:1] * 0.0).value == pytest.approx(estimate(X).value)
    untrained = difference(X, np.zeros((1, 11)))
    assert (untrained.low, untrained.high) == pytest.approx((estimate(X).low, estimate(X).high))


def test_the_p_value_is_that_of_the_interval() -> None:
    for shift in np.linspace(-2.0, 2.0, 41):
        found = difference(X, Y + shift)
        assert (found.p < 0.05) == (not found.low <= 0.0 <= found.high)


def test_an_entry_compared_with_itself_has_no_p_value() -> None:
    same = difference(X[:1], X[:1])
    assert same.value == 0.0 and math.isnan(same.p)
    with pytest.raises(IzooError, match="twice"):
        difference(X, Y[:, :5])
    assert math.isnan(difference(X[:, :0], Y[:, :0]).value)


def test_holm_corrects_for_the_number_of_comparisons() -> None:
    assert st.holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert st.holm([0.6, 0.7]) == [1.0, 1.0]
    found = st.holm([0.02, math.nan, 0.01])
    assert found[0] == pytest.approx(0.02) and math.isnan(found[1]) and found[2] == pytest.approx(0.02)
    assert st.holm([]) == []


def test_a_fall_is_tested_over_intersections() -> None:
    places = ["a", "a", "b", "b", "c", "c"]
    value = st.fall_p_value([-1.0, -3.0, -1.0, -1.0, 0.0, 0.0], places)
    centre, error = -1.0, 1.0 / math.sqrt(3.0)
    assert value == pytest.approx(st.student_t_below(centre / error, 2))
    assert st.fall_p_value([-1.0, -1.0], ["a", "a"]) == 0.0 and st.fall_p_value([1.0], ["a"]) == 1.0


def test_a_performance_profile_falls_from_1_to_0() -> None:
    assert st.performance_profile([[1.0, 2.0], [3.0, 4.0]], [0.0, 2.0, 4.0]).tolist() == [1.0, 0.5, 0.0]
    assert np.isnan(st.performance_profile([], [0.0])).all()


@pytest.mark.parametrize(("degrees", "t"), [(1, 12.706), (2, 4.303), (5, 2.571), (10, 2.228), (100, 1.984)])
def test_student_t_agrees_with_the_printed_table(degrees: int, t: float) -> None:
    assert student_t_quantile(0.975, degrees) == pytest.approx(t, abs=1e-3)
    assert st.student_t_below(t, degrees) == pytest.approx(0.975, abs=1e-4)
    assert st.student_t_below(-t, degrees) == pytest.approx(0.025, abs=1e-4)


@pytest.mark.parametrize("degrees", range(1, 41))
def test_student_t_stays_a_probability(degrees: int) -> None:
    for t in (8.0, 25.0, 35.0, 1e3, 1e6):
        assert 0.0 <= st.student_t_below(-t, degrees) < 0.05 and 0.95 < st.student_t_below(t, degrees) <= 1.0
