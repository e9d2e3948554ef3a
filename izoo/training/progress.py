"""What a run shows while it trains: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

SHOWN = (
    ("frames_per_s", "{:.0f} frames/s"),
    ("return", "return {:.1f}"),
    ("emission_g_per_vehicle", "{:.1f} g/veh"),
    ("throughput_veh_per_episode", "{:.0f} veh/episode"),
)
LINE_EVERY_S = 10.0


class ProgressBar:
    """Shows frames done, frames/s, and the latest return, emission per vehicle and throughput.

    Args:
        total: frames of the whole run.
        done: frames that earlier parts of the run have done.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self.total = total
        self._latest: dict[str, float] = {}
        self._last_line = time.monotonic()
        self._console = Console(file=sys.stdout)
        self._bar: Progress | None = None
        if self._console.is_terminal:
            columns = (BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
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
        text = "  ".join(form.format(self._latest[name]) for name, form in SHOWN if name in self._latest)
        if self._bar is not None:
            self._bar.update(self._task, completed=frames, description=text)
        elif time.monotonic() - self._last_line >= LINE_EVERY_S or frames >= self.total:
            self._last_line = time.monotonic()
            print(f"{frames:>10,} / {self.total:,}  {text}", flush=True)
