"""The training runs of a part of a campaign: how far each is, and how it begins or goes on."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from izoo.benchmarks.campaign.parallel_training import ParallelRuns
from izoo.conf.train_options import CHANGEABLE, TrainConfig
from izoo.console import Progress, counted
from izoo.options import to_mapping
from izoo.report.report_data import TRAIN_FOLDER
from izoo.results.store import check_same
from izoo.training import checkpoint, run_folder
from izoo.training.loggers import MetricsTable
from izoo.training.loop import train

Key = tuple[str, int]
"""Of a run: the entry's name and the training seed."""
LOG_SUFFIX = ".log"
"""Of the file beside a run's folder that takes what it says, where it does not learn in this process."""
LOOK_EVERY_S = 1.0
"""How often runs in other processes are looked at."""
NOT_THE_RUN = (*CHANGEABLE, "run_dir", "start", "task")
"""Options in which a run that is there may differ from the one that is wanted."""


class TrainingRuns:
    """Training runs, each in a folder of its own, ``train/NAME/seedK``.

    Args:
        wanted: options of every run, apart from ``run_dir``.
        folder: of the part.
        validated: runs that are not finished before their candidates are validated.
    """

    def __init__(self, wanted: Mapping[Key, TrainConfig], folder: Path, validated: Collection[str] = ()) -> None:
        self.folder, self._validated = folder / TRAIN_FOLDER, validated
        self.wanted = {
            key: dataclasses.replace(config, run_dir=str(self.run_dir(key))) for key, config in wanted.items()
        }

    def run_dir(self, key: Key) -> Path:
        """Return the folder of a run."""
        return self.folder / key[0] / f"seed{key[1]}"

    def frames(self, key: Key) -> int:
        """Return the frames of a run's newest checkpoint; 0: it has none."""
        found = checkpoint.listed(self.run_dir(key))
        return checkpoint.frames_of(found[-1]) if found else 0

    def left(self, key: Key) -> int:
        """Return the frames that a run has still to learn from."""
        learned, _ = MetricsTable.read(self.run_dir(key) / run_folder.METRICS_FILE).series("seconds")
        return max(self.wanted[key].total_frames - max(learned, default=0), 0)

    def is_trained(self, key: Key) -> bool:
        """Whether a run has all its frames, and owes no validation.

        Raises:
            IzooError: the run that is there is not the one that is wanted.
        """
        if not self.frames(key):
            return False
        stored, mine = (
            {name: value for name, value in to_mapping(config).items() if name not in NOT_THE_RUN}
            for config in (run_folder.read_config(self.run_dir(key)), self.wanted[key])
        )
        for part in (*run_folder.with_drivers(stored), *run_folder.with_drivers(mine)):
            part["drivers"] = Path(part["drivers"]).read_text()  # a run keeps a copy
        check_same(stored, mine, f"{self.run_dir(key)} was trained")
        return self.is_finished(key)

    def train(self, key: Key) -> None:
        """Train a run, or the rest of it, in this process.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        train(self._begin(key))
        self._require_trained(key)

    def train_in_parallel(self, runs: ParallelRuns, keys: Sequence[Key]) -> None:
        """Train the first of these runs, and those that come next, in processes of their own; wait for the first.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        total = sum(self.wanted[key].total_frames for key in keys)
        with Progress(total, total - sum(map(self.left, keys))) as bar:
            while True:
                for key in keys:
                    if runs.has_room and key not in runs:
                        runs.begin(key, self._begin(key), self.run_dir(key).with_suffix(LOG_SUFFIX))
                if runs.is_done(keys[0]):
                    break
                left = sum(map(self.left, keys))
                bar.update(total - left, counted(len(runs.going), "run") + ("" if left else " validating"))
                time.sleep(LOOK_EVERY_S)
        self._require_trained(keys[0])

    def _begin(self, key: Key) -> TrainConfig:
        """Return the options of a run that begins or goes on."""
        run_dir, wanted = self.run_dir(key), self.wanted[key]
        if self.frames(key):
            own = {name: getattr(wanted, name) for name in ("total_frames", "num_workers", "collector")}
            return dataclasses.replace(run_folder.resumed(run_dir), **own)
        if run_dir.is_dir():  # it ended before its first checkpoint; its process may outlive the campaign's
            with run_folder.owned(run_dir):
                shutil.rmtree(run_dir, ignore_errors=True)
        return wanted

    def _require_trained(self, key: Key) -> None:
        """Raise :class:`KeyboardInterrupt` where a run, or a validation that it owes, was stopped."""
        if not self.is_finished(key):
            raise KeyboardInterrupt

    def is_finished(self, key: Key) -> bool:
        """Whether the run that is there has all its frames, and owes no validation."""
        owed = key[0] in self._validated and bool(checkpoint.candidates(self.run_dir(key)))
        return self.frames(key) >= self.wanted[key].total_frames and not owed
