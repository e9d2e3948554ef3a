"""Arithmetic of car following to the last bit."""

import math

import numpy as np

from izoo.envs.twin.driving.car_following import fourth_power


def test_fourth_powers_equal_the_c_librarys_in_most_cases() -> None:
    ratios = (1.3 * np.random.default_rng(0).random(20_000)).tolist()
    apart = [ratio for ratio in ratios if fourth_power(ratio) != math.pow(ratio, 4.0)]
    assert len(apart) < 20, "rounding twice would miss half of them"
    assert all(math.isclose(fourth_power(ratio), ratio**4, rel_tol=1e-15) for ratio in ratios)
    assert (fourth_power(0.0), fourth_power(1.0)) == (0.0, 1.0)
