"""Training episodes beside the same ones without the policy: driven by humans, and by CVs that nobody commands.

On the twin such an episode costs little, and another run of the same seed finds it in the cache. So the learning curve
can show what the policy changes, where raw returns and emissions rise and fall with the contexts that were drawn; and a
learner can take the uncommanded episode's rewards from its own (:meth:`izoo.algos.mappo.MAPPO.advantages`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.mappo import TEAM_BASELINE
from izoo.algos.scripted import UncommandedDriver
from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule
from izoo.envs.mdp.frame import TEAM_REWARD, TOTALS
from izoo.envs.twin_env import TwinEnv
from izoo.evaluation.baselines import baseline_context, default_folder
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.provenance import settings
from izoo.files import replacing
from izoo.training.collectors import num_envs
from izoo.training.environments import NUMBERS, split_totals

BLOCK = 32
"""Most episodes that are played at once."""
BLOCKS_KEPT = 64
"""Blocks that stay in memory: a few MB."""
SAVED = {HUMAN: "co2_saved_over_human", UNCOMMANDED: "co2_saved_over_uncommanded"}
"""Columns of ``metrics.csv``: CO2 per vehicle saved, as a share, mean over the approaches of the compared episodes that
ended in a batch; no gate, so :data:`KEPT` stands beside."""
KEPT = "crossed_relative_to_human"


@dataclass(frozen=True)
class _Human:
    """The schedule's episodes as human drivers play them."""

    schedule: Schedule

    def __call__(self, episode: int) -> tuple[Context, int]:
        context, seed = self.schedule(episode)
        return baseline_context(context), seed


@dataclass(frozen=True)
class _Strided:
    """Every ``stride``-th episode of a schedule, from number ``first`` on."""

    schedule: Schedule
    first: int
    stride: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.schedule(self.first + self.stride * episode)


@dataclass(frozen=True)
class Episode:
    """An episode that was played without the policy.

    Attributes:
        team_reward: ``[decisions]`` float32, what the team was paid.
        totals: ``[E + P * M]`` float32, its metrics (:data:`~izoo.envs.mdp.frame.TOTALS`).
    """

    team_reward: np.ndarray
    totals: np.ndarray


