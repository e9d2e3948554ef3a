"""Rows of the throughput benchmark without environments: libsumo alone, what all others are compared with."""

from __future__ import annotations

import contextlib
import multiprocessing
import statistics
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from izoo.benchmarks.timing.stopwatch import CHUNK, seconds_per_step
from izoo.benchmarks.timing.throughput_plan import Plan, Sample
from izoo.console import workers_ignore_interrupts
from izoo.contexts.context import Context
from izoo.contexts.source import episode_seed
from izoo.envs import EcoDrivingEnv

_together: Any = None
"""In a process of :class:`BareSideBySide`: the barrier that all of them share."""


class Bare:
    """Libsumo alone, with nobody reading or commanding, in this process; one episode after the other."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._counts: dict[int, tuple[float, float]] = {}

    def play(self, scenario: int) -> Sample:
        context, workers = self.plan.contexts[scenario], range(self.plan.workers)
        if scenario not in self._counts:
            self._counts[scenario] = _mean([_count(self.plan, context, worker) for worker in workers])
        vehicles, agents = self._counts[scenario]
        rate = statistics.harmonic_mean([_time_bare(self.plan, context, worker) for worker in workers])
        return Sample(rate, rate * agents, vehicles, agents)

    def close(self) -> None:
        pass


class BareSideBySide:
    """Libsumo alone in several processes that know nothing of each other: what the machine's cores allow.

    The rate is the sum of theirs. Collectors also wait for the episode with the most traffic.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        spawn = multiprocessing.get_context("spawn")
        together = spawn.Barrier(plan.workers, timeout=300.0)
        self._pool = ProcessPoolExecutor(plan.workers, spawn, initializer=_join, initargs=(together,))
        self._counts: dict[int, tuple[float, float]] = {}

    def play(self, scenario: int) -> Sample:
        workers = self.plan.workers
        tasks = [self.plan] * workers, [self.plan.contexts[scenario]] * workers, range(workers)
        if scenario not in self._counts:
            with workers_ignore_interrupts():
                self._counts[scenario] = _mean(list(self._pool.map(_count, *tasks)))
        vehicles, agents = self._counts[scenario]
        rate = sum(self._pool.map(_time_bare_together, *tasks))
        return Sample(rate, rate * agents, vehicles, agents)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _simulation(plan: Plan, context: Context, worker: int) -> Iterator[Any]:
    """A simulator of this process, after its warm-up."""
    with contextlib.closing(
        EcoDrivingEnv(context, config=plan.env(emit=()), worker=worker, num_workers=plan.workers)
    ) as env:
        env.reset(context=context, seed=episode_seed(0, worker))
        yield env.backend


def _count(plan: Plan, context: Context, worker: int) -> tuple[float, float]:
    """Return the mean vehicles and CVs of the timed steps where nobody commands."""
    vehicles = agents = 0
    with _simulation(plan, context, worker) as simulator:
        simulator.frame["defer"][:] = 1
        for step in range(CHUNK + plan.steps):
            simulator.step()
            if step >= CHUNK:
                vehicles += len(simulator.ids.members)
                agents += int(simulator.frame["mask"].sum())
    return vehicles / plan.steps, agents / plan.steps


def _time_bare(plan: Plan, context: Context, worker: int, wait: Callable[[], object] = lambda: None) -> float:
    with _simulation(plan, context, worker) as simulator:
        return 1.0 / seconds_per_step(simulator.session.advance, plan.steps, CHUNK, wait)


def _mean(counts: list[tuple[float, float]]) -> tuple[float, float]:
    vehicles, agents = np.mean(counts, axis=0).tolist()
    return vehicles, agents


def _join(together: Any) -> None:
    global _together
    _together = together


def _time_bare_together(plan: Plan, context: Context, worker: int) -> float:
    """As :func:`_time_bare`, but the timed steps begin when all processes have come so far."""
    try:
        return _time_bare(plan, context, worker, _together.wait)
    except BaseException:
        _together.abort()
        raise
