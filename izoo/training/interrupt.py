"""Ctrl-C: once to finish in good order, twice to stop now."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker
from types import FrameType

from izoo import cli


class Interrupt:
    """Remembers that Ctrl-C was pressed; a second time raises :class:`KeyboardInterrupt`."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle SIGINT."""
        if self.requested:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            raise KeyboardInterrupt
        self.requested = True
        cli.stop_requested.set()
        print(
            "\nFinishing this batch and closing the run in good order. Ctrl-C again stops at once.",
            file=sys.stderr,
            flush=True,
        )


@contextlib.contextmanager
def graceful_interrupt() -> Iterator[Interrupt]:
    """Turn the first Ctrl-C inside the block into ``interrupt.requested``."""
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def workers_ignore_interrupts() -> Iterator[None]:
    """Start processes inside the block that a terminal's Ctrl-C does not reach: they end when this process says so.

    Processes inherit that SIGINT is blocked. This process gets one that was sent meanwhile when the block ends.
    """
    resource_tracker.ensure_running()  # it unblocks SIGINT when it starts, which it would do at the first process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
