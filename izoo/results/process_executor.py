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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

import cloudpickle

from izoo.envs.sumo.worker import start_process
from izoo.errors import IzooError
from izoo.networks.net.build import build_nets

if TYPE_CHECKING:  # worker processes come up before torch is loaded
    from izoo.results.playing import Measured, Play, Setup

STARTUP_S = 300.0
"""How long a process may take before its first step: it imports PyTorch, and may have to compile."""
ATTEMPTS = 2
"""How often an episode is begun before the loss of its worker process ends the rollout."""


class Processes:
    """Plays episodes in worker processes of this machine; with 0 of them, in this process."""

    size: int | None = None

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._workers: list[_Worker] = []

    def play(self, plays: Sequence[Play], ahead: Sequence[Play] = ()) -> Iterator[tuple[Play, Measured]]:
        """Play episodes and yield them as they finish.

        Raises:
            IzooError: an episode's input cannot be used (the message names the episode).
            EpisodeFailed: an episode failed otherwise.
        """
        return self._play(plays) if self.setup.workers else self._play_here(plays)

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.dismiss()
        for worker in self._workers:
            worker.close()
        self._workers.clear()

    def _play(self, plays: Sequence[Play]) -> Iterator[tuple[Play, Measured]]:
        from izoo.results.playing import EpisodeFailed

        queue = deque((play, 1) for play in plays)
        watchdog_s, workers = self.setup.config.watchdog_s, self._workers
        with tempfile.TemporaryFile() as setup:
            cloudpickle.dump(self.setup, setup)
            setup.flush()
            workers += [_Worker(setup.fileno(), watchdog_s) for _ in range(min(self.setup.workers, len(plays)))]
            _build_nets(plays)
            while queue or any(worker.current for worker in workers):
                for worker in workers:
                    if worker.current is None and queue:
                        worker.begin(*queue.popleft())
                busy = {worker.connection: worker for worker in workers if worker.current}
                ready = wait(list(busy), max(min(worker.patience_left_s() for worker in busy.values()), 0.0))
                for connection, worker in busy.items():
                    play, attempt = worker.current  # type: ignore[misc]
                    if connection in ready:
                        heard = worker.hear()
                    elif worker.patience_left_s() > 0.0:
                        continue
                    else:
                        heard = Lost(f"no answer for {worker.patience_s:g} s")
                    if isinstance(heard, Lost) and attempt == ATTEMPTS:
                        raise EpisodeFailed(f"{play}: the worker process was lost {ATTEMPTS} times ({heard.reason}).")
                    if isinstance(heard, Lost):
                        worker.kill()
                        workers[workers.index(worker)] = _Worker(setup.fileno(), watchdog_s)
                        queue.appendleft((play, attempt + 1))
                    elif heard is not None:
                        yield play, heard

    def _play_here(self, plays: Sequence[Play]) -> Iterator[tuple[Play, Measured]]:
        from izoo.results.playing import EpisodeFailed, Player

        _build_nets(plays)
        with contextlib.closing(Player(self.setup)) as player:
            for play in plays:
                try:
                    found = player.play(play)
                except IzooError as error:
                    raise IzooError(f"{play}: {error}") from error
                except Exception as error:
                    raise EpisodeFailed(f"{play}: {type(error).__name__}: {error}") from error
                yield play, found


def _build_nets(plays: Sequence[Play]) -> None:
    """Build the nets of all plays together, in a tenth of the time; one that cannot be built fails its own play."""
    with contextlib.suppress(IzooError):
        build_nets([play.context.intersection for play in plays])


@dataclass(frozen=True)
class Lost:
    """A worker process has ended, or has not been heard of for too long."""

    reason: str


class _Worker:
    """The parent's side of a worker process; it starts at once and is idle until :meth:`begin`.

    Args:
        setup: descriptor of a file with the pickled setup.
        watchdog_s: for how long a process that plays may not be heard of.

    Attributes:
        current: what it plays, and which attempt that is.
        patience_s: how long it may be silent now: longer at first, while it imports and perhaps compiles.
    """

    def __init__(self, setup: int, watchdog_s: float) -> None:
        ours, child = socket.socketpair()
        call = f"from izoo.results.process_executor import worker_main; worker_main({child.fileno()}, {setup})"
        self.process = start_process(call, child.fileno(), setup)
        child.close()
        self.connection = Connection(ours.detach())
        self.current: tuple[Play, int] | None = None
        self._watchdog_s, self.patience_s = watchdog_s, max(watchdog_s, STARTUP_S)
        self._heard_s = time.monotonic()

    def patience_left_s(self) -> float:
        """For how long it may still be silent."""
        return self._heard_s + self.patience_s - time.monotonic()

    def begin(self, play: Play, attempt: int) -> None:
        """Hand over an episode."""
        self.current = (play, attempt)
        self._heard_s = time.monotonic()
        with contextlib.suppress(OSError):  # a dead worker shows when its answer is read
            self.connection.send_bytes(cloudpickle.dumps(play))

    def hear(self) -> Measured | Lost | None:
        """Return what the current episode came to, or that the process has ended; ``None``: it plays on."""
        from izoo.results.playing import EpisodeFailed

        play, _ = self.current  # type: ignore[misc]
        try:
            kind, content = self.connection.recv()
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)
            return Lost(self._exit_text())
        self._heard_s, self.patience_s = time.monotonic(), self._watchdog_s
        if kind == "plays":
            return None
        self.current = None
        if kind == "refused":
            raise IzooError(f"{play}: {content}")
        if kind == "failed":
            raise EpisodeFailed(f"{play}: {content}")
        return content

    def kill(self) -> None:
        """End the process at once, also where it is stopped."""
        self.current = None
        self.connection.close()
        self.process.kill()
        self.process.wait()

    def dismiss(self) -> None:
        """Ask the process to end, without waiting for it; one that still plays is killed."""
        if self.current is not None:
            self.process.kill()
        with contextlib.suppress(OSError):
            self.connection.send_bytes(b"")
        self.connection.close()

    def close(self) -> None:
        """Wait for the process to end, and kill it if it does not."""
        try:
            self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _exit_text(self) -> str:
        code = self.process.poll()
        return f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"


def worker_main(descriptor: int, setup: int) -> None:
    """Play the episodes that the parent sends until it sends nothing or is gone.

    Args:
        descriptor: of the socket to the parent.
        setup: as for :class:`_Worker`; several processes read it, each from its start.
    """
    import torch

    from izoo.results.playing import Player

    torch.set_num_threads(1)
    connection = Connection(descriptor)
    shared: Setup = cloudpickle.loads(os.pread(setup, os.fstat(setup).st_size, 0))
    every_s, told_s = shared.config.watchdog_s / 4.0, float("-inf")

    def beat() -> None:
        nonlocal told_s
        if time.monotonic() - told_s > every_s:
            told_s = time.monotonic()
            connection.send(("plays", None))

    with contextlib.closing(Player(shared, beat)) as player, contextlib.suppress(EOFError, OSError):
        while message := connection.recv_bytes():
            connection.send(answer(player, message))


def answer(player: Any, message: bytes) -> tuple[str, Any]:
    """Return ``("played", what it came to)`` of a pickled play, or ``refused`` or ``failed`` and why."""
    try:
        return "played", player.play(cloudpickle.loads(message))
    except IzooError as error:
        return "refused", str(error)
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