class Baseline:
    """Every ``stride``-th episode of a schedule, without the policy; played in blocks, and kept on disk.

    Args:
        config: options of the run.
        schedule: its episodes.
        driver: ``human`` or ``uncommanded``.
        stride: numbers of the episodes are multiples of it.
        folder: where they are kept; a file that is damaged, or cannot be written, is as if it were not there.

    Attributes:
        block: how many are played at once: so many that the run needs nearly all of the last block.
    """

    def __init__(self, config: TrainConfig, schedule: Schedule, driver: str, stride: int, folder: Path) -> None:
        self.config, self.driver, self.stride, self.folder = config, driver, stride, folder
        episodes = num_envs(config) + config.total_frames / config.env.decisions
        count = math.ceil(episodes / stride)
        self.block = math.ceil(count / math.ceil(count / BLOCK))
        self.schedule = _Human(schedule) if driver == HUMAN else schedule
        self._env_config = dataclasses.replace(config.env, emit=(TEAM_REWARD,))
        known = {"settings": settings(self._env_config, "twin"), "twin": config.twin.surrogate, "of": "training"}
        self._settings = json.dumps(known, sort_keys=True)
        self._blocks: dict[int, list[Episode]] = {}
        self._env: TwinEnv | None = None
        self._ready = -1

    def episodes(self, numbers: Sequence[int]) -> dict[int, Episode]:
        """Return the episodes of these numbers, multiples of the stride."""
        places = {number: divmod(number // self.stride, self.block) for number in numbers}
        wanted = sorted({block for block, _ in places.values()})
        for block in wanted:
            if block not in self._blocks:
                self._blocks[block] = self._block(block)
        for block in sorted(set(self._blocks) - set(wanted))[: max(len(self._blocks) - BLOCKS_KEPT, 0)]:
            del self._blocks[block]
        return {number: self._blocks[block][place] for number, (block, place) in places.items()}

    def close(self) -> None:
        """End the simulations."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _block(self, block: int) -> list[Episode]:
        numbers = [(block * self.block + place) * self.stride for place in range(self.block)]
        paths = [self._path(*self.schedule(number)) for number in numbers]
        kept = [self._read(path) for path in paths]
        if all(kept):
            return kept  # type: ignore[return-value]
        played = self._play(block)
        for path, episode in zip(paths, played, strict=True):
            _write(path, episode)
        return played

    def _play(self, block: int) -> list[Episode]:
        """Play a block; where it follows on the last one, its episodes have been prepared meanwhile."""
        if self._env is None or self._ready != block:
            self.close()
            schedule, twin = _Strided(self.schedule, block * self.block * self.stride, self.stride), self.config.twin
            self._env = TwinEnv(
                self.block,
                schedule,
                config=self._env_config,
                threads=twin.threads,
                surrogate=twin.surrogate,
                shard=0,
            )
        self._ready = block + 1
        env, driver, paid = self._env, UncommandedDriver(self._env_config.lane_change), []
        state = env.reset()
        for _ in range(self._env_config.decisions):
            state = env.step_lean(driver(state))
            paid.append(state.get(TEAM_REWARD).squeeze(-1))
        rewards, totals = torch.stack(paid, -1).numpy(), env.frames[TOTALS].copy()
        return [Episode(rewards[place], totals[place]) for place in range(self.block)]

    def _path(self, context: Context, seed: int) -> Path:
        key = f"{self.driver}\n{context.content_hash}\n{seed}\n{self._settings}"
        digest = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / digest[:2] / f"{digest}.npy"

    def _read(self, path: Path) -> Episode | None:
        try:
            whole = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None
        decisions = self._env_config.decisions
        return Episode(whole[:decisions], whole[decisions:]) if whole.ndim == 1 and len(whole) > decisions else None


def _write(path: Path, episode: Episode) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, durable=False) as partial, partial.open("wb") as file:
            np.save(file, np.concatenate([episode.team_reward, episode.totals]))
    except OSError:
        return  # it is only played again


class Paired:
    """What a batch is compared with.

    Args:
        config: options of a run on the twin.
        schedule: its episodes.
        folder: of the cache.
        level: the number in ``schedule`` of what a numbered episode of the run plays; ``None``: the same.
    """

    def __init__(
        self,
        config: TrainConfig,
        schedule: Schedule,
        folder: Path | None = None,
        level: Callable[[int], int] | None = None,
    ) -> None:
        self._level = level or int
        where = default_folder() if folder is None else folder
        self.every, self._skipped = config.twin.compare_every, config.staggered
        self.hold_steps = config.env.hold_steps

        def make(driver: str, stride: int) -> Baseline:
            return Baseline(config, schedule, driver, stride, where)

        self._compared = {driver: make(driver, self.every) for driver in SAVED} if self.every else {}
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
        """Return :data:`SAVED`, :data:`KEPT`, and how many episodes they are of; empty where none has ended."""
        if not self._compared:
            return {}
        ended = batch.get(("next", "done")).squeeze(-1)
        numbers, totals = batch.get(("next", NUMBERS))[ended][:, 0], batch.get(("next", TOTALS))[ended]
        levels = torch.tensor([self._level(number) for number in numbers.tolist()], dtype=torch.int64)
        chosen = (levels % self.every == 0) & (numbers >= self._skipped)
        if not chosen.any():
            return {}
        wanted, own = levels[chosen].tolist(), _sums(totals[chosen])
        found: dict[str, float] = {"compared_episodes": float(len(wanted))}
        for driver, baseline in self._compared.items():
            episodes = baseline.episodes(wanted)
            other = _sums(torch.stack([torch.from_numpy(episodes[number].totals) for number in wanted]))
            both = (own[1] > 0) & (other[1] > 0)
            if both.any():
                grams, beside = ((part[0] / part[1].clamp_min(1.0))[both] for part in (own, other))
                found[SAVED[driver]] = float((1.0 - grams / beside).mean())
            if driver == HUMAN and (other[1] > 0).any():
                found[KEPT] = float(own[1].sum() / other[1].sum())
        return found


def _sums(totals: Tensor) -> tuple[Tensor, Tensor]:
    """Return CO2 in g and how many vehicles crossed, ``[n, P]`` each, of ``totals`` ``[n, E + P * M]``."""
    approach = split_totals(totals)[1]
    return approach["emission_g"], approach["crossed"]
