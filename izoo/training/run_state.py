"""Where a training run stands: its learner, its counts, its schedule and its episodes in progress."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import ContextSource, RandomSchedule, Schedule
from izoo.envs.twin_env import is_own_state
from izoo.files import reading
from izoo.training.collectors import BatchSource
from izoo.training.command_replay import EpisodeHistories, EpisodeHistory
from izoo.training.learner import Learner
from izoo.training.prioritized_level_replay import PrioritizedLevelReplay


def later(schedule: Schedule, first: int, episode: int) -> tuple[Context, int]:
    """Return an episode of ``schedule`` from its number ``first`` on: what a resumed run has not played yet."""
    return schedule(first + episode)


def shared(schedule: Schedule, envs: int, blocks: int, episode: int) -> tuple[Context, int]:
    """Return an episode of ``envs`` environments in ``blocks`` of equal size, all of which play those of ``schedule``.

    Each block is of one of the policies that are compared.
    """
    size = envs // blocks
    return schedule(episode // envs * size + episode % size)


class RunState:
    """Everything about a run that a checkpoint holds.

    Args:
        config: options of the run.
        source: where its contexts come from.
        learner: what it trains.

    Attributes:
        frames, batches, episodes, seconds: how far it is.
        environments: where the environments on the twin stand, between two collectors.
        histories: the episodes in progress on SUMO.
        first_episode: number in ``draws`` of the episode 0: other numbers of environments have played the earlier ones.
    """

    def __init__(self, config: TrainConfig, source: ContextSource, learner: Learner) -> None:
        self.config, self.source, self.learner = config, source, learner
        self.draws = RandomSchedule(source, config.seed)
        self.levels: PrioritizedLevelReplay | None = None
        if config.levels.draw == "prioritised":
            self.levels = PrioritizedLevelReplay(self.draws, config.levels, config.seed)
        self.frames = self.batches = self.episodes = 0
        self.seconds = 0.0
        self.environments: dict[str, Any] = {}
        self.histories, self.first_episode = EpisodeHistories.fresh(config.environments), 0
        self._saved: dict[str, Any] | None = None
        self._forgets = False

    def restore(self, state: dict[str, Any], path: Path) -> None:
        """Go on from a checkpoint: with its weights and random generators, and in the middle of its episodes.

        With another number of environments than before, the episodes in progress are left out.

        Args:
            state: of the checkpoint.
            path: its file, for messages.
        """
        with reading(path):
            self.learner.load_state_dict(state)
            if self.levels is not None:
                self.levels.load_state_dict(state["levels"])
            self.frames, self.batches, self.episodes = state["frames"], state["batches"], state["episodes"]
            self.seconds, self.first_episode = state["seconds"], state["first_episode"]
            self._restore_episodes(state["environments"], EpisodeHistories.from_state(state["histories"]))
        self._saved = state

    def _restore_episodes(self, environments: dict[str, Any], histories: EpisodeHistories) -> None:
        """Take up the episodes in progress: on the twin from its state, on SUMO by replaying their commands."""
        if not environments:
            if len(histories.histories) == len(self.histories.histories):
                self.histories = histories
            else:
                self._forget_episodes(histories.next_episode)
            return
        same_number = len(environments["episodes"]) == self.config.environments
        if same_number and is_own_state(environments):
            self.environments = environments
            return
        self._forget_episodes(max(environments["next_episodes"]))
        if same_number:
            print("Another user or version of izoo saved the episodes in progress, left out here.", flush=True)

    def _forget_episodes(self, later: int) -> None:
        """Leave the episodes in progress out; ``later`` is the first that has not begun."""
        self._forgets = True
        if self.levels is not None:
            self.levels.forget_episodes()
        else:
            self.first_episode += later

    def in_progress(self) -> Sequence[EpisodeHistory]:
        """Return the episodes in progress of environments in processes, which a resumed run plays again."""
        return self.histories.histories if self._saved is not None else ()

    def load(self, batches: BatchSource | None) -> None:
        """Load the learner's state from the checkpoint again, since making a collector tries the policy out."""
        if self._saved is None:
            return
        self.learner.load_state_dict(self._saved)
        if self._forgets and self.learner.decisions is not None:
            self.learner.decisions.open = None
        if batches is not None:
            batches.synchronise(self.learner.policy)
        self._saved = None

    def schedule(self) -> Schedule:
        """Return the training episodes by their number."""
        if self.levels is not None:
            return self.levels
        schedule: Schedule = self.draws
        if self.first_episode:
            schedule = functools.partial(later, schedule, self.first_episode)
        blocks = self.config.algo.candidates
        return functools.partial(shared, schedule, self.config.environments, blocks) if blocks > 1 else schedule

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint holds besides the number of frames."""
        return {
            **self.learner.state_dict(),
            "batches": self.batches,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "first_episode": self.first_episode,
            "histories": self.histories.state_dict(),
            "levels": {} if self.levels is None else self.levels.state_dict(),
            "environments": self.environments,
        }
