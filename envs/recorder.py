"""Frames straight into a batch: no TensorDict per step, and no stacking at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from izoo.envs.reader import COMMANDS, FrameReader
from izoo.errors import IzooError

Key = tuple[str, ...]


class BatchRecorder:
    """Writes what an environment emits, and what it is told, into a batch ``[*B, T]`` while it is collected.

    Args:
        reader: of the environment's frames.
        batch: with every leaf of a rollout, allocated. A recorder is good while the batch stays in its place.

    Attributes:
        frame: arrays ``[*B, ...]`` of the environment, by key: always the state to act on.
        commands: arrays ``[T, *B, A]`` of the batch, by the names of :data:`~izoo.envs.reader.COMMANDS`.
    """

    def __init__(self, reader: FrameReader, batch: TensorDictBase) -> None:
        self._reader, self._batch, self._place = reader, batch, _place(batch)
        self.frame = {key: leaf.numpy() for key, leaf in _leaves(reader.views()).items()}
        root = {key: _by_step(leaf, batch) for key, leaf in _leaves(batch.exclude("next", "collector")).items()}
        following = {key: _by_step(leaf, batch) for key, leaf in _leaves(batch.get("next")).items()}
        self._told = {key: rows for key, rows in root.items() if key not in self.frame}
        self._state = [(rows, self.frame[key]) for key, rows in root.items() if key in self.frame]
        self._following = [(rows, self.frame[key]) for key, rows in following.items()]
        dimensions = 1 + len(reader.agents_batch)
        self.commands = {
            name: rows if rows.ndim == dimensions else rows[..., 0]
            for name, rows in ((name, self._told.get(key)) for name, key in COMMANDS.items())
            if rows is not None
        }
        self._states: tuple[TensorDict, ...] = ()

    def serves(self, batch: TensorDictBase) -> bool:
        """Return whether this is the batch, still where it was."""
        return batch is self._batch and _place(batch) == self._place

    def state(self, step: int) -> TensorDict:
        """Return what is to be acted on in a step; its tensors are the batch's, what is set in it stays there."""
        if not self._states:
            self._states = self._batch.exclude("next", "collector", *self._told).unbind(-1)
        return _shallow(self._states[step])

    def told(self, keys: Sequence[Key]) -> dict[Key, np.ndarray]:
        """Return the arrays ``[T, *B, ...]`` of the batch that a policy which writes these keys has to fill.

        Raises:
            IzooError: a command of the environment is not among them.
        """
        self._reader.check_action(self._batch[..., 0].select(*keys))
        return {key: rows for key, rows in self._told.items() if key in keys}

    def by_calling(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[int], None]:
        """Return what calls a policy with the state of a step, and copies what it answers into the batch.

        Raises, when called:
            IzooError: the answer lacks a leaf of the batch, or has one of another shape.
        """

        def act(step: int) -> None:
            answer = policy(self.state(step))
            self._reader.check_action(answer)
            for key, rows in self._told.items():
                leaf = answer.get(key, None)
                if leaf is None or leaf.shape != rows.shape[1:]:
                    got = "missing" if leaf is None else f"of shape {list(leaf.shape)}"
                    raise IzooError(
                        f"{key} is {got} in what the policy answers; when collection began, it was of shape "
                        f"{list(rows.shape[1:])}, and it must be so in every step."
                    )
                rows[step] = leaf.numpy()

        return act

    def write_state(self, step: int) -> None:
        """Write the frames as the state to act on in a step; past the end of the batch there is no place for it."""
        if step < self._batch.shape[-1]:
            for rows, source in self._state:
                rows[step] = source

    def write_following(self, step: int) -> None:
        """Write the frames as what a step led to."""
        for rows, source in self._following:
            rows[step] = source


def _place(batch: TensorDictBase) -> int:
    return batch.get(("next", "done")).data_ptr()


def _shallow(tensordict: TensorDict) -> TensorDict:
    entries = tensordict._tensordict.items()
    own = {key: _shallow(value) if isinstance(value, TensorDict) else value for key, value in entries}
    return TensorDict._new_unsafe(own, batch_size=tensordict.batch_size)


def _leaves(tensordict: TensorDictBase) -> dict[Key, Tensor]:
    return {
        key if isinstance(key, tuple) else (key,): leaf
        for key, leaf in tensordict.items(include_nested=True, leaves_only=True)
    }


def _by_step(leaf: Tensor, batch: TensorDictBase) -> np.ndarray:
    """Return a leaf ``[*B, T, ...]`` of a batch as ``[T, *B, ...]``, in the same memory."""
    return leaf.movedim(batch.ndim - 1, 0).numpy()
