"""The training runs of a benchmark: how far each of them is, and how it begins, goes on or is taken over."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from izoo.benchmarks.claim import check_run, check_source, check_taken
from izoo.benchmarks.side_runs import Order, SideRuns
from izoo.conf.train_options import TrainConfig
from izoo.console import Progress, counted
from izoo.files import replacing_folder
from izoo.training import checkpoint, runs
from izoo.training.loop import train
from izoo.training.records import MetricsTable

Key = tuple[str, int]
"""Of a run: the entry's name and the training seed."""

LOG_SUFFIX = ".log"
"""Of the file beside a run's folder that takes what it says, where it does not learn in this process."""
LOOK_EVERY_S = 1.0
"""How often runs in other processes are looked at."""


class TrainingRuns:
    """The training runs of a benchmark, each in a folder of its own.

    Args:
        wanted: options of every run.
        folder: where they are, each in :func:`place`.
        owes_validation: whether a run with candidates that are not validated yet is not finished.
        begins: called with a run before it begins or goes on, and with whether it has other weights from then on than
            those that may have been tested.
    """

    def __init__(
        self,
        wanted: Mapping[Key, TrainConfig],
        folder: Path,
        *,
        owes_validation: bool,
        begins: Callable[[Key, bool], None],
    ) -> None:
        self.wanted, self.folder = wanted, folder
        self._owes_validation, self._begins = owes_validation, begins
        self._source: Path | None = None

    def run_dir(self, key: Key) -> Path:
        """Return the folder of a run."""
        return self.folder / place(*key)

    def frames(self, key: Key) -> int:
        """Return the frames of a run's newest checkpoint; 0: it has none."""
        return _frames(self.run_dir(key))

    def seconds(self, key: Key) -> float:
        """Return how long a run was trained for, so far."""
        return trained_for_s(self.run_dir(key))

    def left(self, key: Key) -> int:
        """Return the frames that a run has still to learn from."""
        return max(self.wanted[key].total_frames - _learned(self.run_dir(key)), 0)

    def is_trained(self, key: Key) -> bool:
        """Whether a run has all its frames, and owes no validation."""
        return self._is_finished(key, self.run_dir(key))

    def check(self, key: Key) -> None:
        """Raise :class:`IzooError` where the run that is there is not the one that is wanted."""
        check_run(self.run_dir(key), self.wanted[key])

    def take_from(self, source: Path, now: Mapping[str, str]) -> None:
        """Let runs be taken over from the results folder of another benchmark (:meth:`take_over`).

        Args:
            source: its runs are in ``source / folder.name``.
            now: versions, which must be those of the other benchmark.

        Raises:
            IzooError: it has other versions, or a finished run there is not the one that is wanted.
        """
        check_source(source, now)
        self._source = source / self.folder.name
        for key, wanted in self.wanted.items():
            if self._is_finished(key, self._source / place(*key)):
                check_taken(self._source / place(*key), wanted)

    def take_over(self, keys: Sequence[Key]) -> None:
        """Copy those of these runs that have not begun here and are finished elsewhere, and say what is left."""
        if self._source is None:
            return
        begin = [key for key in keys if self.frames(key) == 0]
        taken = [key for key in begin if self._is_finished(key, self._source / place(*key))]
        for key in taken:
            self._clear(key)
            self._begins(key, True)
            with replacing_folder(self.run_dir(key)) as partial:
                shutil.copytree(self._source / place(*key), partial, dirs_exist_ok=True)
        missing = [f"{name} seed {seed}" for name, seed in begin if (name, seed) not in taken]
        still = f"; still to be trained: {', '.join(missing)}" if missing else ""
        text = f"{counted(len(taken), 'training run')} taken over from {self._source.parent}{still}."
        print(text, flush=True)

    def train(self, key: Key) -> None:
        """Train a run, or the rest of it, in this process.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        train(*self._begin(key))
        self._require_trained(key)

    def train_beside(self, beside: SideRuns, keys: Sequence[Key]) -> None:
        """Train the first of these runs, and those that come next, in processes of their own; wait for the first.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        total = sum(self.wanted[key].total_frames for key in keys)
        with Progress(total, total - sum(map(self.left, keys))) as bar:
            while True:
                for key in keys:
                    if beside.has_room and key not in beside:
                        beside.begin(key, Order(*self._begin(key), self.run_dir(key).with_suffix(LOG_SUFFIX)))
                if beside.is_done(keys[0]):
                    break
                bar.update(total - sum(map(self.left, keys)), counted(len(beside.going), "run"))
                time.sleep(LOOK_EVERY_S)
        self._require_trained(keys[0])

    def _begin(self, key: Key) -> tuple[TrainConfig, frozenset[str]]:
        """Return the options of a run that begins or goes on, and the names of those that count when it goes on."""
        wanted, anew = self.wanted[key], self.frames(key) == 0
        if anew:
            self._clear(key)
        self._begins(key, anew)
        if anew:
            return wanted, frozenset()
        resumed = dataclasses.replace(wanted, resume=str(self.run_dir(key)))
        return resumed, frozenset({"resume", "total_frames", "num_workers", "collector"})

    def _clear(self, key: Key) -> None:
        """Remove a run that ended before its first checkpoint."""
        run_dir = self.run_dir(key)
        if run_dir.is_dir():
            with runs.owned(run_dir):  # where the process of a run outlives its benchmark, it is to be waited for
                shutil.rmtree(run_dir, ignore_errors=True)

    def _require_trained(self, key: Key) -> None:
        """Raise :class:`KeyboardInterrupt` where a run, or a validation that it owes, was stopped."""
        if not self.is_trained(key):
            raise KeyboardInterrupt

    def _is_finished(self, key: Key, run_dir: Path) -> bool:
        owed = self._owes_validation and bool(checkpoint.candidates(run_dir))
        return _frames(run_dir) >= self.wanted[key].total_frames and not owed


def place(name: str, seed: int) -> str:
    """Return the folder of a training seed of an entry, relative to that of all."""
    return f"{name}/seed{seed}"


def _frames(run_dir: Path) -> int:
    """Return the frames of a run's newest checkpoint; 0: it has none."""
    found = checkpoint.listed(run_dir)
    return int(found[-1].stem.rpartition("-")[2]) if found else 0


def trained_for_s(run_dir: Path) -> float:
    """Return how long a run was trained for, so far."""
    _, seconds = MetricsTable.read(run_dir / runs.METRICS_FILE).series("seconds")
    return max(seconds, default=0.0)


def _learned(run_dir: Path) -> int:
    """Return the frames that a run has learned from, so far."""
    frames, _ = MetricsTable.read(run_dir / runs.METRICS_FILE).series("seconds")
    return max(frames, default=0)
