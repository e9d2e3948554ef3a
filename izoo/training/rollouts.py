"""Collectors whose rollouts do per step only what izoo's environments and policies need."""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from queue import Empty
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.base import acts_in_place
from izoo.envs.env import EcoDrivingBase
from izoo.envs.recorder import BatchRecorder

CHECK_S = 1.0
"""How often a waiting parent checks that its processes are alive."""


class RolloutCollector(Collector):
    """TorchRL's collector with a shorter loop; the batches are the same.

    It expects everything on the CPU, and no replay buffer. An environment that is not izoo's own, such as one with
    transforms around it, is stepped as TorchRL does. Else frames are copied straight into the
    batch, whose memory the next batch re-uses; a policy that has a method ``in_place``
    (:class:`izoo.algos.base.InPlace`) reads and writes there without TensorDicts.

    Args:
        batches: ``[N, *B, T]``: memory for the batch of each of ``N`` collectors; ``None``: memory of its own.
        worker_idx: which of them it is.
    """

    def __init__(
        self, *args: Any, batches: TensorDictBase | None = None, worker_idx: int | None = None, **options: Any
    ) -> None:
        self._given = None if batches is None else batches[worker_idx or 0]
        self._recorder: BatchRecorder | None = None
        super().__init__(*args, worker_idx=worker_idx, **options)

    def _maybe_make_final_rollout(self, make_rollout: bool) -> None:
        super()._maybe_make_final_rollout(make_rollout)
        if self._given is not None:
            self._final_rollout = self._given

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Collect ``frames_per_batch`` steps; the batch ``[*B, T]`` is valid until the next call."""
        if not isinstance(self.env, EcoDrivingBase):  # transforms around it have their say in every step
            return super().rollout()
        batch: TensorDictBase = self._final_rollout
        policy, env, recorder = self._wrapped_policy, self.env, self._recorder
        if recorder is None or not recorder.serves(batch):
            recorder = self._recorder = BatchRecorder(env.reader, batch)
        env.require_started()
        recorder.write_state(0)
        with set_exploration_type(self.exploration_type):
            if acts_in_place(policy):
                act = policy.in_place(recorder.frame, recorder.told(policy.out_keys))
            else:
                act = recorder.by_calling(policy)
            for step in range(self.frames_per_batch):
                act(step)
                env.step_recorded(recorder, step)
        return batch


class ProcessesCollector(MultiSyncCollector):
    """TorchRL's collector with a process per environment; all of them write into one batch ``[N, T]``.

    Each process is a :class:`RolloutCollector`. The batch is valid until the next one is asked for.

    Args:
        makers: of the environments, one per process.
        policy: what acts in all of them.
        example: such an environment; it is not started.
        frames_per_batch: ``N * T``.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], EnvBase]],
        policy: TensorDictModuleBase,
        example: EnvBase,
        frames_per_batch: int,
    ) -> None:
        self._batch = _empty_batch(example, policy, len(makers), frames_per_batch // len(makers)).share_memory_()
        collector = functools.partial(RolloutCollector, batches=self._batch)
        super().__init__(
            makers,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            auto_register_policy_transforms=False,
            collector_class=collector,
        )

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield the batch again and again, each time with new steps.

        Raises:
            RuntimeError: a process has ended.
        """
        while True:
            self._require_alive()
            for pipe in self.pipes:
                # What is sent to a process that ends right now is lost; the wait below notices.
                with contextlib.suppress(OSError):
                    pipe.send((None, "continue"))
            collecting = self.num_workers
            while collecting > 0:
                try:
                    self.queue_out.get(timeout=CHECK_S)
                    collecting -= 1
                except Empty:
                    self._require_alive()
            self._iter += 1
            self._frames += self._batch.numel()
            yield self._batch

    def _require_alive(self) -> None:
        for number, process in enumerate(self.procs):
            if not process.is_alive():
                raise RuntimeError(
                    f"process {number} of {self.num_workers} that collect has ended (exit code {process.exitcode}); "
                    "what it wrote before says why, unless it was killed"
                )


def _empty_batch(env: EnvBase, policy: TensorDictModuleBase, workers: int, steps: int) -> TensorDict:
    """Return a batch ``[workers, steps]`` of zeros, with what an environment emits and what a policy adds."""
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        step = env.fake_tensordict()
        answer = copy.deepcopy(policy)(step.copy())
    for key in policy.out_keys:
        step.set(key, answer.get(key))
    return step.expand(workers, steps).clone().zero_()
