"""The same episodes as in training, without the policy: with human drivers, and with uncommanded CVs.

On the twin such an episode costs little, and another run of the same seed finds it in the cache. So the learning curve
can show what the policy changes, where raw returns and emissions rise and fall with the contexts that were drawn; and a
learner can take the uncommanded episode's rewards from its own: the team's
(:meth:`izoo.algos.learners.mappo.MAPPO.advantages`), or each vehicle's (:func:`izoo.algos.learners.decisions.shaped`).

A process of their own plays them (:mod:`izoo.training.baseline_process`), from when an episode begins in training, or
one block before.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from izoo.algos.learners.base import EPISODES, MASK, NUMBER, POTENTIAL
from izoo.algos.learners.mappo import TEAM_BASELINE
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import Schedule
from izoo.cores import usable_cores
from izoo.envs.config import STEP
from izoo.envs.mdp.frame import TEAM_REWARD, TOTALS
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import HUMAN, UNCOMMANDED
from izoo.results.playing import VEHICLE_REWARD, VEHICLE_SPANS, Play
from izoo.training.baseline_process import BaselineProcess, Episode
from izoo.training.environments import split_totals
from izoo.training.reward_to_go import RewardToGo

BLOCK = 32
"""Most episodes that are played at once."""
REWARD_EVERY_S = 2.0
"""Time between two rewards of an uncommanded episode, where CVs do not decide in every step."""
BLOCKS_KEPT = 64
"""Blocks that stay in memory: a few MB, or some 100 MB with the rewards of all CVs."""
RECORDED = {"team": (TEAM_REWARD,), "vehicle": (VEHICLE_SPANS, VEHICLE_REWARD)}
"""What a control variate needs of an uncommanded episode."""
COMPARED = {
    UNCOMMANDED: {"co2_saved": "co2_saved", "delay_change_s": "delay_change_s"},
    HUMAN: {"co2_saved_over_human": "co2_saved"},
}
"""Columns of ``metrics.csv`` and their figures: at the training horizon, mean over the compared episodes that ended in
a batch."""


class BaselineSchedule:
    """Every ``stride``-th episode of a schedule, without the policy; played in blocks.

    Args:
        config: options of the run.
        schedule: its episodes.
        driver: ``human`` or ``uncommanded``.
        stride: numbers of the episodes are multiples of it.
        process: what plays them.
        record: what is recorded of them.

    Attributes:
        block: how many are played at once: so many that the run needs nearly all of the last block.
    """

    def __init__(
        self,
        config: TrainConfig,
        schedule: Schedule,
        driver: str,
        stride: int,
        process: BaselineProcess,
        record: tuple[str, ...] = (),
    ) -> None:
        self.schedule, self.driver, self.stride, self.process = schedule, driver, stride, process
        self.record, self._last = record, math.inf
        if config.env.decide == STEP:
            episodes = config.environments + config.total_frames / config.env.decisions
            count = math.ceil(episodes / stride)
            blocks = math.ceil(count / BLOCK)
            self.block, self._last = math.ceil(count / blocks), blocks - 1
        else:  # how many episodes the run needs is not known, but the environments play as many at a time
            self.block = math.ceil(config.environments / stride)
        self._blocks: dict[int, Future[list[Episode]]] = {}

    def expect(self, numbers: Iterable[int]) -> None:
        """Let episodes be played that the run will ask for, if it goes on as long as its options say."""
        for block in sorted({number // self.stride // self.block for number in numbers}):
            if block <= self._last:
                self._begin(block)

    def episodes(self, numbers: Sequence[int]) -> dict[int, Episode]:
        """Return the episodes of these numbers, multiples of the stride; wait for them where they are not there yet."""
        places = {number: divmod(number // self.stride, self.block) for number in numbers}
        wanted = {block for block, _ in places.values()}
        for block in sorted(wanted):
            self._begin(block)
        found = {number: self._blocks[block].result()[place] for number, (block, place) in places.items()}
        for block in sorted(set(self._blocks) - wanted)[: max(len(self._blocks) - BLOCKS_KEPT, 0)]:
            del self._blocks[block]
        return found

    def _begin(self, block: int) -> None:
        if block not in self._blocks:
            self._blocks[block] = self.process.submit(functools.partial(self._plays, block), self.record)

    def _plays(self, block: int) -> list[Play]:
        numbers = range(block * self.block * self.stride, (block + 1) * self.block * self.stride, self.stride)
        return [Play(self.driver, 0, *self.schedule(number)) for number in numbers]


class BaselineComparison:
    """Compares batches with their baseline episodes, and adds what a control variate needs of them.

    Args:
        config: options of a run on the twin.
        schedule: its episodes.
        cache: folder of the baselines' episodes; ``None``: in the user's cache.
        level: maps the number of an episode of the run to its number in ``schedule``; ``None``: the same.
    """

    def __init__(
        self,
        config: TrainConfig,
        schedule: Schedule,
        cache: Path | None = None,
        level: Callable[[int], int] | None = None,
    ) -> None:
        self._level, self._in_order = level or int, level is None
        self.every, self._skipped, self._envs = config.twin.compare_every, config.staggered, config.environments
        by_step = config.env.decide == STEP
        env, twin = config.env, config.twin
        if not by_step:
            env = env.with_accelerations(max(round(REWARD_EVERY_S / env.step_s), 1) * env.step_s)
        self.hold_steps = env.hold_steps
        self.gamma: float = getattr(config.algo, "gamma", 1.0) if by_step else 1.0
        self.variate = config.algo.variate
        self._reward_to_go: dict[int, RewardToGo] = {}
        self._process = BaselineProcess(
            config=env,
            simulator=config.simulator,
            executor="batch",
            workers=usable_cores() if twin.threads is None else twin.threads,
            cache=cache,
            surrogate=twin.surrogate,
        )

        def make(driver: str, stride: int, record: tuple[str, ...] = ()) -> BaselineSchedule:
            return BaselineSchedule(config, schedule, driver, stride, self._process, record)

        self._compared = {driver: make(driver, self.every) for driver in COMPARED} if self.every else {}
        self._subtracted = make(UNCOMMANDED, 1, RECORDED[self.variate]) if self.variate in RECORDED else None
        if self._compared and self._subtracted is not None:
            self._compared[UNCOMMANDED] = self._subtracted

    def close(self) -> None:
        """End the simulations."""
        self._process.close()

    def expect(self, numbers: Sequence[int]) -> None:
        """Let episodes be played before they are asked for: those in progress, and the ones that follow.

        Args:
            numbers: of the episodes in progress; none: the run begins.
        """
        levels = {number: self._level(number) for number in numbers}
        if self._in_order:  # else what follows may not have been drawn yet
            following = max(numbers, default=-1) + 1
            ahead = self._envs if numbers else 2 * self._envs
            levels |= {number: number for number in range(following, following + ahead)}
        if self._subtracted is not None:
            self._subtracted.expect(levels.values())
        for baseline in self._compared.values():
            whole = [level for number, level in levels.items() if number >= self._skipped]
            baseline.expect(level for level in whole if level % self.every == 0)

    def add(self, batch: TensorDictBase) -> None:
        """Set what the learner subtracts from a batch ``[N, T]``: :data:`~izoo.algos.learners.mappo.TEAM_BASELINE`, or
        :data:`~izoo.algos.learners.base.POTENTIAL` at the root and under ``"next"``.
        """
        self.expect(batch.get(("next", EPISODES))[:, -1, 0].tolist())
        if self.variate == "team":
            self._add_team_rewards(batch)
        elif self.variate == "vehicle":
            self._add_potentials(batch)

    def _add_potentials(self, batch: TensorDictBase) -> None:
        episodes, levels = self._episodes(batch)
        of_level = {
            level: self._reward_to_go.get(level) or RewardToGo(episodes[level].series, self.gamma)
            for level in levels.values()
        }
        self._reward_to_go = of_level  # episodes that have ended are not needed again
        for part in (batch, batch.get("next")):
            mask = part.get(MASK)
            steps = split_totals(part.get(TOTALS).flatten(0, 1))[0]["steps"].reshape(*batch.shape, 1).long()
            decision = torch.div(steps + self.hold_steps - 1, self.hold_steps, rounding_mode="floor")
            whole = (part.get(EPISODES)[..., :1], part.get(NUMBER), decision)
            episode, vehicle, now = (leaf.expand(mask.shape)[mask].numpy() for leaf in whole)
            found = np.zeros(len(vehicle), np.float32)
            for number, level in levels.items():
                here = episode == number
                found[here] = of_level[level].at(vehicle[here], now[here])
            potential = torch.zeros(*mask.shape, 1)
            potential[mask] = torch.from_numpy(found).unsqueeze(-1)
            part.set(POTENTIAL, potential)

    def _episodes(self, batch: TensorDictBase) -> tuple[dict[int, Episode], dict[int, int]]:
        """Return the uncommanded episodes of a batch, and by its episodes' numbers those in the schedule."""
        assert self._subtracted is not None
        levels = {number: self._level(number) for number in batch.get(EPISODES)[..., 0].unique().tolist()}
        return self._subtracted.episodes(list(levels.values())), levels

    def _add_team_rewards(self, batch: TensorDictBase) -> None:
        numbers, following = batch.get(EPISODES)[..., 0], batch.get(("next", TOTALS))
        steps = split_totals(following.flatten(0, 1))[0]["steps"].reshape(numbers.shape)
        # The last decision of an episode may be shorter.
        decisions = torch.div(steps.long() - 1, self.hold_steps, rounding_mode="floor")
        found = torch.zeros(numbers.shape)
        episodes, levels = self._episodes(batch)
        for number, level in levels.items():
            here = numbers == number
            found[here] = torch.from_numpy(episodes[level].series[TEAM_REWARD])[decisions[here]]
        batch.set(("next", TEAM_BASELINE), found.unsqueeze(-1))

    def compare(self, batch: TensorDictBase) -> dict[str, float]:
        """Return :data:`COMPARED`, and how many episodes they are of; empty where none has ended."""
        if not self._compared:
            return {}
        ended = batch.get(("next", "done")).squeeze(-1)
        numbers, totals = batch.get(("next", EPISODES))[ended][:, 0], batch.get(("next", TOTALS))[ended]
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
