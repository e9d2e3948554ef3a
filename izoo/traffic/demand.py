"""When vehicles arrive, and draws from given shares."""

from __future__ import annotations

import numpy as np

STRAIGHT_SOURCE_SHARE = 0.9
"""Share of an approach's traffic that comes straight through the ghost intersection; the rest turns in."""
_BLOCK = 512


def poisson_arrivals(generator: np.random.Generator, rate_per_s: float, duration_s: float) -> np.ndarray:
    """Return the ascending arrival times of a Poisson process in ``[0, duration_s)``, in seconds, ``[N]`` float64.

    Another rate stretches the same arrivals, so that the ``k``-th vehicle stays the ``k``-th vehicle.
    """
    if rate_per_s <= 0.0:
        return np.zeros(0)
    blocks = [generator.standard_exponential(_BLOCK)]
    total = blocks[0].sum()
    while total < rate_per_s * duration_s * (1.0 + 1e-9):
        blocks.append(generator.standard_exponential(_BLOCK))
        total += blocks[-1].sum()
    times = np.cumsum(np.concatenate(blocks)) / rate_per_s
    return times[times < duration_s]


def draw_index(uniform: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Turn uniforms in [0, 1) into indices distributed as ``shares`` (non-negative, at least one positive)."""
    cumulative = np.cumsum(shares)
    return np.searchsorted(cumulative / cumulative[-1], uniform, side="right")
