"""The training runs of a benchmark: how far each of them is, and how it begins, goes on or is taken over."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from izoo.benchmarks.campaign.parallel_training import ParallelRuns
from izoo.conf.mapping import to_mapping
from izoo.conf.train_options import TrainConfig
from izoo.console import Progress, counted
from izoo.envs import MODEL_VERSION
from izoo.errors import IzooError
from izoo.files import replacing_folder
from izoo.results.store import check_same, read_manifest
from izoo.training import checkpoint, run_folder
from izoo.training.loggers import MetricsTable
from izoo.training.loop import train

Key = tuple[str, int]
"""Of a run: the entry's name and the training seed."""
TRAIN_FOLDER = "train"
LOG_SUFFIX = ".log"
"""Of the file beside a run's folder that takes what it says, where it does not learn in this process."""
LOOK_EVERY_S = 1.0
"""How often runs in other processes are looked at."""
NOT_THE_RUN = (*run_folder.CHANGEABLE, "run_dir")
"""Options in which a run that is there may differ from the one that is wanted."""
NOT_THE_NUMBERS = ("run_dir", "resume")
"""The same for a run that is taken over whole."""


class TrainingRuns:
    """The training runs of a benchmark, each in a folder of its own, ``train/NAME/seedK``.

    Args:
        wanted: options of every run, apart from ``run_dir``.
        folder: of the results.
        owes_validation: whether a run with candidates that are not validated yet is not finished.
    """

    def __init__(self, wanted: Mapping[Key, TrainConfig], folder: Path, owes_validation: bool = False) -> None:
        self.folder, self._owes_validation = folder / TRAIN_FOLDER, owes_validation
        self.wanted = {
            key: dataclasses.replace(config, run_dir=str(self.run_dir(key))) for key, config in wanted.items()
        }

    def run_dir(self, key: Key) -> Path:
        """Return the folder of a run."""
        return self.folder / key[0] / f"seed{key[1]}"

    def frames(self, key: Key) -> int:
        """Return the frames of a run's newest checkpoint; 0: it has none."""
        return _frames(self.run_dir(key))

    def left(self, key: Key) -> int:
        """Return the frames that a run has still to learn from."""
        learned, _ = MetricsTable.read(self.run_dir(key) / run_folder.METRICS_FILE).series("seconds")
        return max(self.wanted[key].total_frames - max(learned, default=0), 0)

    def is_trained(self, key: Key) -> bool:
        """Whether a run has all its frames, and owes no validation.

        Raises:
            IzooError: the run that is there is not the one that is wanted.
        """
        if self.frames(key):
            _check(self.run_dir(key), self.wanted[key], NOT_THE_RUN)
        return self._is_finished(key, self.run_dir(key))

    def take_over(self, source: Path) -> None:
        """Copy the runs that are finished in the results folder of another benchmark, and have not begun here.

        Raises:
            IzooError: ``source`` holds no results, those of another model of the simulation, or other runs.
        """
        theirs = read_manifest(source).model_version
        if theirs != MODEL_VERSION:
            raise IzooError(
                f"trained_in: {source} is of model version {theirs}, and this is {MODEL_VERSION}; leave it out to "
                "train again."
            )
        begin = [key for key in self.wanted if self.frames(key) == 0]
        there = {key: source / TRAIN_FOLDER / self.run_dir(key).relative_to(self.folder) for key in begin}
        there = {key: path for key, path in there.items() if self._is_finished(key, path)}
        for key, path in there.items():
            _check(path, self.wanted[key], NOT_THE_NUMBERS)
        for key, path in there.items():
            self._clear(key)
            with replacing_folder(self.run_dir(key)) as partial:
                shutil.copytree(path, partial, dirs_exist_ok=True)
        lacking = [f"{name} seed {seed}" for name, seed in begin if (name, seed) not in there]
        still = f"; still to be trained: {', '.join(lacking)}" if lacking else ""
        print(f"{counted(len(there), 'training run')} taken over from {source}{still}.", flush=True)

    def train(self, key: Key) -> None:
        """Train a run, or the rest of it, in this process.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        train(*self._begin(key))
        self._require_trained(key)

    def train_beside(self, beside: ParallelRuns, keys: Sequence[Key]) -> None:
        """Train the first of these runs, and those that come next, in processes of their own; wait for the first.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        total = sum(self.wanted[key].total_frames for key in keys)
        with Progress(total, total - sum(map(self.left, keys))) as bar:
            while True:
                for key in keys:
                    if beside.has_room and key not in beside:
                        beside.begin(key, *self._begin(key), self.run_dir(key).with_suffix(LOG_SUFFIX))
                if beside.is_done(keys[0]):
                    break
                bar.update(total - sum(map(self.left, keys)), counted(len(beside.going), "run"))
                time.sleep(LOOK_EVERY_S)
        self._require_trained(keys[0])

    def _begin(self, key: Key) -> tuple[TrainConfig, frozenset[str]]:
        """Return the options of a run that begins or goes on, and the names of those that count when it goes on."""
        if self.frames(key) == 0:
            self._clear(key)
            return self.wanted[key], frozenset()
        resumed = dataclasses.replace(self.wanted[key], resume=str(self.run_dir(key)))
        return resumed, frozenset({"resume", "total_frames", "num_workers", "collector"})

    def _clear(self, key: Key) -> None:
        """Remove a run that ended before its first checkpoint."""
        run_dir = self.run_dir(key)
        if run_dir.is_dir():
            with run_folder.owned(run_dir):  # the process of a run may outlive its benchmark: it is waited for
                shutil.rmtree(run_dir, ignore_errors=True)

    def _require_trained(self, key: Key) -> None:
        """Raise :class:`KeyboardInterrupt` where a run, or a validation that it owes, was stopped."""
        if not self._is_finished(key, self.run_dir(key)):
            raise KeyboardInterrupt

    def _is_finished(self, key: Key, run_dir: Path) -> bool:
        owed = self._owes_validation and bool(checkpoint.candidates(run_dir))
        return _frames(run_dir) >= self.wanted[key].total_frames and not owed


def _check(run_dir: Path, wanted: TrainConfig, without: Sequence[str]) -> None:
    """Raise :class:`IzooError` where a run has other options than ``wanted``, apart from those of ``without``."""
    stored, mine = (
        {name: value for name, value in to_mapping(config).items() if name not in without}
        for config in (run_folder.read_config(run_dir), wanted)
    )
    check_same(stored, mine, f"{run_dir} was trained")


def _frames(run_dir: Path) -> int:
    """Return the frames of a run's newest checkpoint; 0: it has none."""
    found = checkpoint.listed(run_dir)
    return int(found[-1].stem.rpartition("-")[2]) if found else 0
