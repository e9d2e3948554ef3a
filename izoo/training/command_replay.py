"""Episodes in progress: what was commanded in them so far, so that a resumed run can play them again.

A context, a seed and the commands determine a trajectory. So a checkpoint need not hold the state of the simulators,
which SUMO saves with less than full precision: the number of each running episode and its commands are enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.learners.base import MASK
from izoo.envs.frame_io import COMMANDS
from izoo.errors import IzooError


@dataclass
class EpisodeHistory:
    """An episode in progress.

    Attributes:
        episode: its number in the schedule.
        counts: ``[steps]``: controlled vehicles per step.
        commands: by the names of :data:`~izoo.envs.frame_io.COMMANDS`, ``[counts.sum()]``: step after step, by
            ascending slot; of actions ``[counts.sum(), D]``. What a policy does not write is absent.
    """

    episode: int
    counts: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    commands: dict[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        """Steps since the episode began."""
        return len(self.counts)

    def append(self, steps: TensorDictBase) -> None:
        """Add consecutive ``steps [T]`` of the episode."""
        mask = steps.get(MASK)
        self.counts = torch.cat([self.counts, mask.sum(-1)])
        for name, key in COMMANDS.items():
            leaf = steps.get(key, None)
            if leaf is not None:
                new = _of_slots(name, leaf, mask)[mask]
                self.commands[name] = torch.cat([self.commands[name], new]) if name in self.commands else new.clone()

    def at(self, step: int, mask: Tensor) -> dict[str, Tensor]:
        """Return the commands ``[A]`` of a step, by name; of actions ``[A, D]``.

        Args:
            step: counted from the beginning of the episode.
            mask: ``[A]``: slots that hold a controlled vehicle now.

        Raises:
            IzooError: there are other vehicles than when the commands were given.
        """
        first = int(self.counts[:step].sum())
        last = first + int(self.counts[step])
        if int(mask.sum()) != last - first:
            raise IzooError(
                f"episode {self.episode} does not repeat itself: {int(mask.sum())} controlled vehicles at step {step}, "
                f"{last - first} before. Another version of SUMO or of izoo, or changed data, must have trained this "
                "run; train anew, or give another num_workers to leave the episodes in progress out."
            )
        rows = {name: values.new_zeros(len(mask), *values.shape[1:]) for name, values in self.commands.items()}
        for name, row in rows.items():
            row[mask] = self.commands[name][first:last]
        return rows


def _of_slots(name: str, leaf: Tensor, mask: Tensor) -> Tensor:
    """Return commands ``[*B, A]``, or actions ``[*B, A, D]``."""
    return leaf.reshape(*mask.shape, -1) if name == "action" else leaf.reshape(mask.shape)


def idle(names: Sequence[str], slots: int, action_size: int) -> dict[str, Tensor]:
    """Return commands of a step that is forgotten, while an environment waits for its episode to begin."""
    kinds = {"action": torch.float32, "defer": torch.bool, "lane_change": torch.int64}
    rows = {name: torch.zeros(slots, dtype=kinds[name]) for name in names}
    return rows | {"action": torch.ones(slots, action_size)}  # legal as accelerations and as speeds


def with_commands(frame: TensorDictBase, rows: Sequence[dict[str, Tensor]]) -> TensorDictBase:
    """Return ``frame [*B]`` with the commands of each environment, ready for a step."""
    frame = frame.copy()
    mask = frame.get(MASK)
    for name in rows[0]:
        frame.set(COMMANDS[name], _of_slots(name, torch.stack([row[name] for row in rows]), mask))
    return frame


class EpisodeHistories:
    """Follows the episodes in progress of ``N`` environments from the batches that they yield.

    Args:
        histories: where the environments stand; environment ``k`` plays every ``N``-th episode from there on.
    """

    def __init__(self, histories: Sequence[EpisodeHistory]) -> None:
        self.histories = list(histories)

    @classmethod
    def fresh(cls, num_envs: int) -> EpisodeHistories:
        """Return the state before the first step: environment ``k`` begins episode ``k``."""
        return cls([EpisodeHistory(number) for number in range(num_envs)])

    def add(self, batch: TensorDictBase) -> None:
        """Add a batch ``[N, T]`` of consecutive steps."""
        done = batch.get(("next", "done")).reshape(batch.shape)
        for index, history in enumerate(self.histories):
            ends = done[index].nonzero().view(-1)
            begun = 0
            if len(ends) > 0:
                begun = int(ends[-1]) + 1
                history = self.histories[index] = EpisodeHistory(history.episode + len(ends) * len(self.histories))
            if begun < batch.shape[1]:
                history.append(batch[index, begun:])

    @property
    def next_episode(self) -> int:
        """The first episode number that no environment has reached yet."""
        return max(history.episode for history in self.histories) + 1

    def state_dict(self) -> list[dict[str, Any]]:
        """Return the histories as dictionaries of tensors and numbers."""
        return [{**vars(history), "commands": dict(history.commands)} for history in self.histories]

    @classmethod
    def from_state(cls, state: list[dict[str, Any]]) -> EpisodeHistories:
        """Return what :meth:`state_dict` described."""
        return cls([EpisodeHistory(**entry) for entry in state])
