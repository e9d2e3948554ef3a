"""A watch over processes that collect: each counts its steps where this process sees them, and one that stops is ended.

TorchRL's collector notices a process that has ended, but waits forever for one that is stopped or hangs: within its
steps, or between the last of them and handing over the batch, where nobody can see which process it is.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

STARTUP_S = 300.0
"""How long the first batch may take to begin: a process imports PyTorch, and may have to compile."""


def open_counts(path: Path, size: int) -> np.ndarray:
    """Return the counts ``[size]`` int64 in a file, shared by all who have it open."""
    return np.memmap(path, np.int64, "r+", shape=(size,))


class Watch:
    """Ends processes that owe steps and take none for a time, while a batch is waited for; or all of them, where none
    owes a step and the batch still does not come.

    Args:
        size: how many processes there are.
        steps: of each process per batch.
        patience_s: for how long a process may take no step.

    Attributes:
        path: the file of the counts, for the processes.
        hung: numbers of the processes that were ended because they took no step.
        withheld: whether all were ended because their batch did not come.
    """

    def __init__(self, size: int, steps: int, patience_s: float) -> None:
        descriptor, name = tempfile.mkstemp(prefix="izoo-steps-")
        os.ftruncate(descriptor, 8 * size)
        os.close(descriptor)
        self.path, self.hung = Path(name), list[int]()
        self.withheld = False
        self._counts = open_counts(self.path, size)
        self._steps, self.patience_s = steps, patience_s
        self._batches = 0

    def over(self, pids: Sequence[int]) -> _Waiting:
        """Return a context in which a batch of these processes is waited for."""
        self._batches += 1
        patience_s = self.patience_s if self._batches > 1 else max(self.patience_s, STARTUP_S)
        return _Waiting(self, pids, self._batches * self._steps, patience_s)

    def close(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)


class _Waiting:
    """A thread that looks at the counts for as long as the context lasts."""

    def __init__(self, watch: Watch, pids: Sequence[int], owed: int, patience_s: float) -> None:
        self._watch, self._pids, self._owed, self._patience_s = watch, pids, owed, patience_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        counts = self._watch._counts
        before, since_s = counts.copy(), np.full(len(counts), time.monotonic())
        patience_s = np.full(len(counts), self._patience_s)
        while not self._over.wait(self._watch.patience_s / 4.0):
            now_s = time.monotonic()
            moved = counts != before
            since_s[moved], patience_s[moved] = now_s, self._watch.patience_s
            before = counts.copy()
            owing, idle = before < self._owed, now_s - since_s > patience_s
            for number in np.flatnonzero(owing & idle).tolist():
                if number not in self._watch.hung:
                    self._watch.hung.append(number)
                    self._end(number)
            if not owing.any() and idle.all():
                self._watch.withheld = True
                for number in range(len(self._pids)):
                    self._end(number)
                return

    def _end(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._pids[number], signal.SIGKILL)
