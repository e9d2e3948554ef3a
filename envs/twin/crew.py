"""Threads that share work out among them, in parts so short that how they are woken matters."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue

Task = Callable[[int], None]


class Crew:
    """The thread that calls :meth:`work`, number 0, and helpers that wait for it.

    A pool of :mod:`concurrent.futures` takes some 60 µs longer to hand out work and to hear that it is done, where two
    threads take 1,000 for a step of 64 environments.

    Args:
        size: threads, the caller's included.
        begin: called by each helper when it begins.
    """

    def __init__(self, size: int, begin: Callable[[], None]) -> None:
        self._orders: list[SimpleQueue[Task | None]] = [SimpleQueue() for _ in range(size - 1)]
        self._reports: SimpleQueue[BaseException | None] = SimpleQueue()
        for number, orders in enumerate(self._orders, 1):
            helper = threading.Thread(
                target=_help, args=(number, orders, self._reports, begin), name=f"izoo-twin-{number}", daemon=True
            )
            helper.start()

    def work(self, task: Task, meanwhile: Callable[[], object] | None = None) -> None:
        """Let every thread call ``task`` with its number, and wait for all of them.

        Args:
            task: what each does.
            meanwhile: called by this thread when it is done, if there are others.
        """
        for orders in self._orders:
            orders.put(task)
        try:
            task(0)
            if meanwhile is not None and self._orders:
                meanwhile()
        finally:
            failures = [report for _ in self._orders if (report := self._reports.get()) is not None]
        if failures:
            raise failures[0]

    def close(self) -> None:
        """Let the helpers end."""
        for orders in self._orders:
            orders.put(None)


def _help(
    number: int,
    orders: SimpleQueue[Task | None],
    reports: SimpleQueue[BaseException | None],
    begin: Callable[[], None],
) -> None:
    begin()
    while (task := orders.get()) is not None:
        report: BaseException | None = None
        try:
            task(number)
        except BaseException as failure:
            report = failure
        del task  # before the report: whoever has heard it may let everything go
        reports.put(report)
