"""Worker processes that play episodes, each in its own environment; if one is lost, the error names its episode."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

import cloudpickle

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.sumo.worker import start_process
from izoo.errors import IzooError

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from izoo.evaluation.playing import Policy

STARTUP_S = 300.0
"""How long a process may take before its first step: it imports PyTorch, and may have to compile."""
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
    tasks: Sequence[Task],
    policies: Mapping[str, bytes],
    config: EnvConfig,
    num_workers: int,
    simulator: str = "sumo",
) -> Iterator[tuple[Task, Rows]]:
    """Play episodes and yield them as they finish.

    Args:
        tasks: the episodes, in the order in which they are begun.
        policies: serialised policies by key.
        config: settings of the environments.
        num_workers: worker processes; 0 plays in this process.
        simulator: ``sumo`` or ``twin``.

    Raises:
        IzooError: an episode's input cannot be used (the message names the episode).
        EpisodeFailed: an episode failed otherwise.
    """
    if num_workers == 0:
        yield from _play_here(tasks, policies, config, simulator)
        return
    queue = deque((task, 1) for task in tasks)
    setup = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
    workers: list[_Worker] = []
    try:
        cloudpickle.dump((dict(policies), config, simulator), setup)
        setup.flush()
        workers.extend(_Worker(setup.fileno(), config.watchdog_s) for _ in range(min(num_workers, len(tasks))))
        while queue or any(worker.current for worker in workers):
            for worker in workers:
                if worker.current is None and queue:
                    worker.begin(*queue.popleft())
            busy = {worker.connection: worker for worker in workers if worker.current}
            ready = wait(list(busy), max(min(worker.patience_left_s() for worker in busy.values()), 0.0))
            for connection, worker in busy.items():
                task, attempt = worker.current  # type: ignore[misc]
                if connection in ready:
                    heard = worker.hear()
                elif worker.patience_left_s() > 0.0:
                    continue
                else:
                    heard = Lost(f"no answer for {worker.patience_s:g} s")
                if isinstance(heard, list):
                    yield task, heard
                elif heard is not None and attempt == ATTEMPTS:
                    raise EpisodeFailed(f"{task}: the worker process was lost {ATTEMPTS} times ({heard.reason}).")
                elif heard is not None:
                    worker.kill()
                    workers[workers.index(worker)] = _Worker(setup.fileno(), config.watchdog_s)
                    queue.appendleft((task, attempt + 1))
    finally:
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.close()
        setup.close()


@dataclass(frozen=True)
class Lost:
    """A worker process has ended, or has not been heard of for too long."""

    reason: str


class _Worker:
    """The parent's side of a worker process; it starts at once and is idle until :meth:`begin`.

    Args:
        setup: descriptor of a file with the pickled policies and settings of the environment.
        watchdog_s: for how long a process that plays may not be heard of.

    Attributes:
        current: what it plays, and which attempt that is.
        patience_s: how long it may be silent now: longer at first, while it imports and perhaps compiles.
    """

    def __init__(self, setup: int, watchdog_s: float) -> None:
        ours, child = socket.socketpair()
        call = f"from izoo.evaluation.processes import worker_main; worker_main({child.fileno()}, {setup})"
        self.process = start_process(call, child.fileno(), setup)
        child.close()
        self.connection = Connection(ours.detach())
        self.current: tuple[Task, int] | None = None
        self._watchdog_s, self.patience_s = watchdog_s, max(watchdog_s, STARTUP_S)
        self._heard_s = time.monotonic()

    def patience_left_s(self) -> float:
        """For how long it may still be silent."""
        return self._heard_s + self.patience_s - time.monotonic()

    def begin(self, task: Task, attempt: int) -> None:
        """Hand over an episode."""
        self.current = (task, attempt)
        self._heard_s = time.monotonic()
        with contextlib.suppress(OSError):  # a dead worker shows when its answer is read
            self.connection.send_bytes(cloudpickle.dumps(task))

    def hear(self) -> Rows | Lost | None:
        """Return the rows of the current episode, or that the process has ended; ``None``: it plays on."""
        task, _ = self.current  # type: ignore[misc]
        try:
            kind, content = self.connection.recv()
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)
            return Lost(self.exit_text())
        self._heard_s, self.patience_s = time.monotonic(), self._watchdog_s
        if kind == "plays":
            return None
        self.current = None
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

    def kill(self) -> None:
        """End the process at once, also where it is stopped."""
        self.current = None
        self.connection.close()
        self.process.kill()
        self.process.wait()

    def dismiss(self) -> None:
        """Ask the process to end, and do not wait for that; one that still plays is ended, nobody waits for it."""
        if self.current is not None:
            self.process.kill()
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
    policies, config, simulator = cloudpickle.loads(os.pread(setup, os.fstat(setup).st_size, 0))
    player = Player(policies, config, simulator, Pulse(connection, config.watchdog_s / 4.0))
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


def _play_here(
    tasks: Sequence[Task], policies: Mapping[str, bytes], config: EnvConfig, simulator: str
) -> Iterator[tuple[Task, Rows]]:
    player = Player(policies, config, simulator)
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


class Pulse:
    """Tells the parent now and then, from step to step, that an episode goes on.

    Args:
        connection: to the parent.
        every_s: how often.
    """

    def __init__(self, connection: Connection, every_s: float) -> None:
        self._connection, self._every_s, self._told_s = connection, every_s, float("-inf")

    def beating(self, policy: Policy) -> Policy:
        """Return the policy, with a beat wherever one is due when it acts."""

        def act(tensordict: TensorDictBase) -> TensorDictBase:
            if time.monotonic() - self._told_s > self._every_s:
                self._told_s = time.monotonic()
                self._connection.send(("plays", None))
            return policy(tensordict)

        return act


class Player:
    """An environment and the packed policies; each episode gets one that has played nothing before."""

    def __init__(
        self, policies: Mapping[str, bytes], config: EnvConfig, simulator: str, pulse: Pulse | None = None
    ) -> None:
        # Imported here so that workers come up before torch and SUMO are loaded.
        from izoo.envs.env import EcoDrivingEnv

        self.env = EcoDrivingEnv(config=config, simulator=simulator)
        self._packed, self._pulse = policies, pulse

    def play(self, task: Task) -> Rows:
        from izoo.evaluation.playing import run_episode

        policy = cloudpickle.loads(self._packed[task.policy])
        if self._pulse is not None:
            policy = self._pulse.beating(policy)
        return run_episode(self.env, policy, task.name, task.context, task.seed)

    def close(self) -> None:
        self.env.close(raise_if_closed=False)
