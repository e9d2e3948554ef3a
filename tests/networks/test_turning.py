"""Turning shares."""

import numpy as np
import pytest

from izoo.networks.turning import turning_shares


@pytest.mark.parametrize(
    ("turn", "links", "expected"),
    [
        ([-1, 2, 1, 0], [0, 1, 2, 1], [0, 0.1, 0.8, 0.1]),
        ([-1, 1, -1, 0], [0, 3, 0, 1], [0, 0.9, 0, 0.1]),
        ([2, 1, -1], [2, 1, 0], [0.1, 0.9, 0]),
        ([2, 0, -1], [2, 1, 0], [2 / 3, 1 / 3, 0]),
        ([-1, 2, 2, 1, 0], [9, 1, 1, 3, 1], [0, 1 / 6, 1 / 6, 1 / 2, 1 / 6]),
        ([1, 1, 0], [1, 2, 1], [0.25, 0.5, 0.25]),
        ([-1, 2, -1], [0, 1, 0], [0, 1, 0]),
        ([-1, -1], [0, 0], [0, 0]),
    ],
)
def test_turning_shares_follow_the_rule_of_their_case(turn, links, expected):
    shares = turning_shares(np.array(turn, np.int8), np.array(links))
    np.testing.assert_allclose(shares, expected, atol=1e-12)
