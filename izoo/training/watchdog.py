"""Processes that collect are watched while a batch is awaited: where none of them takes a step, all are ended.

TorchRL's collector notices a process that has ended, but waits forever for one that is stopped or hangs.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from izoo.processes import STARTUP_S


def open_counts(path: Path, size: int) -> np.ndarray:
    """Return the counts ``[size]`` int64 in a file, shared by all processes that have it open."""
    return np.memmap(path, np.int64, "r+", shape=(size,))


class StepWatch:
    """Ends all processes if none takes a step for a time while their batch is awaited.

    Args:
        size: how many processes there are.
        patience_s: how long none may take a step; longer for the first batch, when they start and perhaps compile.

    Attributes:
        path: file of the counts of steps, for the processes.
        ended: whether they were ended.
    """

    def __init__(self, size: int, patience_s: float) -> None:
        descriptor, name = tempfile.mkstemp(prefix="izoo-steps-")
        os.ftruncate(descriptor, 8 * size)
        os.close(descriptor)
        self.path, self.patience_s, self.ended = Path(name), patience_s, False
        self._counts = open_counts(self.path, size)
        self._begun = False

    @contextlib.contextmanager
    def over(self, pids: Sequence[int]) -> Iterator[None]:
        """Watch the processes inside the block, in which their batch is awaited."""
        patience_s = self.patience_s if self._begun else max(self.patience_s, STARTUP_S)
        came = threading.Event()
        thread = threading.Thread(target=self._watch, args=(pids, came, patience_s), daemon=True)
        thread.start()
        try:
            yield
            self._begun = True
        finally:
            came.set()
            thread.join()

    def _watch(self, pids: Sequence[int], came: threading.Event, patience_s: float) -> None:
        before, since_s = int(self._counts.sum()), time.monotonic()
        while not came.wait(self.patience_s / 4.0):
            taken, now_s = int(self._counts.sum()), time.monotonic()
            if taken != before:
                before, since_s = taken, now_s
            elif now_s - since_s > patience_s:
                self.ended = True
                for pid in pids:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                return

    def close(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)
