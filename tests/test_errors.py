"""What messages about numbers out of range say."""

import math

import pytest

from izoo.errors import IzooError, check_range


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (0, 2**31 - 1, "[0, 2147483647]"),
        (-1234567.0, 10**9, "[-1234567, 1e+09]"),
        (0, 2**63 - 1, "[0, 9223372036854775807]"),
        (1e-12, 0.5, "[1e-12, 0.5]"),
        (0.123456789, 1024, "[0.123457, 1024]"),
        (-math.inf, 1.0, "[-inf, 1]"),
    ],
)
def test_bounds_are_short_and_whole_ones_exact(low: float, high: float, text: str) -> None:
    with pytest.raises(IzooError) as refused:
        check_range("size", 10**20, low, high, "m")
    assert str(refused.value) == f"size is {10**20}; it must lie in {text} m."
    with pytest.raises(IzooError) as refused:
        check_range("size", "x", low, high)
    assert str(refused.value) == f"size is 'x'; it must be a number in {text}."
