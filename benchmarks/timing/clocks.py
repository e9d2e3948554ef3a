"""Clocks: how long calls take, and how much of that is the main thread's alone."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

CORES = 16
"""Cores for which the speed-up is stated that the serial share allows."""


@dataclass(frozen=True)
class Timed:
    """What was found of calls that were timed.

    Attributes:
        calls: how many were timed.
        wall_s: seconds of one.
        serial_s: processor seconds of the main thread in one, but for its share of what threads do side by side.
        shared_s: processor seconds that all threads spent on that.
    """

    calls: int
    wall_s: float
    serial_s: float
    shared_s: float

    @property
    def serial_share(self) -> float:
        """Share of the work of a call that more threads do not make faster."""
        return self.serial_s / max(self.serial_s + self.shared_s, 1e-12)

    @property
    def most(self) -> float:
        """How many times faster :data:`CORES` cores can be than one (Amdahl's law)."""
        return 1.0 / (self.serial_share + (1.0 - self.serial_share) / CORES)


def timed(call: Callable[[], object], seconds: float, backend: Any = None) -> Timed:
    """Call for so many seconds.

    Args:
        call: what is timed; one call comes before.
        seconds: at least one call is timed, however long it takes.
        backend: the twin's, whose threads share the environments out; ``None``: all work is the main thread's.
    """
    call()
    calls = 0
    with _share_of_threads(backend) as shared:
        wall, main = time.perf_counter(), time.thread_time()
        while calls == 0 or time.perf_counter() - wall < seconds:
            call()
            calls += 1
        wall, main = time.perf_counter() - wall, time.thread_time() - main
    own = shared.get(0, 0.0)
    return Timed(calls, wall / calls, (main - own) / calls, sum(shared.values()) / calls)


@contextlib.contextmanager
def _share_of_threads(backend: Any) -> Iterator[dict[int, float]]:
    """Count the processor seconds that each thread of a twin spends on its share, by its number."""
    shared: dict[int, float] = {}
    if backend is None:
        yield shared
        return
    pool = backend._pool
    work = pool.work

    def counting(task: Callable[[int], None], *rest: Any) -> None:
        def clocked(thread: int) -> None:
            begin = time.thread_time()
            task(thread)
            shared[thread] = shared.get(thread, 0.0) + time.thread_time() - begin

        work(clocked, *rest)

    pool.work = counting
    try:
        yield shared
    finally:
        del pool.work
