"""What a run shows while it trains: a bar on a terminal, a line now and then elsewhere, both with the time left."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

SHOWN = (
    ("frames_per_s", "{:.0f} frames/s"),
    ("return", "return {:.1f}"),
    ("emission_g_per_vehicle", "{:.1f} g/veh"),
    ("throughput_veh_per_episode", "{:.0f} veh/episode"),
    ("validation_benefit", "validation {:+.1%}"),
)
LINE_EVERY_S = 10.0
SPEED_OVER = 20
"""Updates that the time left is estimated from."""


class ProgressBar:
    """Shows frames done, frames/s, and the latest return, emission per vehicle and throughput.

    Args:
        total: frames of the whole run.
        done: frames that earlier parts of the run have done.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self.total = total
        self._latest: dict[str, float] = {}
        self._seen = deque([(time.monotonic(), done)], maxlen=SPEED_OVER)
        self._last_line = time.monotonic()
        self._console = Console(file=sys.stdout)
        self._bar: Progress | None = None
        if self._console.is_terminal:
            columns = (BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=self._console)
            self._task = self._bar.add_task("starting the simulators", total=total, completed=done)

    def __enter__(self) -> ProgressBar:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, frames: int, stats: Mapping[str, float]) -> None:
        """Show the state after ``frames`` frames; numbers that ``stats`` lacks keep their last value."""
        self._latest.update(stats)
        self._seen.append((time.monotonic(), frames))
        text = "  ".join(form.format(self._latest[name]) for name, form in SHOWN if name in self._latest)
        text = f"{time_left(self._seen, self.total)}  {text}"
        if self._bar is not None:
            self._bar.update(self._task, completed=frames, description=text)
        elif time.monotonic() - self._last_line >= LINE_EVERY_S or frames >= self.total:
            self._last_line = time.monotonic()
            print(f"{frames:>10,} / {self.total:,}  {text}", flush=True)


def time_left(seen: Sequence[tuple[float, int]], total: int) -> str:
    """Return how long ``total`` frames will still take, in words.

    Args:
        seen: clock in seconds and frames done by then, oldest first.
        total: frames of the whole run.
    """
    (start_s, first), (now_s, last) = seen[0], seen[-1]
    if last >= total:
        return "done"
    if last <= first:
        return "time left unknown"
    seconds = (now_s - start_s) * (total - last) / (last - first)
    if seconds < 90.0:
        return f"{seconds:.0f} s left"
    return f"{seconds / 60.0:.0f} min left" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h left"
