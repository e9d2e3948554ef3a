"""Threads that share work: all have ended before a failure is raised."""

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
