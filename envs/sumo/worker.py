"""A process that simulates one environment on SUMO, and the parent's handle on it.

Frames travel through memory that both map; the socket carries one byte per step, and a pickled message at the start and
at each reset. Only izoo's own values are ever pickled. A worker ends by itself when its parent is gone, because the
socket then closes, and nothing that it maps has a name in the file system.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import socket
import struct
import subprocess
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
from izoo.processes import start_process

STEP, BEGIN, INIT, CLOSE = b"s", b"b", b"i", b"q"
DONE, FAILED = b"k", b"e"
_STARTUP_S = 300.0
AWAKE_S = 1e-3
"""How long a waiting process polls before it sleeps, where it has a core for that: being woken by another core takes 5
to 90 us, up to a fifth of a step."""
_LENGTH = struct.Struct("!Q")


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


class Worker:
    """Parent's handle on one worker process, which starts at once and in the background.

    Attributes:
        episodes: how many it was asked for.
        busy: whether it owes an answer.
    """

    def __init__(self, memory: int, setup: tuple[EnvConfig, int, int, Any], watchdog_s: float) -> None:
        self._socket, child = socket.socketpair()
        call = f"from izoo.envs.sumo.worker import main; main({child.fileno()}, {memory})"
        self.process = start_process(call, child.fileno(), memory)
        child.close()
        self._watchdog_s = watchdog_s
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
            self._socket.send(STEP)
        except OSError as error:
            raise WorkerLost(f"its process has ended ({self.process.poll()})") from error

    def wait(self, awake_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        """Wait for the answer, awake for ``awake_s`` seconds, then asleep.

        Args:
            awake_s: how long to poll before it sleeps.
            meanwhile: called once if there is time: where it stays awake and no answer is there yet.

        Raises:
            WorkerLost: the process ended or did not answer in time.
            IzooError: the worker refused, for a reason that the caller can mend.
        """
        patience_s = self._watchdog_s
        if not self._ready:
            # The first episode also loads the compiled code, or compiles it.
            patience_s = max(patience_s, _STARTUP_S)
            self._answer(patience_s)
            self._ready = True
        self._answer(patience_s, awake_s, meanwhile)

    def _answer(self, timeout_s: float, awake_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        try:
            answer = _receive_awake(self._socket, awake_s, meanwhile)
            if answer is None:
                self._socket.settimeout(timeout_s)
                answer = self._socket.recv(1)
            if answer == DONE:
                self.busy = not self._ready
                return
            if answer == FAILED:
                self._socket.settimeout(timeout_s)
                is_users, text = pickle.loads(_receive(self._socket))
                self.busy = not self._ready
                raise IzooError(text) if is_users else RuntimeError(f"a simulation worker failed:\n{text}")
        except TimeoutError as error:
            raise WorkerLost(f"no answer for {timeout_s:g} s") from error
        except (OSError, EOFError) as error:
            raise WorkerLost(str(error) or "it ended while it answered") from error
        raise WorkerLost(f"its process has ended ({self.process.poll()})")

    def _send(self, kind: bytes, message: Any) -> None:
        data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        try:
            self._socket.sendall(kind + _LENGTH.pack(len(data)) + data)
        except OSError as error:
            raise WorkerLost(f"its process has ended ({self.process.poll()})") from error

    def kill(self) -> None:
        """End the process at once."""
        self._socket.close()
        self.process.kill()
        self.process.wait()

    def dismiss(self) -> None:
        """Ask the process to end, and do not wait for that."""
        with contextlib.suppress(OSError):
            self._socket.send(CLOSE)
        self._socket.close()

    def close(self, patience_s: float = 5.0) -> None:
        """Ask the process to end, wait, and end it if it does not."""
        self.dismiss()
        try:
            self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.kill()


def _receive(connection: socket.socket) -> bytes:
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size))
    return _exactly(connection, length)


def _exactly(connection: socket.socket, length: int) -> bytes:
    chunks = []
    while length:
        chunk = connection.recv(min(length, 1 << 20))
        if not chunk:
            raise EOFError
        chunks.append(chunk)
        length -= len(chunk)
    return b"".join(chunks)


def main(descriptor: int, memory: int) -> None:
    """Serve one parent until it says goodbye or is gone; then end the process.

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
            if kind in (b"", CLOSE):
                return
            try:
                if kind == STEP:
                    simulator.step()
                elif kind == BEGIN:
                    simulator.begin({0: pickle.loads(_receive(connection))})
                elif kind == INIT:
                    config, index, num_workers, weights = pickle.loads(_receive(connection))
                    simulator = _make_simulator(memory, config, index, num_workers, weights)
                    awake_s = AWAKE_S if stays_awake(index, num_workers) else 0.0
                connection.send(DONE)
            except Exception as error:
                is_users = isinstance(error, IzooError)
                data = pickle.dumps((is_users, str(error) if is_users else traceback.format_exc()))
                connection.sendall(FAILED + _LENGTH.pack(len(data)) + data)
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

    Others who want this core have it in between. ``meanwhile`` is called once, unless a byte is there already.
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
