"""Prioritised level replay (Jiang et al., arXiv 2010.03934): contexts that promise to teach are played again.

A level is a context with the seed of its episode: one numbered episode of uniform draws. An episode plays a new level
or one that was played before; the latter is drawn by the rank of its score, and by how long ago it was played. Scores
are mean magnitudes of advantages: where these are large, the value function or the policy has something to learn.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from izoo.conf.train_options import LevelsConfig
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule

STREAM = 4_099
"""Separates these draws from those of contexts and seeds."""


def replay_probabilities(scores: np.ndarray, ages: np.ndarray, temperature: float, staleness: float) -> np.ndarray:
    """Return the probability ``[n]`` of each level: by the rank of its score, and by its age.

    The first, of rank ``r``, is ``r ** (-1 / temperature)``; the share ``staleness`` of it gives way to the second.

    Args:
        scores: ``[n]``; of equal ones the first ranks first.
        ages: ``[n]`` episodes drawn since each was played last.
        temperature, staleness: of :class:`~izoo.conf.train_options.LevelsConfig`.
    """
    ranks = np.empty(len(scores))
    ranks[np.argsort(-scores, kind="stable")] = np.arange(1, len(scores) + 1)
    by_score = ranks ** (-1.0 / temperature)
    by_age = ages.astype(float) if ages.any() else np.ones(len(ages))
    return (1.0 - staleness) * by_score / by_score.sum() + staleness * by_age / by_age.sum()


class PrioritizedLevelReplay:
    """A schedule whose episodes are new levels of another one, or levels that it has played before.

    The level of an episode is drawn when the episode is prepared, from the seed and the number of draws before, so a
    run is the same with any number of threads, and resumes exactly.

    Args:
        fresh: the levels, by their number.
        config: options.
        seed: base seed of the draws.

    Attributes:
        scores: of the levels that are kept.
    """

    def __init__(self, fresh: Schedule, config: LevelsConfig, seed: int) -> None:
        self.fresh, self.config, self.seed = fresh, config, seed
        self.scores: dict[int, float] = {}
        self._played: dict[int, int] = {}
        self._level_of: dict[int, int] = {}
        self._sums: dict[int, tuple[float, int]] = {}
        self.begun = self.replayed = self._next_fresh = 0

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.fresh(self.level(episode))

    def level(self, episode: int) -> int:
        """Return the level of an episode in progress; draw it if the episode has none yet."""
        self.draw([episode])
        return self._level_of[episode]

    def draw(self, episodes: Iterable[int]) -> None:
        """Draw the levels of the episodes that have none yet, in this order."""
        for episode in episodes:
            if episode not in self._level_of:
                self._level_of[episode] = self._draw()

    def _draw(self) -> int:
        generator = np.random.default_rng([self.seed, STREAM, self.begun])
        self.begun += 1
        in_progress = set(self._level_of.values())
        waiting = [level for level in self.scores if level not in in_progress]  # others are about to be scored anew
        wanted = generator.random() < self.config.share
        if wanted and waiting and 2 * len(self.scores) >= self.config.kept:
            scores = np.array([self.scores[level] for level in waiting])
            ages = np.array([self.begun - 1 - self._played[level] for level in waiting])
            chances = replay_probabilities(scores, ages, self.config.temperature, self.config.staleness)
            level = waiting[int(generator.choice(len(waiting), p=chances))]
            self.replayed += 1
        else:
            level, self._next_fresh = self._next_fresh, self._next_fresh + 1
        self._played[level] = self.begun - 1
        return level

    def update(self, numbers: Tensor, advantage: Tensor, mask: Tensor, done: Tensor) -> None:
        """Add a batch's advantages; episodes that ended in it score their levels.

        Args:
            numbers: ``[N, T]`` of the episodes.
            advantage: ``[N, T, A]``.
            mask: ``[N, T, A]`` of the slots that hold a CV; others do not count.
            done: ``[N, T]`` the episode's last decision.
        """
        size = advantage.abs() if self.config.score == "magnitude" else advantage.clamp_min(0.0)
        totals = torch.where(mask, size, torch.zeros_like(size)).double().sum(-1)
        counts = mask.sum(-1)
        for number in numbers.unique().tolist():
            here = numbers == number
            total, count = self._sums.get(number, (0.0, 0))
            self._sums[number] = total + float(totals[here].sum()), count + int(counts[here].sum())
        for number in sorted(numbers[done].tolist()):
            self._score(number)

    def _score(self, episode: int) -> None:
        """Score an episode's level; where too many levels are kept, drop the one with the lowest score."""
        level, (total, count) = self._level_of.pop(episode), self._sums.pop(episode)
        if count > 0:
            self.scores[level] = total / count
        if len(self.scores) > self.config.kept:
            least = min(self.scores, key=lambda known: (self.scores[known], known))
            del self.scores[least]
        self._played = {k: when for k, when in self._played.items() if k in self.scores or k in self._level_of.values()}

    def forget_episodes(self) -> None:
        """Forget the episodes in progress, since later ones have other numbers; scores stay."""
        self._level_of, self._sums = {}, {}

    def stats(self) -> dict[str, float]:
        """Return what to log."""
        found = {"levels_replayed": self.replayed / max(self.begun, 1), "levels_kept": float(len(self.scores))}
        return {**found, **({"level_score": float(np.mean(list(self.scores.values())))} if self.scores else {})}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that drawing needs to go on."""
        return {
            "scores": dict(self.scores),
            "played": dict(self._played),
            "level_of": dict(self._level_of),
            "sums": dict(self._sums),
            "counts": [self.begun, self.replayed, self._next_fresh],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.scores, self._played = dict(state["scores"]), dict(state["played"])
        self._level_of, self._sums = dict(state["level_of"]), dict(state["sums"])
        self.begun, self.replayed, self._next_fresh = state["counts"]
