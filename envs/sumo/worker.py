"""A process that simulates one environment on SUMO, and the parent's handle on it.

Frames travel through memory that both map; the socket carries one byte per step, and a pickled message at the start and
at each reset. Only izoo's own values are ever pickled. A worker ends by itself when its parent is gone, because the
socket then closes, and nothing that it maps has a name in the file system.
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
from izoo.envs.mdp.frame import map_frames, row_of
from izoo.errors import IzooError
from izoo.processes import ChildProcess, receive, send

STEP, BEGIN, INIT = b"s", b"b", b"i"
DONE, FAILED = b"k", b"e"
AWAKE_S = 1e-3
"""How long a waiting process polls before it sleeps, where it has a core for that: being woken by another core takes 5
to 90 us, up to a fifth of a step."""


class WorkerLost(Exception):
    """A worker process has ended, or has not answered in time."""


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
    """Parent's handle on one worker process, which starts at once and in the background.

    Attributes:
        episodes: how many it was asked for.
        busy: whether it owes an answer.
    """

    def __init__(self, memory: int, setup: tuple[EnvConfig, int, int, Any], watchdog_s: float) -> None:
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

    def wait(self, awake_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        """Wait for the answer, awake for ``awake_s`` seconds, then asleep.

        Args:
            awake_s: how long to poll before it sleeps.
            meanwhile: called once if there is time: where it stays awake and no answer is there yet.

        Raises:
            WorkerLost: the process ended or did not answer in time.
            IzooError: the worker refused, for a reason that the caller can mend.
        """
        if not self._ready:
            self._answer()
            self._ready = True
        self._answer(awake_s, meanwhile)
        self.answered()  # the first episode also loads the compiled code, or compiles it

    def _answer(self, awake_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        try:
            answer = _receive_awake(self.socket, awake_s, meanwhile)
            if answer is None:
                self.socket.settimeout(self.patience_s)
                answer = self.socket.recv(1)
            if answer == DONE:
                self.busy = not self._ready
                return
            if answer == FAILED:
                self.socket.settimeout(self.patience_s)
                is_users, text = pickle.loads(receive(self.socket))
                self.busy = not self._ready
                raise IzooError(text) if is_users else RuntimeError(f"a simulation worker failed:\n{text}")
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
    """Serve one parent until it closes the socket or is gone; then end the process.

    It ends at once, because the interpreter would spend 0.4 s on tidying up libraries whose memory goes anyway.
    """
    _serve(descriptor, memory)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _serve(descriptor: int, memory: int) -> None:
    connection = socket.socket(fileno=descriptor)
    simulator: Any = None
    awake_s = 0.0
    try:
        while True:
            kind = _receive_awake(connection, awake_s)
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
                    config, index, num_workers, weights = pickle.loads(receive(connection))
                    simulator = _make_simulator(memory, config, index, num_workers, weights)
                    awake_s = AWAKE_S if stays_awake(index, num_workers) else 0.0
                connection.send(DONE)
            except Exception as error:
                is_users = isinstance(error, IzooError)
                data = pickle.dumps((is_users, str(error) if is_users else traceback.format_exc()))
                connection.send(FAILED)
                send(connection, data)
    except (BrokenPipeError, ConnectionResetError, EOFError):
        return
    finally:
        if simulator is not None:
            simulator.close()


def stays_awake(index: int, num_workers: int) -> bool:
    """Whether a worker, and the parent that waits for its answer, stay awake for :data:`AWAKE_S` before they sleep.

    They do if there are cores enough; the parents of single views always sleep. With one core per worker and none for
    the parent, the parent shares that of the first worker: there, going to sleep hands the core over at once, and
    polling would only get in the way.
    """
    spare = usable_cores() - num_workers
    return hasattr(os, "sched_yield") and (spare > 0 or (spare == 0 and index > 0))


def _receive_awake(
    connection: socket.socket, awake_s: float, meanwhile: Callable[[], None] | None = None
) -> bytes | None:
    """Ask for one byte for ``awake_s`` seconds without sleeping; return ``None`` if none came.

    Other threads may use this core in between. ``meanwhile`` is called once, unless a byte is there already.
    """
    if awake_s <= 0.0:
        return None
    connection.settimeout(None)  # or Python itself would sleep in recv()
    end = time.perf_counter() + awake_s
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


def _make_simulator(memory: int, config: EnvConfig, index: int, num_workers: int, weights: Any) -> Any:
    from izoo.envs.sumo.simulator import SumoSimulator

    for array in weights:
        array.flags.writeable = False  # as load_weights() returns them: one compiled variant serves both
    frames = map_frames(mmap.mmap(memory, 0), config, num_workers)
    return SumoSimulator(config, row_of(frames, index), weights)
