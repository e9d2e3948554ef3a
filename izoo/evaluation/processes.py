"""Worker processes that play episodes, each in its own environment; if one is lost, the error names its episode."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import traceback
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

import cloudpickle

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.sumo.worker import start_process
from izoo.errors import IzooError

ATTEMPTS = 2
"""How often an episode is begun before the loss of its worker process ends the evaluation."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Task:
    """An episode to play.

    Attributes:
        policy: key of the policy among those sent to the workers.
        name: the policy's name in the rows.
        context: as it is played (without CVs for human driving).
        seed: of the episode.
    """

    policy: str
    name: str
    context: Context
    seed: int

    def __str__(self) -> str:
        return f"policy {self.name}, context {self.context.name}, seed {self.seed}"


class EpisodeFailed(RuntimeError):
    """An episode raised an exception or lost its process; the message names its policy, context and seed."""


def play_all(
    tasks: Sequence[Task], policies: Mapping[str, bytes], config: EnvConfig, num_workers: int
) -> Iterator[tuple[Task, Rows]]:
    """Play episodes and yield them as they finish.

    Args:
        tasks: the episodes, in the order in which they are begun.
        policies: serialised policies by key.
        config: settings of the environments.
        num_workers: worker processes; 0 plays in this process.

    Raises:
        IzooError: an episode's input cannot be used (the message names the episode).
        EpisodeFailed: an episode failed otherwise.
    """
    if num_workers == 0:
        yield from _play_here(tasks, policies, config)
        return
    queue = deque((task, 1) for task in tasks)
    setup = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
    workers: list[_Worker] = []
    try:
        cloudpickle.dump((dict(policies), config), setup)
        setup.flush()
        workers.extend(_Worker(setup.fileno()) for _ in range(min(num_workers, len(tasks))))
        while queue or any(worker.current for worker in workers):
            for worker in workers:
                if worker.current is None and queue:
                    worker.begin(*queue.popleft())
            busy = {worker.connection: worker for worker in workers if worker.current}
            for ready in wait(list(busy)):
                worker = busy[ready]  # type: ignore[index]
                task, attempt = worker.current  # type: ignore[misc]
                rows = worker.finish()
                if rows is not None:
                    yield task, rows
                elif attempt < ATTEMPTS:
                    worker.close()
                    workers[workers.index(worker)] = _Worker(setup.fileno())
                    queue.appendleft((task, attempt + 1))
                else:
                    raise EpisodeFailed(f"{task}: the worker process died {ATTEMPTS} times ({worker.exit_text()}).")
    finally:
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.close()
        setup.close()


class _Worker:
    """The parent's side of a worker process; it starts at once and is idle until :meth:`begin`.

    Args:
        setup: descriptor of a file with the pickled policies and settings of the environment.
    """

    def __init__(self, setup: int) -> None:
        ours, child = socket.socketpair()
        call = f"from izoo.evaluation.processes import worker_main; worker_main({child.fileno()}, {setup})"
        self.process = start_process(call, child.fileno(), setup)
        child.close()
        self.connection = Connection(ours.detach())
        self.current: tuple[Task, int] | None = None

    def begin(self, task: Task, attempt: int) -> None:
        """Hand over an episode."""
        self.current = (task, attempt)
        with contextlib.suppress(OSError):  # a dead worker shows when its answer is read
            self.connection.send_bytes(cloudpickle.dumps(task))

    def finish(self) -> Rows | None:
        """Return the rows of the current episode; ``None`` where the process has died."""
        task, _ = self.current  # type: ignore[misc]
        self.current = None
        try:
            kind, content = self.connection.recv()
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)
            return None
        if kind == "refused":
            raise IzooError(f"{task}: {content}")
        if kind == "failed":
            raise EpisodeFailed(f"{task}: {content}")
        return content

    def exit_text(self) -> str:
        """How the process ended."""
        code = self.process.poll()
        if code is not None and code < 0:
            return f"signal {signal.Signals(-code).name}"
        return f"exit code {code}"

    def dismiss(self) -> None:
        """Ask the process to end, and do not wait for that."""
        with contextlib.suppress(OSError):
            self.connection.send_bytes(b"")
        self.connection.close()

    def close(self) -> None:
        """Ask the process to end, wait, and end it if it does not."""
        self.dismiss()
        try:
            self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def worker_main(descriptor: int, setup: int) -> None:
    """Play the episodes that the parent sends until it sends nothing or is gone.

    Args:
        descriptor: of the socket to the parent.
        setup: as for :class:`_Worker`; several processes read it, each from its start.
    """
    import torch

    torch.set_num_threads(1)
    connection = Connection(descriptor)
    player = Player(*cloudpickle.loads(os.pread(setup, os.fstat(setup).st_size, 0)))
    with contextlib.suppress(EOFError, OSError):
        while message := connection.recv_bytes():
            try:
                answer: tuple[str, Any] = ("rows", player.play(cloudpickle.loads(message)))
            except IzooError as error:
                answer = ("refused", str(error))
            except Exception as error:
                answer = ("failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
            connection.send(answer)
    player.close()


def _play_here(tasks: Sequence[Task], policies: Mapping[str, bytes], config: EnvConfig) -> Iterator[tuple[Task, Rows]]:
    player = Player(policies, config)
    try:
        for task in tasks:
            try:
                rows = player.play(task)
            except IzooError as error:
                raise IzooError(f"{task}: {error}") from error
            except Exception as error:
                raise EpisodeFailed(f"{task}: {type(error).__name__}: {error}") from error
            yield task, rows
    finally:
        player.close()


class Player:
    """An environment and the policies, unpacked when first needed."""

    def __init__(self, policies: Mapping[str, bytes], config: EnvConfig) -> None:
        # Imported here so that workers come up before torch and SUMO are loaded.
        from izoo.envs.env import EcoDrivingEnv

        self.env = EcoDrivingEnv(config=config)
        self._packed = policies
        self._policies: dict[str, Any] = {}

    def play(self, task: Task) -> Rows:
        from izoo.evaluation.playing import run_episode

        if task.policy not in self._policies:
            self._policies[task.policy] = cloudpickle.loads(self._packed[task.policy])
        return run_episode(self.env, self._policies[task.policy], task.name, task.context, task.seed)

    def close(self) -> None:
        self.env.close(raise_if_closed=False)
