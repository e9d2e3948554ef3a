"""When vehicles arrive and which way they turn."""

from __future__ import annotations

import numpy as np

RIGHT, STRAIGHT, LEFT = 0, 1, 2
TURN_SHARE = 0.1
STRAIGHT_SOURCE_SHARE = 0.9
"""Share of an approach's traffic that comes straight through the ghost intersection; the rest turns in."""
_BLOCK = 512


def turning_shares(movement_turn: np.ndarray, movement_links: np.ndarray) -> np.ndarray:
    """Return the share of an approach's traffic that takes each exit, ``[Q]`` float64.

    10 % right, 80 % straight and 10 % left where these are the three exits; 10 % for the turn where the other of two
    exits is straight; otherwise by connected lanes. They sum to 1, or are all 0 where the approach leads nowhere.

    Args:
        movement_turn: ``[Q]`` 0 right, 1 straight, 2 left, -1 where there is no such movement.
        movement_links: ``[Q]`` number of lane connections at the stop line.
    """
    turn = np.asarray(movement_turn)
    exits = turn >= 0
    kinds = sorted(turn[exits].tolist())
    if kinds == [RIGHT, STRAIGHT, LEFT] or (len(kinds) == 2 and kinds.count(STRAIGHT) == 1):
        straight = 1.0 - TURN_SHARE * (len(kinds) - 1)
        return np.where(exits, np.where(turn == STRAIGHT, straight, TURN_SHARE), 0.0)
    links = np.where(exits, movement_links, 0).astype(np.float64)
    return links / max(links.sum(), 1.0)


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
