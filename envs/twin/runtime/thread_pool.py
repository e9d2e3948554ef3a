"""Threads that share work out among them, in parts so short that how they are woken matters."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue

Task = Callable[[int], object]
_Reports = SimpleQueue[BaseException | None]
_Order = tuple[Task, _Reports]


class ThreadPool:
    """The thread that calls :meth:`work`, number 0, and helpers that wait for it.

    A pool of :mod:`concurrent.futures` takes some 60 µs longer to hand out work and to hear that it is done, where two
    threads take 1,000 for a step of 64 environments.

    Args:
        size: threads, the caller's included.
        begin: called by each helper when it begins.
    """

    def __init__(self, size: int, begin: Callable[[], None]) -> None:
        self._orders: list[SimpleQueue[_Order | None]] = [SimpleQueue() for _ in range(size - 1)]
        self._helpers = [
            threading.Thread(target=_help, args=(number, orders, begin), name=f"izoo-twin-{number}", daemon=True)
            for number, orders in enumerate(self._orders, 1)
        ]
        for helper in self._helpers:
            helper.start()

    def work(self, task: Task, meanwhile: Callable[[], object] | None = None) -> None:
        """Let every thread call ``task`` with its number, and wait for all of them.

        Args:
            task: what each does.
            meanwhile: called by this thread when it is done, if there are others.
        """
        reports: _Reports = SimpleQueue()
        try:
            for orders in self._orders:
                orders.put((task, reports))
            task(0)
            if meanwhile is not None and self._orders:
                meanwhile()
            failures = [report for _ in self._orders if (report := reports.get()) is not None]
        except BaseException:
            self._settle()
            raise
        if failures:
            raise failures[0]

    def _settle(self) -> None:
        """Wait until no helper is at work any more, however often that is interrupted.

        Whoever hears of a failure may let go of the memory that the others work on.
        """
        while True:
            try:
                # Helpers take orders in turn, so whoever has answered this one has ended those before it.
                reports: _Reports = SimpleQueue()
                for orders in self._orders:
                    orders.put((_do_nothing, reports))
                for _ in self._orders:
                    reports.get()
                return
            except BaseException:
                continue

    def close(self) -> None:
        """Let the helpers end what they do, and wait for that."""
        for orders in self._orders:
            orders.put(None)
        for helper in self._helpers:
            if helper is not threading.current_thread():
                helper.join()


def _do_nothing(number: int) -> None:
    """Be done."""


def _help(number: int, orders: SimpleQueue[_Order | None], begin: Callable[[], None]) -> None:
    begin()
    while (order := orders.get()) is not None:
        task, reports = order
        report: BaseException | None = None
        try:
            task(number)
        except BaseException as failure:
            report = failure
        # Whoever has heard the report may let everything go: nothing is held here until the next order.
        del order, task
        reports.put(report)
        del report, reports
