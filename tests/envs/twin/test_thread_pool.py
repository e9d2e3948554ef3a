"""Threads that share work: all have ended before a failure or an interrupt is raised, and before the pool closes."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator

import pytest

from izoo.envs.twin.runtime.thread_pool import ThreadPool


@pytest.fixture
def pool() -> Iterator[ThreadPool]:
    made = ThreadPool(3, lambda: None)
    yield made
    made.close()


@pytest.mark.parametrize("failing", [0, 2])
def test_a_failure_is_raised_when_all_have_ended_and_the_pool_goes_on(pool: ThreadPool, failing: int) -> None:
    done: list[int] = []

    def task(number: int) -> None:
        if number == failing:
            raise ValueError(f"part {number}")
        time.sleep(0.05)
        done.append(number)

    for _ in range(2):
        with pytest.raises(ValueError, match=f"part {failing}"):
            pool.work(task)
        assert len(done) == 2
        done.clear()


@pytest.fixture
def interrupts() -> Iterator[threading.Event]:
    """While this is set, a KeyboardInterrupt is raised here every 50 ms."""
    armed = threading.Event()

    def interrupt(*_: object) -> None:
        if armed.is_set():
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
    try:
        yield armed
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("waits", [True, False])
def test_an_interrupt_is_raised_when_all_have_ended(pool: ThreadPool, interrupts: threading.Event, waits: bool) -> None:
    """The caller may then free the memory that they work on. Reports of that task are not taken for the next one's."""
    ended: list[int] = []

    def slow(number: int) -> None:
        if number:
            time.sleep(0.3)
            ended.append(number)
        while not (number or waits):
            time.sleep(0.01)

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            try:
                interrupts.set()
                pool.work(slow)
            finally:
                interrupts.clear()
        assert sorted(ended) == [1, 2]
        ended.clear()
    pool.work(ended.append)
    assert sorted(ended) == [0, 1, 2]
