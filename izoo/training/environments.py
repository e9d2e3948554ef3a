"""Environments as the training loop needs them: an episode's metrics travel as one leaf, :data:`TOTALS`.

Metrics matter once per episode, but every leaf of a step costs time in each of TorchRL's passes over it. For the same
reason the group of vehicles, where it is emitted, is what critics look at (:mod:`izoo.algos.networks.fleet_features`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from izoo.algos.learners.base import EPISODES, Keys
from izoo.algos.networks import fleet_features
from izoo.envs import simulator_of
from izoo.envs.env import EcoDrivingBase, EcoDrivingEnv
from izoo.envs.mdp.frame import TOTALS
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.training import command_replay
from izoo.training.prioritized_level_replay import PrioritizedLevelReplay


class _Training(EcoDrivingBase):
    """Adds :data:`TOTALS` to what an environment emits, and plays episodes in progress up to where they stood.

    Args:
        histories: one per environment; the first reset plays them up to where they stood. None: episodes begin anew.
    """

    leaves: tuple[str, ...] = (TOTALS,)

    def __init__(self, *args: Any, histories: Sequence[command_replay.EpisodeHistory] = (), **options: Any) -> None:
        super().__init__(*args, **options)
        self._histories = tuple(histories)
        self.observation_spec[TOTALS] = Unbounded(self.reader.tensors[TOTALS].shape)
        if "vehicles" in self.config.emit:
            self.reader.vehicle_names = fleet_features.COLUMNS
            group = self.observation_spec["vehicles"]
            kept = {name: group[name] for name in fleet_features.COLUMNS}
            self.observation_spec["vehicles"] = Composite(kept, shape=group.shape)

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        histories, self._histories = self._histories, ()
        return self._replay(histories) if histories else super()._reset(tensordict, **options)

    def _replay(self, histories: Sequence[command_replay.EpisodeHistory]) -> TensorDictBase:
        """Play episodes up to where they stood; all get there at the same time.

        Until a shorter one begins, its environment plays a part of the same episode that is then forgotten.
        """
        slots = self.config.num_agents
        names = next((list(history.commands) for history in histories if history.commands), ["action"])
        episodes = torch.tensor([history.episode for history in histories]).view(*self.batch_size, 1)
        longest = max(map(len, histories))
        frame = super()._reset(episode=episodes)
        for step in range(longest):
            starting = torch.tensor([len(history) == longest - step for history in histories])
            if step > 0 and starting.any():
                frame = super()._reset(self._only(starting), episode=episodes)
            masks = frame.get(("agents", "mask")).view(-1, slots)
            idle = command_replay.idle(names, slots, self.config.action_size)
            begun = [step - longest + len(history) for history in histories]
            rows = [
                history.at(own, mask) if own >= 0 else idle
                for history, own, mask in zip(histories, begun, masks, strict=True)
            ]
            frame = self._step(command_replay.with_commands(frame, rows)).exclude(("agents", "reward"))
            if frame.get("done").any():
                raise RuntimeError("a simulation was lost while its episode was played again; resume the run once more")
        # A history without steps is of an episode that was about to begin.
        unbegun = torch.tensor([len(history) == 0 for history in histories])
        if longest > 0 and unbegun.any():
            frame = super()._reset(self._only(unbegun), episode=episodes)
        self._next_episode[:] = [history.episode + self._stride for history in histories]
        return frame

    def _only(self, chosen: Tensor) -> TensorDict:
        """Return what resets the environments ``chosen [N]`` alone."""
        return TensorDict({"_reset": chosen.view(*self.batch_size, 1)}, self.batch_size)


class TrainingEnv(_Training, EcoDrivingEnv):
    """:class:`~izoo.envs.EcoDrivingEnv` with :data:`TOTALS` and histories."""


class TrainingBatchEnv(_Training):
    """Environments that step side by side in this process, with :data:`TOTALS` and :data:`EPISODES`.

    Args:
        keeps: keys of a step that a batch needs; ``None``: all. The policy sees everything.
        state: of a run that goes on (:meth:`~izoo.envs.TwinEnv.state_dict`); the first reset returns to it.
        phases: ``[N]`` uncommanded decisions at the beginning of each environment's first episode; ``None``:
            episodes begin, and so end, together.
    """

    leaves = (TOTALS, EPISODES)

    def __init__(
        self,
        *args: Any,
        state: Mapping[str, Any] | None = None,
        phases: Sequence[int] | None = None,
        keeps: Keys | None = None,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._left_at, self._phases = state, phases
        self.keeps = keeps
        self.observation_spec[EPISODES] = Unbounded(self.reader.tensors[EPISODES].shape, dtype=torch.int64)

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        state, phases = self._left_at, self._phases
        self._left_at = self._phases = None
        if state:
            self.load_state_dict(state)
            return self.present()  # type: ignore[operator]
        frame = super()._reset(tensordict, **options)
        return frame if phases is None else self.advance(phases)  # type: ignore[operator]

    def _look_ahead(self) -> None:
        # Levels are drawn here and now: the thread that prepares the episodes would draw them at any time.
        if isinstance(self.schedule, PrioritizedLevelReplay):
            self.schedule.draw(self._next_episode.tolist())
        super()._look_ahead()  # type: ignore[misc]


@functools.cache
def training_class(simulator: str) -> Any:
    """Return the class of a simulator's environments side by side, with what training needs."""
    chosen = simulator_of(simulator)
    several = chosen.environments()
    return type(f"Training{several.__name__}", (TrainingBatchEnv if chosen.batched else _Training, several), {})


def random_phases(num_envs: int, decisions: int, seed: int) -> list[int]:
    """Return how many decisions of its first episode each environment skips: evenly spread, in random order."""
    order = torch.randperm(num_envs, generator=torch.Generator().manual_seed(seed))
    return (order * decisions // num_envs).tolist()


def split_totals(totals: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return per-episode metrics ``[n]`` and per-approach metrics ``[n, P]``, by name, of ``totals [n, E + P * M]``."""
    episode = totals[:, : len(EPISODE_METRICS)].unbind(-1)
    approach = totals[:, len(EPISODE_METRICS) :].unflatten(-1, (-1, len(APPROACH_METRICS))).unbind(-1)
    return dict(zip(EPISODE_METRICS, episode, strict=True)), dict(zip(APPROACH_METRICS, approach, strict=True))
