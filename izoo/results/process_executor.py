"""Worker processes that play episodes, each in its own environment; if one is lost, the error names its episode."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any

import cloudpickle

from izoo.errors import IzooError
from izoo.networks.net.build import build_nets
from izoo.processes import ChildProcess, receive, send

if TYPE_CHECKING:  # worker processes come up before torch is loaded
    from izoo.results.playing import Measured, Play, Setup

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
                busy = {worker.socket: worker for worker in workers if worker.current}
                ready = wait(list(busy), max(min(worker.patience_left_s() for worker in busy.values()), 0.0))
                for connection, worker in busy.items():
                    play, attempt = worker.current  # type: ignore[misc]
                    if connection in ready:
                        found = worker.answer()
                    elif worker.patience_left_s() > 0.0:
                        continue
                    else:
                        found = Lost(worker.end_text())
                    if isinstance(found, Lost) and attempt == ATTEMPTS:
                        raise EpisodeFailed(f"{play}: the worker process was lost {ATTEMPTS} times ({found.reason}).")
                    if isinstance(found, Lost):
                        worker.kill()
                        workers[workers.index(worker)] = _Worker(setup.fileno(), watchdog_s)
                        queue.appendleft((play, attempt + 1))
                    elif found is not None:
                        yield play, found

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
    """A worker process has ended, or was silent for too long."""

    reason: str


class _Worker(ChildProcess):
    """The parent's handle on a worker process; it starts at once and is idle until :meth:`begin`.

    Args:
        setup: descriptor of a file with the pickled setup.
        watchdog_s: for how long a process that plays may be silent.

    Attributes:
        current: what it plays, and which attempt that is.
    """

    def __init__(self, setup: int, watchdog_s: float) -> None:
        place = "izoo.results.process_executor:worker_main"
        super().__init__(place, setup, inherited=(setup,), watchdog_s=watchdog_s)
        self.current: tuple[Play, int] | None = None

    def begin(self, play: Play, attempt: int) -> None:
        """Hand over an episode."""
        self.current = (play, attempt)
        self.asked()
        with contextlib.suppress(OSError):  # a dead worker shows when its answer is read
            send(self.socket, cloudpickle.dumps(play))

    def answer(self) -> Measured | Lost | None:
        """Return what the current episode came to, or that the process has ended; ``None``: it plays on."""
        from izoo.results.playing import EpisodeFailed

        play, _ = self.current  # type: ignore[misc]
        try:
            kind, content = pickle.loads(receive(self.socket))
        except (EOFError, OSError):
            return Lost(self.end_text())
        self.answered()
        if kind == "plays":
            return None
        self.current = None
        if kind == "refused":
            raise IzooError(f"{play}: {content}")
        if kind == "failed":
            raise EpisodeFailed(f"{play}: {content}")
        return content

    def dismiss(self) -> None:
        """Let the process know that it should end; one that still plays is killed."""
        if self.current is not None:
            self.process.kill()
        super().dismiss()


def worker_main(descriptor: int, setup: int) -> None:
    """Play the episodes that the parent sends until it closes the socket or is gone.

    Args:
        descriptor: of the socket to the parent.
        setup: as for :class:`_Worker`; several processes read it, each from its start.
    """
    import torch

    from izoo.results.playing import Player

    torch.set_num_threads(1)
    connection = socket.socket(fileno=descriptor)
    shared: Setup = cloudpickle.loads(os.pread(setup, os.fstat(setup).st_size, 0))
    every_s, told_s = shared.config.watchdog_s / 4.0, float("-inf")

    def beat() -> None:
        nonlocal told_s
        if time.monotonic() - told_s > every_s:
            told_s = time.monotonic()
            send(connection, pickle.dumps(("plays", None)))

    with contextlib.closing(Player(shared, beat)) as player, contextlib.suppress(EOFError, OSError):
        while True:
            send(connection, pickle.dumps(answer(player, receive(connection))))


def answer(player: Any, message: bytes | bytearray) -> tuple[str, Any]:
    """Return ``("played", what it came to)`` of a pickled play, or ``refused`` or ``failed`` and why."""
    try:
        return "played", player.play(cloudpickle.loads(message))
    except IzooError as error:
        return "refused", str(error)
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
