"""Several environments on SUMO: a process each, frames in shared memory, one wait per step."""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import weakref
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from izoo.envs.backend import CLOSED, Play, clear_ended, scene_from_frame
from izoo.envs.config import MAX_WORKERS, EnvConfig
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.sumo.worker import POLL_S, Worker, WorkerLost, may_poll, shared_memory_file
from izoo.errors import IzooError, check_whole
from izoo.networks.net.build import build_nets

_log = logging.getLogger("izoo")

KEPT = ("observation", "mask", "agent_vehicle")
"""Arrays of a lost worker's frame that are restored to their values before the step."""


class SumoWorkers:
    """A :class:`~izoo.envs.backend.Backend` of ``N`` environments, each simulated by a process of its own.

    A worker that dies or hangs is replaced; the others are not affected. Workers start with their first episode.

    Args:
        config: the environments' settings.
        num_workers: ``N``.
        poll: poll for their answers, where a core is free for that.

    Attributes:
        frames: the arrays ``[N, ...]`` that workers and parent share.
        restarts: number of lost workers that were replaced.
    """

    def __init__(self, config: EnvConfig, num_workers: int, poll: bool = True) -> None:
        check_whole("num_workers", num_workers, 1, MAX_WORKERS)
        self.config, self.num_workers, self.restarts = config, num_workers, 0
        self._memory = shared_memory_file(frame_bytes(config, num_workers))
        self.frames = map_frames(mmap.mmap(self._memory, 0), config, num_workers)
        self._before = {name: np.empty_like(self.frames[name]) for name in KEPT}
        self._workers: list[Worker | None] = [None] * num_workers
        self._plays: list[Play | None] = [None] * num_workers
        self._poll_s = [POLL_S * (poll and may_poll(index, num_workers)) for index in range(num_workers)]
        self._finalizer = weakref.finalize(self, _close, self._workers, self._memory, os.getpid())

    @property
    def started(self) -> bool:
        """Whether every environment has begun an episode."""
        return not self.closed and None not in self._plays

    @property
    def closed(self) -> bool:
        """Whether all workers were ended permanently."""
        return not self._finalizer.alive

    def _worker(self, index: int) -> Worker:
        worker = self._workers[index]
        if worker is not None and worker.episodes >= self.config.recycle_episodes:
            worker.close()
            worker = None
        if worker is None:
            setup = (self.config, index, self.num_workers)
            worker = self._workers[index] = Worker(self._memory, setup, self.config.watchdog_s)
        return worker

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin episodes in parallel; a worker that is lost meanwhile gets a second try."""
        if self.closed:
            raise IzooError(CLOSED)
        with contextlib.suppress(IzooError):  # raised again by the worker that needs the net
            build_nets([play.context.intersection for play in plays.values()])
        for attempt in range(2):
            lost: dict[int, WorkerLost] = {}
            try:
                for index, play in plays.items():
                    self._plays[index] = None
                    try:
                        self._worker(index).begin(play)
                    except WorkerLost as error:
                        lost[index] = error
                self._collect([index for index in plays if index not in lost], lost)
            except BaseException:
                self._end_busy()
                raise
            for index in plays.keys() - lost.keys():
                self._plays[index] = plays[index]
            for index, reason in lost.items():
                self._replace(index, reason)
            for index, reason in lost.items():
                if attempt == 1:
                    number = plays[index].number
                    raise RuntimeError(f"worker {index} was lost twice while starting episode {number}: {reason}")
            plays = {index: plays[index] for index in lost}

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Simulate one step of every environment; return those whose worker was lost, of whose frames only
        :data:`KEPT` is valid."""
        ended = clear_ended(self.config, self.frames)
        lost: dict[int, WorkerLost] = {}
        waiting: list[int] = []
        for name, before in self._before.items():
            np.copyto(before, self.frames[name])
        try:
            # The first worker last: it may need this core, which is freed by the first wait.
            for index in np.flatnonzero(~ended)[::-1].tolist():
                try:
                    self._workers[index].step()  # type: ignore[union-attr]
                    waiting.insert(0, index)
                except WorkerLost as error:
                    lost[index] = error
            self._collect(waiting, lost, meanwhile)
        except BaseException:
            self._end_busy()
            self._plays[:] = [None] * self.num_workers  # others have moved, so the step cannot be repeated
            raise
        for index, reason in lost.items():
            self._replace(index, reason)
            for name, before in self._before.items():
                self.frames[name][index] = before[index]
        return tuple(lost)

    def _end_busy(self) -> None:
        """Kill the workers whose answer is outstanding when a step or reset is interrupted, as by Ctrl-C."""
        for index, worker in enumerate(self._workers):
            if worker is not None and worker.busy:
                worker.kill()
                self._workers[index] = self._plays[index] = None

    def _collect(
        self, waiting: list[int], lost: dict[int, WorkerLost], meanwhile: Callable[[], None] | None = None
    ) -> None:
        """Wait for all workers, even if one of them fails; then raise the first failure."""
        failures: list[Exception] = []
        for index in waiting:
            try:
                self._workers[index].wait(self._poll_s[index], meanwhile)  # type: ignore[union-attr]
            except WorkerLost as error:
                lost[index] = error
            except (IzooError, RuntimeError) as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def _replace(self, index: int, reason: Exception) -> None:
        _log.warning("simulation worker %d is replaced: %s", index, reason)
        worker = self._workers[index]
        if worker is not None:
            worker.kill()
        self._workers[index] = None
        self.restarts += 1
        self._worker(index)

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment, from its frame."""
        play = self._plays[index]
        if play is None:
            raise IzooError("no episode has begun; call reset() first.")
        return scene_from_frame(self.config, play.context, row_of(self.frames, index))

    def close(self) -> None:
        """End all workers."""
        self._finalizer()
        self._plays[:] = [None] * self.num_workers


def _close(workers: list[Worker | None], memory: int, owner: int) -> None:
    if os.getpid() != owner:
        return  # a forked process ends; the workers belong to its parent
    for worker in workers:
        if worker is not None:
            worker.dismiss()
    for index, worker in enumerate(workers):
        if worker is not None:
            worker.close()
            workers[index] = None
    os.close(memory)
