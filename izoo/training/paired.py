"""Training episodes beside the same ones without the policy: driven by humans, and by CVs that nobody commands.

On the twin such an episode costs little, and another run of the same seed finds it in the cache. So the learning curve
can show what the policy changes, where raw returns and emissions rise and fall with the contexts that were drawn; and a
learner can take the uncommanded episode's rewards from its own (:meth:`izoo.algos.mappo.MAPPO.advantages`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from izoo.algos.mappo import TEAM_BASELINE
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import Schedule
from izoo.cores import usable_cores
from izoo.envs.mdp.frame import TEAM_REWARD, TOTALS
from izoo.envs.mdp.tally import APPROACH_METRICS
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import HUMAN, UNCOMMANDED
from izoo.results.rollout import Play, Played, rollout
from izoo.training.collectors import num_envs
from izoo.training.environments import NUMBERS, split_totals

BLOCK = 32
"""Most episodes that are played at once."""
BLOCKS_KEPT = 64
"""Blocks that stay in memory: a few MB."""
COMPARED = {
    UNCOMMANDED: {"co2_saved": "co2_saved", "delay_change_s": "delay_change_s"},
    HUMAN: {"co2_saved_over_human": "co2_saved"},
}
"""Columns of ``metrics.csv`` and their figures: at the training horizon, mean over the compared episodes that ended in
a batch."""


@dataclass(frozen=True)
class _Numbered(Play):
    """An episode of a schedule; ``place`` counts those that are compared."""

    place: int


class Episode(NamedTuple):
    """An episode that was played without the policy.

    Attributes:
        team_reward: ``[decisions]`` float32, the reward's fleet part.
        sums: ``[M]``, :data:`~izoo.envs.mdp.tally.APPROACH_METRICS` added over approaches.
    """

    team_reward: NDArray[np.float32]
    sums: NDArray[np.float64]


class Baseline:
    """Every ``stride``-th episode of a schedule, without the policy; played in blocks, one prepared ahead.

    Args:
        config: options of the run.
        schedule: its episodes.
        driver: ``human`` or ``uncommanded``.
        stride: numbers of the episodes are multiples of it.
        cache: folder where they are kept; ``None``: in the user's cache.

    Attributes:
        block: how many are played at once: so many that the run needs nearly all of the last block.
    """

    def __init__(
        self, config: TrainConfig, schedule: Schedule, driver: str, stride: int, cache: Path | None = None
    ) -> None:
        self.config, self.schedule, self.driver, self.stride, self.cache = config, schedule, driver, stride, cache
        episodes = num_envs(config) + config.total_frames / config.env.decisions
        count = math.ceil(episodes / stride)
        self.block = math.ceil(count / math.ceil(count / BLOCK))
        self._blocks: dict[int, dict[int, Episode]] = {}
        self._stream: Generator[Played, None, None] | None = None
        self._following = -1

    def episodes(self, numbers: Sequence[int]) -> dict[int, Episode]:
        """Return the episodes of these numbers, multiples of the stride."""
        places = {number: number // self.stride for number in numbers}
        wanted = sorted({place // self.block for place in places.values()})
        for block in wanted:
            if block not in self._blocks:
                self._blocks[block] = self._play(block)
        for block in sorted(set(self._blocks) - set(wanted))[: max(len(self._blocks) - BLOCKS_KEPT, 0)]:
            del self._blocks[block]
        return {number: self._blocks[place // self.block][place] for number, place in places.items()}

    def close(self) -> None:
        """End the simulations."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _play(self, block: int) -> dict[int, Episode]:
        if self._stream is None or self._following != block:
            self.close()
            twin = self.config.twin
            self._stream = rollout(
                self._plays(block * self.block),
                {},
                self.config.env,
                simulator="twin",
                executor="batch",
                workers=usable_cores() if twin.threads is None else twin.threads,
                record=(TEAM_REWARD,),
                cache=self.cache,
                progress=False,
                side_by_side=self.block,
                surrogate=twin.surrogate,
            )
        self._following = block + 1
        found = {}
        for play, rows, series in itertools.islice(self._stream, self.block):
            sums = np.array([[row[name] for name in APPROACH_METRICS] for row in rows]).sum(0)
            found[play.place] = Episode(series[TEAM_REWARD], sums)  # type: ignore[attr-defined]
        return found

    def _plays(self, first: int) -> Iterator[_Numbered]:
        for place in itertools.count(first):
            yield _Numbered(self.driver, 0, *self.schedule(place * self.stride), place)


