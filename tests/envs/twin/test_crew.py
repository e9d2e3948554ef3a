"""Threads that share work out: each does its part once, and what fails is heard."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import SimpleQueue

import pytest

from izoo.envs.twin import crew as crew_module
from izoo.envs.twin.crew import Crew


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


def test_what_an_interrupt_leaves_behind_is_not_the_next_report() -> None:
    """Somebody who stops waiting must not take the late report of the first task for that of the second."""
    made, late = Crew(2, lambda: None), threading.Event()
    gone: list[int] = []

    def slow(number: int) -> None:
        if number:
            late.wait(10.0)
            gone.append(1)

    class Interrupted(SimpleQueue):  # type: ignore[type-arg]
        def get(self, *_: object, **__: object) -> None:
            raise KeyboardInterrupt

    def interrupt() -> None:
        late.clear()
        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(crew_module, "SimpleQueue", Interrupted)
            made.work(slow)
        threading.Timer(0.2, late.set).start()

    interrupt()
    made.work(lambda number: gone.append(2) if number else None)
    assert gone == [1, 2]
    interrupt()
    made.close()
    assert gone == [1, 2, 1], "closing waits for what is still being done"
