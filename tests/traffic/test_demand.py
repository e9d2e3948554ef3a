"""Arrival processes."""

import numpy as np
import pytest

from izoo.traffic.demand import draw_index, poisson_arrivals


def test_arrivals_have_the_rate_and_variance_of_a_poisson_process():
    counts = [len(poisson_arrivals(np.random.default_rng(seed), 0.25, 1000.0)) for seed in range(400)]
    assert np.mean(counts) == pytest.approx(250.0, abs=4 * np.sqrt(250.0 / 400))
    assert np.var(counts) == pytest.approx(250.0, rel=0.3)


def test_arrivals_are_ascending_and_lie_within_the_episode():
    times = poisson_arrivals(np.random.default_rng(0), 3.0, 1000.0)
    assert len(times) > 512
    assert (np.diff(times) > 0).all() and times[0] >= 0.0 and times[-1] < 1000.0
    assert len(poisson_arrivals(np.random.default_rng(0), 0.0, 1000.0)) == 0


def test_a_longer_episode_or_a_higher_rate_keeps_the_earlier_vehicles():
    short = poisson_arrivals(np.random.default_rng(1), 1.0, 900.0)
    long = poisson_arrivals(np.random.default_rng(1), 1.0, 1800.0)
    dense = poisson_arrivals(np.random.default_rng(1), 2.0, 900.0)
    np.testing.assert_array_equal(long[: len(short)], short)
    np.testing.assert_allclose(dense[: len(short)] * 2.0, short)


def test_draw_index_never_chooses_an_empty_share():
    index = draw_index(np.array([0.0, 0.0999, 0.1, 0.5, 1.0 - 1e-16]), np.array([0.0, 0.1, 0.0, 0.9, 0.0]))
    np.testing.assert_array_equal(index, [1, 1, 3, 3, 3])
