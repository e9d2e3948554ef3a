"""Several environments at once: one worker process each, one batch, one wait per step."""

from __future__ import annotations

import mmap
import os
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl._utils import logger

from izoo.emissions.weights import load_weights
from izoo.envs.config import EnvConfig
from izoo.envs.env import Contexts, EcoDrivingBase
from izoo.envs.layout import frame_bytes
from izoo.envs.sumo.worker import AWAKE_S, Worker, WorkerLost, shared_memory_file, stays_awake
from izoo.errors import IzooError


class SumoParallelEnv(EcoDrivingBase):
    """``N`` intersections, each simulated by a process of its own; batch size ``[N]``.

    It offers what TorchRL's ``ParallelEnv`` does and replaces its inside: workers write their frames into shared
    arrays, the parent stays awake for them only where it has a core for that, and a worker that dies or hangs is
    replaced alone: its step is reported as truncated, with the observation it last had, and the others do not notice.
    Workers start at the first reset.

    Args:
        num_workers: ``N``.
        contexts, config, seed: as for :class:`~izoo.envs.EcoDrivingEnv`; the ``N`` workers share the schedule.
    """

    def __init__(
        self,
        num_workers: int = 2,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig | None = None,
        seed: int = 0,
    ) -> None:
        if num_workers < 1:
            raise IzooError(f"num_workers is {num_workers}; one worker or more is needed.")
        config = config or EnvConfig()
        if config.gui:
            raise IzooError("env.gui works with one environment only; use EcoDrivingEnv (collector=single).")
        self._memory = shared_memory_file(frame_bytes(config, num_workers))
        super().__init__(contexts, config, seed, [num_workers], mmap.mmap(self._memory, 0))
        self.num_workers = num_workers
        self.restarts = 0
        self._restart_episodes()
        self._workers: list[Worker | None] = [None] * num_workers
        self._awake_s = [AWAKE_S * stays_awake(index, num_workers) for index in range(num_workers)]
        self._started = False
        self._finalizer = weakref.finalize(self, _close, self._workers, self._memory)

    def _restart_episodes(self) -> None:
        self._next_episode = np.arange(self.num_workers)

    def _worker(self, index: int) -> Worker:
        worker = self._workers[index]
        if worker is not None and worker.episodes >= self.config.recycle_episodes:
            worker.close()
            worker = None
        if worker is None:
            setup = (self.config, index, self.num_workers, load_weights())
            worker = self._workers[index] = Worker(self._memory, setup, self.config.watchdog_s)
        return worker

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        if not self._finalizer.alive:
            raise IzooError("this SumoParallelEnv is closed; make another one.")
        if options:
            raise IzooError(
                f"SumoParallelEnv.reset() does not take {', '.join(options)}; give contexts= to the constructor, or "
                "('context', 'episode') per environment in the tensordict."
            )
        requested = None if tensordict is None else tensordict.get(("context", "episode"), None)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = range(self.num_workers) if mask is None else torch.nonzero(mask.view(-1)).view(-1).tolist()
        plan = {}
        for index in chosen:
            if requested is not None:
                plan[index] = int(requested[index])
            else:
                plan[index] = int(self._next_episode[index])
                self._next_episode[index] += self.num_workers
        self._begin_episodes(plan)
        return self._frame()

    def _begin_episodes(self, plan: dict[int, int]) -> None:
        """Start the planned episodes ``{worker: episode}`` side by side; a worker lost meanwhile gets a second try."""
        for attempt in range(2):
            lost: dict[int, WorkerLost] = {}
            try:
                for index, episode in plan.items():
                    try:
                        self._worker(index).reset(*self.schedule(episode), episode)
                    except WorkerLost as error:
                        lost[index] = error
                self._collect([index for index in plan if index not in lost], lost)
            except BaseException:
                self._end_busy()
                raise
            for index, reason in lost.items():
                self._replace(index, reason)
            for index, reason in lost.items():
                if attempt == 1:
                    raise RuntimeError(f"worker {index} was lost twice while starting episode {plan[index]}: {reason}")
            plan = {index: plan[index] for index in lost}
        self._started = True

    def _end_busy(self) -> None:
        """End the workers that still owe an answer where a step or reset breaks off, as at Ctrl-C."""
        for index, worker in enumerate(self._workers):
            if worker is not None and worker.busy:
                worker.kill()
                self._workers[index] = None
                self._started = False

    def _collect(self, waiting: list[int], lost: dict[int, WorkerLost]) -> None:
        """Wait for every worker, also when one of them fails; then raise the first failure."""
        failures: list[Exception] = []
        for index in waiting:
            try:
                self._workers[index].wait(self._awake_s[index], self.reader.prepare)  # type: ignore[union-attr]
            except WorkerLost as error:
                lost[index] = error
            except (IzooError, RuntimeError) as error:
                failures.append(error)
        if failures:
            raise failures[0]

    @property
    def started(self) -> bool:
        """Whether the episodes are running."""
        return self._started

    def _advance(self, state: Callable[[], TensorDictBase]) -> None:
        lost: dict[int, WorkerLost] = {}
        waiting: list[int] = []
        try:
            # The first is asked last: it may have to wait for this core, which is given up with the first wait.
            for index in reversed(range(self.num_workers)):
                try:
                    self._workers[index].step()  # type: ignore[union-attr]
                    waiting.insert(0, index)
                except WorkerLost as error:
                    lost[index] = error
            self._collect(waiting, lost)
        except BaseException:
            self._end_busy()
            raise
        for index, reason in lost.items():
            self._replace(index, reason)
            self._truncate(index, state())

    def _replace(self, index: int, reason: Exception) -> None:
        logger.warning("simulation worker %d is replaced: %s", index, reason)
        worker = self._workers[index]
        if worker is not None:
            worker.kill()
        self._workers[index] = None
        self.restarts += 1
        self._worker(index)

    def _truncate(self, index: int, tensordict: TensorDictBase) -> None:
        """Report a lost step: the state before it, truncated, without reward; nothing was measured (0 steps)."""
        row = {name: array[index] for name, array in self.frames.items()}
        row["observation"][:] = tensordict.get(("agents", "observation"))[index].numpy()
        row["mask"][:] = tensordict.get(("agents", "mask"))[index].numpy()
        row["agent_vehicle"][:] = tensordict.get(("agents", "vehicle"))[index].numpy()
        row["agent_truncated"][:] = row["mask"]
        row["agent_done"][:] = row["mask"]
        row["agent_terminated"][:] = 0
        row["reward"][:] = 0.0
        row["reward_vector"][:] = 0.0
        row["totals"][:] = 0.0
        row["terminated"][:] = 0
        row["truncated"][:] = 1
        row["done"][:] = 1

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End all workers."""
        self._finalizer()
        self._started = False
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)


def _close(workers: list[Worker | None], memory: int) -> None:
    for worker in workers:
        if worker is not None:
            worker.dismiss()
    for index, worker in enumerate(workers):
        if worker is not None:
            worker.close()
            workers[index] = None
    os.close(memory)
