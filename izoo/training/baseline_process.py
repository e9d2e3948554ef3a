"""The process that plays baseline episodes beside training, block after block; it is of low priority."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch
from numpy.typing import NDArray

from izoo.envs import SIMULATORS, simulator_of
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.errors import UnfinishedError
from izoo.processes import ChildProcess, end_with_parent, receive, send
from izoo.results.playing import Play, Series
from izoo.results.rollout import rollout

NICENESS = 10
ATTEMPTS = 2
"""How often a block is begun before the loss of its process ends the run."""


class Episode(NamedTuple):
    """An episode that was played without the policy.

    Attributes:
        series: what was recorded (:data:`izoo.results.playing.RECORDS`).
        sums: ``[M]``, :data:`~izoo.envs.mdp.metric_sums.APPROACH_METRICS` added over approaches.
    """

    series: Series
    sums: NDArray[np.float64]


class BaselineProcess:
    """Plays blocks of episodes in the order in which they are submitted; the process starts with the first.

    Args:
        options: of :func:`izoo.results.rollout.rollout`, but for the plays and what is recorded of them.
    """

    def __init__(self, **options: Any) -> None:
        self._options = cloudpickle.dumps((simulator_of(options["simulator"]), options))
        self._child: ChildProcess | None = None
        self._closed = False
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, "izoo-baselines")

    def submit(self, plays: Callable[[], Sequence[Play]], record: Sequence[str] = ()) -> Future[list[Episode]]:
        """Let a block be played, of one driver.

        Args:
            plays: returns them; called in another thread.
            record: of :data:`izoo.results.playing.RECORDS`.
        """
        return self._thread.submit(self._play, plays, record)

    def close(self) -> None:
        """End the process, with what it plays."""
        with self._lock:
            self._closed = True
            if self._child is not None:
                self._child.kill()
        self._thread.shutdown(cancel_futures=True)

    def _play(self, plays: Callable[[], Sequence[Play]], record: Sequence[str]) -> list[Episode]:
        message, lost = cloudpickle.dumps((plays(), record)), ""
        for _ in range(ATTEMPTS):
            child = self._running_child()
            try:
                send(child.socket, message)
                answer = pickle.loads(receive(child.socket))
            except (OSError, EOFError):  # it was killed, for lack of memory perhaps
                lost = child.end_text()
                child.kill()
                continue
            if isinstance(answer, Exception):
                raise answer
            return answer
        raise UnfinishedError(
            f"the process that plays training episodes without the policy was lost {ATTEMPTS} times "
            f"({lost}); go on with resume=RUN_DIR, or twin.compare_every=0."
        )

    def _running_child(self) -> ChildProcess:
        """Return the process; another one where it has ended."""
        with self._lock:
            if self._closed:
                raise UnfinishedError("training has ended.")
            if self._child is None or self._child.process.poll() is not None:
                self._child = ChildProcess(f"{__name__}:main")
                with contextlib.suppress(OSError):  # one that has ended shows when it is asked
                    send(self._child.socket, self._options)
            return self._child


def main(descriptor: int) -> None:
    """Play what one parent asks for, until it is gone."""
    os.nice(NICENESS)
    torch.set_num_threads(1)
    connection = socket.socket(fileno=descriptor)
    end_with_parent(descriptor)
    with contextlib.suppress(EOFError, OSError):
        simulator, options = pickle.loads(receive(connection))
        SIMULATORS[options["simulator"]] = simulator  # it may have been added by the parent's program
        while True:
            plays, record = pickle.loads(receive(connection))
            send(connection, pickle.dumps(_answer(plays, record, options)))


def _answer(plays: Sequence[Play], record: Sequence[str], options: Mapping[str, Any]) -> list[Episode] | Exception:
    """Return the episodes of ``plays``, or why they cannot be played."""
    try:
        found = {}
        for play, rows, series in rollout(plays, {}, record=record, progress=False, side_by_side=len(plays), **options):
            sums = np.array([[row[name] for name in APPROACH_METRICS] for row in rows]).sum(0)
            found[play.episode] = Episode(series, sums)
        return [found[play.episode] for play in plays]
    except Exception as error:
        return error
