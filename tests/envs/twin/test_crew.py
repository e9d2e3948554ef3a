"""Threads that share work out: each does its part once, and what fails is heard."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator

import pytest

from izoo.envs.twin.runtime.thread_pool import Crew


@pytest.fixture
def crew() -> Iterator[Crew]:
    made = Crew(3, lambda: None)
    yield made
    made.close()


def test_each_thread_does_its_part_and_the_caller_goes_on_meanwhile(crew: Crew) -> None:
    together = threading.Barrier(3, timeout=10.0)  # helpers and caller are at work at the same time
    done: list[tuple[int, int]] = []

    def task(number: int) -> None:
        if number > 0:
            together.wait()
        done.append((number, threading.get_ident()))

    for _ in range(20):
        done.clear()
        crew.work(task, together.wait)
        assert sorted(number for number, _ in done) == [0, 1, 2] and len({thread for _, thread in done}) == 3
        assert dict(done)[0] == threading.get_ident()


def test_alone_there_is_no_meanwhile() -> None:
    seen: list[int] = []
    Crew(1, lambda: None).work(seen.append, lambda: seen.append(99))
    assert seen == [0]


@pytest.mark.parametrize("failing", [0, 2])
def test_a_failure_is_raised_when_all_have_ended_and_the_crew_goes_on(crew: Crew, failing: int) -> None:
    done: list[int] = []

    def task(number: int) -> None:
        if number == failing:
            raise ValueError(f"part {number}")
        done.append(number)

    for _ in range(2):
        with pytest.raises(ValueError, match=f"part {failing}"):
            crew.work(task)
        assert len(done) == 2
        done.clear()


def test_helpers_end_with_the_crew() -> None:
    helpers: list[threading.Thread] = []
    made = Crew(3, lambda: helpers.append(threading.current_thread()))
    made.work(lambda number: None)
    made.close()
    for helper in helpers:
        helper.join(timeout=10.0)
    assert len(helpers) == 2 and not any(helper.is_alive() for helper in helpers)


@pytest.fixture
def interrupts() -> Iterator[threading.Event]:
    """Interrupt this thread every 50 ms, as an impatient user does, while this is set."""
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
def test_who_is_interrupted_waits_for_the_others_all_the_same(
    crew: Crew, interrupts: threading.Event, waits: bool
) -> None:
    """However often: the caller may let go of the memory that they work on. Their reports are not the next task's."""
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
                crew.work(slow)
            finally:
                interrupts.clear()
        assert sorted(ended) == [1, 2]
        ended.clear()
    crew.work(ended.append)
    assert sorted(ended) == [0, 1, 2]


def test_closing_waits_for_what_is_still_being_done() -> None:
    made, ended = Crew(2, lambda: None), []

    def slow(number: int) -> None:
        if number:
            time.sleep(0.2)
        ended.append(number)

    working = threading.Thread(target=made.work, args=(slow,))
    working.start()
    time.sleep(0.05)
    made.close()
    assert sorted(ended) == [0, 1]
    working.join()
