"""A process that simulates one environment on SUMO, and the parent's handle to it.

Frames are in shared memory; the socket carries one byte per step, and a pickled message at the start and at each reset.
Only izoo's own values are pickled. A worker ends by itself when its parent is gone, because the socket then closes, and
the memory that it maps has no name in the file system.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from typing import Any

from izoo.cores import usable_cores
from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import map_frames
from izoo.errors import IzooError
from izoo.processes import ChildProcess, receive, send

STEP, BEGIN, INIT = b"s", b"b", b"i"
DONE, FAILED = b"k", b"e"
POLL_S = 1e-3
"""How long a process polls for a message before it sleeps, where a core is free for that: waking up takes 5 to 90 us,
up to a fifth of a step."""


class WorkerLost(Exception):
    """A worker process ended, or did not answer in time."""


def shared_memory_file(size: int) -> int:
    """Return a descriptor of ``size`` bytes of anonymous memory that child processes can map."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("izoo-frames")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


class Worker(ChildProcess):
    """Parent's handle to one worker process, which starts in the background.

    Attributes:
        episodes: number of episodes that it was asked to begin.
        busy: whether an answer is outstanding.
    """

    def __init__(self, memory: int, setup: tuple[EnvConfig, int, int], watchdog_s: float) -> None:
        super().__init__("izoo.envs.sumo.worker:main", memory, inherited=(memory,), watchdog_s=watchdog_s)
        self.episodes, self.busy = 0, False
        self._send(INIT, setup)
        self._ready = False

    def begin(self, play: Play) -> None:
        """Ask for a new episode; :meth:`wait` for its first frame."""
        self.episodes += 1
        self.busy = True
        self._send(BEGIN, play)

    def step(self) -> None:
        """Ask for a step; :meth:`wait` for its frame."""
        self.busy = True
        try:
            self.socket.send(STEP)
        except OSError as error:
            raise WorkerLost(self.end_text()) from error

    def wait(self, poll_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        """Wait for the answer: poll for ``poll_s`` seconds, then sleep.

        Args:
            poll_s: how long to poll.
            meanwhile: called once while polling, unless the answer is there already.

        Raises:
            WorkerLost: the process ended or did not answer in time.
            IzooError: the worker refused for a reason that the user can fix.
        """
        if not self._ready:
            self._answer()
            self._ready = True
        self._answer(poll_s, meanwhile)
        self.answered()  # the first episode also loads the compiled code, or compiles it

    def _answer(self, poll_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        try:
            answer = _receive_polling(self.socket, poll_s, meanwhile)
            if answer is None:
                self.socket.settimeout(self.patience_s)
                answer = self.socket.recv(1)
            if answer == DONE:
                self.busy = not self._ready
                return
            if answer == FAILED:
                self.socket.settimeout(self.patience_s)
                is_user_error, text = pickle.loads(receive(self.socket))
                self.busy = not self._ready
                raise IzooError(text) if is_user_error else RuntimeError(f"a simulation worker failed:\n{text}")
        except TimeoutError as error:
            raise WorkerLost(f"no answer for {self.patience_s:g} s") from error
        except (OSError, EOFError) as error:
            raise WorkerLost(str(error) or "it ended while it answered") from error
        raise WorkerLost(self.end_text())

    def _send(self, kind: bytes, message: Any) -> None:
        try:
            self.socket.send(kind)
            send(self.socket, pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL))
        except OSError as error:
            raise WorkerLost(self.end_text()) from error


def main(descriptor: int, memory: int) -> None:
    """Serve the parent until it closes the socket or is gone; then end the process.

    It ends without the interpreter's clean-up, which would take 0.4 s.
    """
    _serve(descriptor, memory)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _serve(descriptor: int, memory: int) -> None:
    connection = socket.socket(fileno=descriptor)
    simulator: Any = None
    poll_s = 0.0
    try:
        while True:
            kind = _receive_polling(connection, poll_s)
            if kind is None:
                kind = connection.recv(1)
            if kind == b"":
                return
            try:
                if kind == STEP:
                    simulator.step()
                elif kind == BEGIN:
                    simulator.begin({0: pickle.loads(receive(connection))})
                elif kind == INIT:
                    config, index, num_workers = pickle.loads(receive(connection))
                    simulator = _make_simulator(memory, config, index, num_workers)
                    poll_s = POLL_S if may_poll(index, num_workers) else 0.0
                connection.send(DONE)
            except Exception as error:
                is_user_error = isinstance(error, IzooError)
                data = pickle.dumps((is_user_error, str(error) if is_user_error else traceback.format_exc()))
                connection.send(FAILED)
                send(connection, data)
    except (BrokenPipeError, ConnectionResetError, EOFError):
        return
    finally:
        if simulator is not None:
            simulator.close()


def may_poll(index: int, num_workers: int) -> bool:
    """Whether a worker, and the parent that waits for its answer, may poll for :data:`POLL_S` before they sleep.

    They may if there are enough cores. With one core per worker and none for the parent, the parent shares the core of
    the first worker: there, sleeping frees the core at once, and polling would only delay the worker.
    """
    spare = usable_cores() - num_workers
    return hasattr(os, "sched_yield") and (spare > 0 or (spare == 0 and index > 0))


def _receive_polling(
    connection: socket.socket, poll_s: float, meanwhile: Callable[[], None] | None = None
) -> bytes | None:
    """Poll for one byte for ``poll_s`` seconds; return ``None`` if none came.

    The core is yielded to other processes in between. ``meanwhile`` is called once, unless a byte is there already.
    """
    if poll_s <= 0.0:
        return None
    connection.settimeout(None)  # otherwise Python would sleep in recv()
    end = time.perf_counter() + poll_s
    while time.perf_counter() < end:
        try:
            return connection.recv(1, socket.MSG_DONTWAIT)
        except BlockingIOError:
            if meanwhile is not None:
                meanwhile()
                meanwhile = None
            else:
                os.sched_yield()
    return None


def _make_simulator(memory: int, config: EnvConfig, index: int, num_workers: int) -> Any:
    from izoo.envs.sumo.simulator import SumoSimulator

    frames = map_frames(mmap.mmap(memory, 0), config, num_workers)
    return SumoSimulator(config, frames={name: array[index : index + 1] for name, array in frames.items()})
