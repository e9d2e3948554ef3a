"""Student's t for integer degrees of freedom, which is all that paired tests and intervals here need."""

from __future__ import annotations

import functools
import math


def student_t_below(t: float, degrees: int) -> float:
    """Probability that Student's t with ``degrees`` (an integer of 1 or more) lies below ``t``.

    The finite series of Abramowitz and Stegun 26.7.3 and 26.7.4, exact for integer degrees of freedom.
    """
    theta = math.atan2(t, math.sqrt(degrees))
    cos2 = math.cos(theta) ** 2
    odd = degrees % 2 == 1
    term, total = 1.0, 0.0
    for k in range(degrees // 2):
        total += term
        term *= cos2 * ((2 * k + 2) / (2 * k + 3) if odd else (2 * k + 1) / (2 * k + 2))
    inside = 2.0 / math.pi * (theta + math.sin(theta) * math.cos(theta) * total) if odd else math.sin(theta) * total
    return min(max(0.5 * (1.0 + inside), 0.0), 1.0)  # sums may round beyond


@functools.cache
def student_t_quantile(below: float, degrees: int) -> float:
    """Value that Student's t with ``degrees`` lies below with probability ``below``, which is at least one half."""
    low, high = 0.0, 1.0
    while student_t_below(high, degrees) < below:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if student_t_below(middle, degrees) < below else (low, middle)
    return high
