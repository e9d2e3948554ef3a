"""Which share of an approach's traffic turns which way: what vehicles do, and what signal plans are made for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from izoo.contexts.spec import Approach

RIGHT, STRAIGHT, LEFT = 0, 1, 2
TURN_SHARE = 0.1


def exit_shares(
    approach: Approach | None, exits: Sequence[str], movement_turn: np.ndarray, movement_links: np.ndarray
) -> np.ndarray:
    """Return the share of an approach's traffic that takes each exit, ``[Q]`` float64: as counted, or else by rule.

    Args:
        approach: the approach, which may have counts; they are read as 0 where there is no movement.
        exits: ``Q`` legs.
        movement_turn, movement_links: as for :func:`turning_shares`.
    """
    if approach is None or not approach.exit_counts:
        return turning_shares(movement_turn, movement_links)
    counts = dict(approach.exit_counts)
    flow = np.where(np.asarray(movement_turn) >= 0, [counts.get(leg, 0.0) for leg in exits], 0.0)
    return flow / max(float(flow.sum()), 1e-9)


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
