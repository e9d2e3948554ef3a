"""Rewards-to-go of the vehicles of an uncommanded episode, which a control variate subtracts."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from izoo.results.playing import VEHICLE_REWARD, VEHICLE_SPANS, Series


class RewardToGo:
    """Discounted sums of each CV's later rewards, at any time.

    Args:
        series: that was recorded of the episode.
        gamma: discount per decision.
    """

    def __init__(self, series: Series, gamma: float) -> None:
        self.gamma = gamma
        number, self.first, self.count = series[VEHICLE_SPANS].astype(np.int64).T
        self.begin = np.cumsum(self.count) - self.count
        self.place = np.full(int(number.max(initial=-1)) + 2, -1)  # the last one is of vehicles that never arrive
        self.place[number] = np.arange(len(number))
        found = series[VEHICLE_REWARD].astype(np.float64)
        for begin, count in zip(self.begin, self.count, strict=True):
            part = found[begin : begin + count]
            later = itertools.accumulate(part[::-1], lambda total, now: now + gamma * total)
            part[:] = np.fromiter(later, np.float64, count)[::-1]
        self.rewards_to_go = np.append(found, 0.0)

    def at(self, number: NDArray[np.int64], decision: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the rewards-to-go ``[n]`` of the vehicles ``number [n]`` from their ``decision [n]`` on."""
        if not len(self.first):
            return np.zeros(len(number), np.float32)
        place = self.place[np.minimum(number, len(self.place) - 1)]
        since = decision - self.first[place]
        found = self.rewards_to_go[self.begin[place] + np.clip(since, 0, self.count[place] - 1)]
        found *= self.gamma ** np.maximum(-since, 0)
        return np.where((place >= 0) & (since < self.count[place]), found, 0.0).astype(np.float32)