class Paired:
    """What a batch is compared with.

    Args:
        config: options of a run on the twin.
        schedule: its episodes.
        cache: folder of the baselines' episodes; ``None``: in the user's cache.
        level: the number in ``schedule`` of what a numbered episode of the run plays; ``None``: the same.
    """

    def __init__(
        self,
        config: TrainConfig,
        schedule: Schedule,
        cache: Path | None = None,
        level: Callable[[int], int] | None = None,
    ) -> None:
        self._level = level or int
        self.every, self._skipped = config.twin.compare_every, config.staggered
        self.hold_steps = config.env.hold_steps

        def make(driver: str, stride: int) -> Baseline:
            return Baseline(config, schedule, driver, stride, cache)

        self._compared = {driver: make(driver, self.every) for driver in COMPARED} if self.every else {}
        self._subtracted = make(UNCOMMANDED, 1) if getattr(config.algo, "control_variate", False) else None
        if self._compared and self._subtracted is not None:
            self._compared[UNCOMMANDED] = self._subtracted

    def close(self) -> None:
        """End the simulations."""
        for baseline in (*self._compared.values(), self._subtracted):
            if baseline is not None:
                baseline.close()

    def add_team_rewards(self, batch: TensorDictBase) -> None:
        """Set :data:`~izoo.algos.mappo.TEAM_BASELINE` of a batch ``[N, T]``, where the learner wants it."""
        if self._subtracted is None:
            return
        numbers, following = batch.get(NUMBERS)[..., 0], batch.get(("next", TOTALS))
        steps = split_totals(following.flatten(0, 1))[0]["steps"].reshape(numbers.shape)
        # The last decision of an episode may be shorter.
        decisions = torch.div(steps.long() - 1, self.hold_steps, rounding_mode="floor")
        found = torch.zeros(numbers.shape)
        levels = {number: self._level(number) for number in numbers.unique().tolist()}
        episodes = self._subtracted.episodes(list(levels.values()))
        for number, level in levels.items():
            here = numbers == number
            found[here] = torch.from_numpy(episodes[level].team_reward)[decisions[here]]
        batch.set(("next", TEAM_BASELINE), found.unsqueeze(-1))

    def compare(self, batch: TensorDictBase) -> dict[str, float]:
        """Return :data:`COMPARED`, and how many episodes they are of; empty where none has ended."""
        if not self._compared:
            return {}
        ended = batch.get(("next", "done")).squeeze(-1)
        numbers, totals = batch.get(("next", NUMBERS))[ended][:, 0], batch.get(("next", TOTALS))[ended]
        levels = torch.tensor([self._level(number) for number in numbers.tolist()], dtype=torch.int64)
        chosen = (levels % self.every == 0) & (numbers >= self._skipped)
        if not chosen.any():
            return {}
        wanted = levels[chosen].tolist()
        own = {name: value.double().sum(-1).numpy() for name, value in split_totals(totals[chosen])[1].items()}
        found: dict[str, float] = {"compared_episodes": float(len(wanted))}
        for driver, baseline in self._compared.items():
            episodes = baseline.episodes(wanted)
            sums = np.stack([episodes[number].sums for number in wanted], 1)
            other = dict(zip(APPROACH_METRICS, sums, strict=True))
            for column, figure in COMPARED[driver].items():
                values = FIGURES[figure].value(own, other)
                if np.isfinite(values).any():  # there is none without demand
                    found[column] = float(np.nanmean(values))
        return found
