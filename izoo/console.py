"""What commands show and how they end: progress with the time left, exit codes, Ctrl-C, output that cannot be written.

Nothing slow is imported here, so that a command says something at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import unicodedata
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import resource_tracker
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from izoo.errors import IzooError, UnfinishedError

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

EXIT_UNFINISHED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
_CONTROL = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Kinds of characters in Unicode: control, format (such as those that turn the writing direction), line separators."""
LINE_EVERY_S = 10.0
"""How often a line reports progress where there is no terminal for a bar."""
SPEED_OVER = 20
"""Updates that the time left is estimated from."""
ESTIMATE_FROM = 0.05
"""Share of the work that must be done before the time left is estimated: the first pieces wait for compilers and
simulators."""


class OutputLost(Exception):
    """Standard output takes nothing any more, and it was all that a command is for."""


def exit_code(name: str, main: Callable[[], int], stopped: str = "") -> int:
    """Return what ``main`` returns, or how it ended.

    That is 1 for work that cannot be finished or output that cannot be written, 2 for input that cannot be used, and
    130 for Ctrl-C or SIGTERM, also where the work was saved before.

    Args:
        name: of the command, without ``izoo``.
        main: its work.
        stopped: what to say after Ctrl-C beside that it was stopped.
    """
    label = f"izoo {name}".strip()
    with _guarded(), _terminable():
        try:
            try:
                code = main()
            except SystemExit:  # of argparse, which has printed its help
                _flush(sys.stdout)
                raise
            _flush(sys.stdout)
            return code
        except IzooError as error:
            print(f"{label}: {error}", file=sys.stderr, flush=True)
            return EXIT_BAD_INPUT
        except UnfinishedError as error:
            print(f"{label}: {error}", file=sys.stderr, flush=True)
            return EXIT_UNFINISHED
        except KeyboardInterrupt:
            print(f"{label}: stopped{stopped and f'; {stopped}'}.", file=sys.stderr, flush=True)
            return EXIT_INTERRUPTED
        except OutputLost as lost:
            if isinstance(lost.__cause__, BrokenPipeError):
                return 0  # whatever read the output, such as `head`, has had enough
            print(f"{label}: cannot write the output: {lost}.", file=sys.stderr, flush=True)
            return EXIT_UNFINISHED


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM interrupt the work inside the block as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def survives_lost_output() -> Iterator[None]:
    """Let work that leaves files continue where its output cannot be written any more."""
    before, _Guarded.work_goes_on = _Guarded.work_goes_on, True
    try:
        yield
    finally:
        _Guarded.work_goes_on = before


@contextlib.contextmanager
def _guarded() -> Iterator[None]:
    """Let nothing that happens to the output be taken for an error of the work inside the block."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (  # type: ignore
        stream if stream is None or isinstance(stream, _Guarded) else _Guarded(stream) for stream in before
    )
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


class _Guarded:
    """A stream that may stop taking text: nobody reads it, its terminal is closed, its disk is full.

    What is written then is dropped. Characters that it cannot spell are written as escapes.
    """

    work_goes_on = False

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write; return how many characters."""
        try:
            try:
                return self.stream.write(text)
            except UnicodeEncodeError as error:
                return self.stream.write(text.encode(error.encoding, "backslashreplace").decode(error.encoding))
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Flush."""
        try:
            self.stream.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        with contextlib.suppress(OSError):  # not a file at all
            _mute(self.stream)
        if self is not sys.stdout:
            return
        if not self.work_goes_on:
            raise OutputLost(error.strerror) from error
        reason = "nobody reads it" if isinstance(error, BrokenPipeError) else error.strerror
        print(f"izoo: the output is lost from here on ({reason}); the work goes on.", file=sys.stderr, flush=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _flush(stream: TextIO | None) -> None:
    if stream is not None:
        stream.flush()


def _mute(stream: TextIO) -> None:
    """Drop what is left to be written to a stream, and what follows."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class Interrupt:
    """Remembers Ctrl-C or SIGTERM; Ctrl-C after that raises :class:`KeyboardInterrupt`.

    SIGTERM may come twice: a job scheduler sends it to every process of a job, and a parent passes it on.
    """

    def __init__(self) -> None:
        self.requested = self.insisted = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        if self.requested and number == signal.SIGTERM:
            return
        if self.requested:
            self.insisted = True
            signal.signal(signal.SIGINT, signal.default_int_handler)
            raise KeyboardInterrupt
        self.requested = True
        print("\nFinishing this batch and saving. Ctrl-C again stops at once.", file=sys.stderr, flush=True)


@contextlib.contextmanager
def graceful_interrupt() -> Iterator[Interrupt]:
    """Turn the first Ctrl-C or SIGTERM inside the block into ``interrupt.requested``."""
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    except Exception as error:
        if interrupt.insisted:  # compiled code has turned the KeyboardInterrupt into an error of its own
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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


class Progress:
    """How far some work is: a bar on a terminal, a line now and then elsewhere, both with the time left.

    Args:
        total: pieces of work.
        done: pieces that were done before.
        unit: what is counted, in the plural; empty where it goes without saying.
        file: the stream; ``None`` means standard output.
        shown: whether anything is shown at all.
    """

    def __init__(
        self, total: int, done: int = 0, unit: str = "", file: TextIO | None = None, shown: bool = True
    ) -> None:
        self.total, self.unit, self.shown = total, unit, shown and total > 0
        self._file = sys.stdout if file is None else file
        self._first = done
        self._seen = deque([(time.monotonic(), done)], maxlen=SPEED_OVER)
        self._last_line = time.monotonic()
        self._bar: RichProgress | None = None
        if self.shown and self._file is not None and self._file.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

            columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}")
            self._bar = Progress(*columns, console=Console(file=self._file))
            self._task = self._bar.add_task("starting", total=total, completed=done)

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, text: str = "") -> None:
        """Show that ``done`` pieces are done, followed by ``text``."""
        ends = done >= self.total > self._seen[-1][1]
        self._seen.append((time.monotonic(), done))
        early = done < self.total and done - self._first < ESTIMATE_FROM * (self.total - self._first)
        text = ("" if early else f"{time_left(self._seen, self.total)}  ") + text
        unit = f" {self.unit}" if self.unit else ""
        if self._bar is not None:
            self._bar.update(
                self._task, completed=done, description=f"{done:,} / {self.total:,}{unit}  {text}".rstrip()
            )
        elif self.shown and (time.monotonic() - self._last_line >= LINE_EVERY_S or ends):
            self._last_line = time.monotonic()
            print(f"{done:>10,} / {self.total:,}{unit}  {text}".rstrip(), file=self._file, flush=True)


def time_left(seen: Sequence[tuple[float, int]], total: int) -> str:
    """Return how long work will still take, in words.

    Args:
        seen: clock in seconds and pieces done by then, oldest first.
        total: pieces of the whole work.
    """
    (start_s, first), (now_s, last) = seen[0], seen[-1]
    if last >= total:
        return "done"
    if last <= first:
        return "time left unknown"
    return f"{duration((now_s - start_s) * (total - last) / (last - first))} left"


def plain(text: object) -> str:
    """Return a text that comes from a file or a user without what a terminal would obey: control characters show as
    escapes. Rich must be told not to read markup in it (``markup=False``, or ``rich.text.Text``).
    """
    return "".join(c if unicodedata.category(c) not in _CONTROL else ascii(c)[1:-1] for c in str(text))


def counted(count: int, what: str) -> str:
    """Return ``1 seed``, ``2 seeds``."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """Seconds in words: ``80 s``, ``3 min``, ``1.5 h``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
