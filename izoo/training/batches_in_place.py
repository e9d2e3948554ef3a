"""Batches from environments side by side: every thread acts for, steps and records its own."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.networks.compiled_mlp import acting_together
from izoo.cores import one_torch_thread
from izoo.envs.frame_copies import BatchBuffer
from izoo.training.environments import TrainingBatchEnv

Key = str | tuple[str, ...]


class BatchesInPlace:
    """Endless batches ``[N, T]`` of consecutive steps of one environment, each valid until the next one.

    What the environment emits is written to its place in the batch by the threads that step. Where an algorithm names
    the keys that it learns from (:attr:`TrainingBatchEnv.keeps`), these alone are kept of each step.

    Args:
        env: the environments.
        policy: what acts; its parameters may change in place between batches.
        steps: ``T``.
    """

    def __init__(self, env: TrainingBatchEnv, policy: TensorDictModuleBase, steps: int) -> None:
        self.env, self._policy, self._steps = env, policy, steps
        self._buffer: BatchBuffer | None = None
        if env.keeps is None:
            self._buffer = env.reader.outlet = BatchBuffer(env.reader.layout, steps)
        self._state: TensorDictBase | None = None
        self._acted: dict[Key, Tensor] = {}

    def next(self) -> TensorDictBase:
        """Play on, and return the next batch."""
        env = self.env
        kept = []
        exploring = set_exploration_type(ExplorationType.RANDOM)
        together = acting_together(env.batch_size.numel(), env.share_out)
        with torch.no_grad(), one_torch_thread(), exploring, together:
            state = env.reset() if self._state is None else self._state
            for step in range(self._steps):
                given = dict(state.items(True, True)) if step == 0 else {}
                state = self._policy(state)
                if step == 0:
                    self._make_room(state, given)
                if self._buffer is not None:
                    for key, values in self._acted.items():
                        values[step] = state.get(key)
                stepped, state = env.step_and_maybe_reset(state)
                if env.keeps is not None:
                    kept.append(stepped.select(*env.keeps))
            self._state = state
        return TensorDict.maybe_dense_stack(kept, 1) if self._buffer is None else self._whole(self._buffer)

    def _make_room(self, state: TensorDictBase, given: dict[Key, Tensor]) -> None:
        """Make room for what the policy writes, ``[T, N, ...]`` by key."""
        for key, value in state.items(True, True):
            if value is not given.get(key) and (key not in self._acted or self._acted[key].shape[1:] != value.shape):
                self._acted[key] = value.new_empty((self._steps, *value.shape))

    def _whole(self, buffer: BatchBuffer) -> TensorDictBase:
        """Return what the buffer holds and the policy wrote."""
        led_to, acted_on = buffer.batch()
        size = torch.Size((self._steps, self.env.batch_size.numel()))
        batch = self.env.reader.assemble(acted_on, size)[1]
        for key, values in self._acted.items():
            batch.set(key, values)
        return batch.set("next", self.env.reader.assemble(led_to, size)[0]).transpose(0, 1)
