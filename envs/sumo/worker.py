"""A process that simulates one environment on SUMO, and the parent's handle to it.

Frames are in shared memory; the socket carries one byte per step, and a pickled message at the start and at each reset.
Only izoo's own values are pickled. A worker ends by itself when its parent is gone, because the socket then closes, and
the memory that it maps has no name in the file system.
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
from typing import Any, BinaryIO

from izoo.cores import usable_cores
from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import map_frames, row_of
from izoo.errors import IzooError

STEP, BEGIN, INIT, CLOSE = b"s", b"b", b"i", b"q"
DONE, FAILED = b"k", b"e"
_STARTUP_S = 300.0
POLL_S = 1e-3
"""How long a process polls for a message before it sleeps, where a core is free for that: waking up takes 5 to 90 us,
up to a fifth of a step."""
_LENGTH = struct.Struct("!Q")


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


def start_process(call: str, *descriptors: int, output: BinaryIO | None = None) -> subprocess.Popen[bytes]:
    """Start ``from MODULE import FUNCTION; FUNCTION(...)`` in a fresh interpreter that imports what this one can.

    Unlike with ``multiprocessing``, the process does not run the user's script again, so that scripts need no
    ``if __name__ == "__main__"``. It reads the environment and the user's site packages only if this process does. A
    session of its own shields it from the terminal's Ctrl-C: the parent decides when it ends.

    Args:
        call: the statements.
        descriptors: open files that the process inherits under the same numbers.
        output: file for the output of the process; ``None``: that of this process.
    """
    program = f"import sys; sys.path[:] = {sys.path!r}; {call}"
    flags = {"-I": sys.flags.isolated, "-E": sys.flags.ignore_environment, "-s": sys.flags.no_user_site}
    return subprocess.Popen(
        [sys.executable, *(flag for flag, is_set in flags.items() if is_set), "-c", program],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        pass_fds=descriptors,
        start_new_session=True,
    )


class Worker:
    """Parent's handle to one worker process, which starts in the background.

    Attributes:
        episodes: number of episodes that it was asked to begin.
        busy: whether an answer is outstanding.
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

    def wait(self, poll_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        """Wait for the answer: poll for ``poll_s`` seconds, then sleep.

        Args:
            poll_s: how long to poll.
            meanwhile: called once while polling, unless the answer is there already.

        Raises:
            WorkerLost: the process ended or did not answer in time.
            IzooError: the worker refused for a reason that the user can fix.
        """
        timeout_s = self._watchdog_s
        if not self._ready:
            # The first episode also loads the compiled code, or compiles it.
            timeout_s = max(timeout_s, _STARTUP_S)
            self._answer(timeout_s)
            self._ready = True
        self._answer(timeout_s, poll_s, meanwhile)

    def _answer(self, timeout_s: float, poll_s: float = 0.0, meanwhile: Callable[[], None] | None = None) -> None:
        try:
            answer = _receive_polling(self._socket, poll_s, meanwhile)
            if answer is None:
                self._socket.settimeout(timeout_s)
                answer = self._socket.recv(1)
            if answer == DONE:
                self.busy = not self._ready
                return
            if answer == FAILED:
                self._socket.settimeout(timeout_s)
                is_user_error, text = pickle.loads(_receive(self._socket))
                self.busy = not self._ready
                raise IzooError(text) if is_user_error else RuntimeError(f"a simulation worker failed:\n{text}")
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

    def request_close(self) -> None:
        """Ask the process to end, without waiting."""
        with contextlib.suppress(OSError):
            self._socket.send(CLOSE)
        self._socket.close()

    def close(self, timeout_s: float = 5.0) -> None:
        """Ask the process to end, wait, and kill it if it does not."""
        self.request_close()
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()


def _receive(connection: socket.socket) -> bytes:
    (length,) = _LENGTH.unpack(_receive_exactly(connection, _LENGTH.size))
    return _receive_exactly(connection, length)


def _receive_exactly(connection: socket.socket, length: int) -> bytes:
    chunks = []
    while length:
        chunk = connection.recv(min(length, 1 << 20))
        if not chunk:
            raise EOFError
        chunks.append(chunk)
        length -= len(chunk)
    return b"".join(chunks)


def main(descriptor: int, memory: int) -> None:
    """Serve the parent until it asks to close or is gone; then end the process.

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
                    poll_s = POLL_S if may_poll(index, num_workers) else 0.0
                connection.send(DONE)
            except Exception as error:
                is_user_error = isinstance(error, IzooError)
                data = pickle.dumps((is_user_error, str(error) if is_user_error else traceback.format_exc()))
                connection.sendall(FAILED + _LENGTH.pack(len(data)) + data)
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


def _make_simulator(memory: int, config: EnvConfig, index: int, num_workers: int, weights: Any) -> Any:
    from izoo.envs.sumo.simulator import SumoSimulator

    for array in weights:
        array.flags.writeable = False  # as load_weights() returns them, so that one compiled variant serves both
    frames = map_frames(mmap.mmap(memory, 0), config, num_workers)
    return SumoSimulator(config, row_of(frames, index), weights)
