"""The folder that ``python -m izoo.benchmarks.generalization`` leaves, and its index ``results.json``.

::

    RESULTS/
      settings.yaml                  every option of the benchmark, resolved; what a second start is checked against
      results.json                   the index described below
      learning_curves.png            return and emission of all training runs; not where nothing was trained
      train/ENTRY/seedK/             a run folder of izoo.train: config.yaml, metrics.csv, checkpoints, ...
      evaluation/ENTRY/seedK/        evaluation.csv (izoo.evaluation.table), evaluation.json, summary.json
      evaluation_human_vehicles/...  the same on CVs with the parameters of human-driven vehicles, where asked for
      leaderboard/ENTRY.json         one submission per entry (izoo.reporting.submissions)

An **entry** is what is compared: an algorithm with its action (``ppo``, ``ppo_residual``), or a scripted driver
(``glide``, ``uncommanded``), which needs no training and has one run with seed 0. In ``evaluation.csv`` of an entry the
column ``policy`` holds ``human``, ``uncommanded`` and the entry's name, in every seed alike. Paths in the index are
relative to the folder, so that it can be moved.

``results.json``::

    {"format": "izoo-results-1",
     "title": "salt_lake_city -> atlanta",       # "train -> test", as in the published histograms
     "protocol": "productivity",                 # in_distribution | productivity | systematicity
     "scale": "small",                           # smoke | small | paper
     "settings": {...},                          # settings.yaml as a mapping
     "versions": {"izoo": ..., "sumo": ..., "torch": ..., "torchrl": ..., "python": ...},
     "contexts": {"train": "text", "test": "text", "test_count": 105, "eval_seeds": 3},
     "complete": true,                           # every run of every entry is done
     "entries": [
       {"name": "ppo", "kind": "trained", "algo": "ppo", "action": "direct",
        "runs": [{"seed": 0, "status": "done", "run": "train/ppo/seed0", "evaluation": "evaluation/ppo/seed0",
                  "frames": 195000, "seconds": 812.4}]},
       {"name": "glide", "kind": "scripted", "algo": null, "action": null,
        "runs": [{"seed": 0, "status": "done", "run": null, "evaluation": "evaluation/glide/seed0",
                  "frames": 0, "seconds": 0.0}]}],
     "aggregates": {"entries": {"ppo": {...}},   # izoo.evaluation.across.aggregate of its runs, against human driving;
                                                # "nan_share": of its commands that were NaN;
                                                # "human_vehicles": compare() of those evaluations, where there are any
                    "improvement": [...],        # izoo.evaluation.across.compare_entries
                    "profiles": {...},
                    "approaches": 105}}          # {} until every run is done

``status`` is ``waiting``, ``training``, ``trained`` or ``done``; only of ``done`` runs is the evaluation whole. The
index is rewritten, whole or not at all, whenever a run changes its status.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from izoo.conf.mapping import from_mapping, to_mapping
from izoo.errors import IzooError
from izoo.evaluation.table import CSV_FILE, MANIFEST_FILE, read_csv
from izoo.files import read_text, write_json

FORMAT = "izoo-results-1"
RESULTS_FILE, SETTINGS_FILE = "results.json", "settings.yaml"
TRAIN_FOLDER, EVALUATION_FOLDER, LEADERBOARD_FOLDER = "train", "evaluation", "leaderboard"
HUMAN_VEHICLES_FOLDER = "evaluation_human_vehicles"
STATUSES = ("waiting", "training", "trained", "done")


@dataclass(frozen=True)
class RunRecord:
    """One training seed of an entry.

    Attributes:
        seed: of training, or of the weights before it; 0 for scripted drivers.
        status: one of :data:`STATUSES`.
        evaluation: folder of its evaluation, relative to the results folder.
        run: its run folder, relative to the results folder; ``None`` for scripted drivers.
        frames: environment steps that it was trained for.
        seconds: that its training took.
    """

    seed: int
    status: str
    evaluation: str
    run: str | None = None
    frames: int = 0
    seconds: float = 0.0

    @property
    def human_vehicles(self) -> str:
        """Folder of its evaluation on CVs with the parameters of human-driven vehicles, where there is one."""
        return f"{HUMAN_VEHICLES_FOLDER}/{self.evaluation.removeprefix(f'{EVALUATION_FOLDER}/')}"


@dataclass(frozen=True)
class EntryRecord:
    """One compared entry.

    Attributes:
        name: of the entry, and of its policy in the evaluation tables.
        kind: ``trained`` or ``scripted``.
        algo: the training algorithm, or ``None``.
        action: ``direct``, ``advise`` or ``residual``, or ``None``.
        runs: one per training seed, in order.
    """

    name: str
    kind: str
    algo: str | None
    action: str | None
    runs: tuple[RunRecord, ...]

    @property
    def done(self) -> tuple[RunRecord, ...]:
        """The runs whose evaluation is whole."""
        return tuple(run for run in self.runs if run.status == "done")


@dataclass(frozen=True)
class Results:
    """The index of a results folder; the module's docstring describes its fields."""

    title: str
    protocol: str
    scale: str
    settings: dict
    versions: dict
    contexts: dict
    entries: tuple[EntryRecord, ...]
    complete: bool = False
    aggregates: dict = field(default_factory=dict)
    format: str = FORMAT

    def entry(self, name: str) -> EntryRecord:
        """Return the entry ``name``; raises :class:`IzooError` where there is none."""
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise IzooError(f"the results have no entry {name!r}; they have {', '.join(e.name for e in self.entries)}.")


def write_results(folder: Path, results: Results) -> None:
    """Write ``results.json``, whole or not at all."""
    write_json(folder / RESULTS_FILE, to_mapping(results))


def read_results(folder: Path) -> Results:
    """Read the index of a results folder.

    Raises:
        IzooError: there is none, it is damaged, or another version of izoo wrote it.
    """
    path = folder / RESULTS_FILE
    if not path.is_file():
        raise IzooError(f"{folder} has no {RESULTS_FILE}; give a folder that izoo.benchmarks.generalization wrote.")
    try:
        values = json.loads(read_text(path))
        found = values.get("format")
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise IzooError(f"{path} is damaged; run the benchmark again with out={folder}, it goes on.") from error
    if found != FORMAT:
        raise IzooError(f"{path} is of the format {found!r}, not {FORMAT!r}; another version of izoo wrote it.")
    try:
        results = from_mapping(Results, values)
    except (TypeError, IzooError) as error:
        raise IzooError(f"{path} is damaged: {error}") from error
    for run in (run for entry in results.entries for run in entry.runs):
        if run.status not in STATUSES:
            raise IzooError(f"{path} is damaged: {run.status!r} is no status of a run.")
        for place in (run.evaluation, run.run or "."):
            if Path(place).is_absolute() or ".." in Path(place).parts:
                raise IzooError(f"{path} is damaged: {place!r} lies outside of the folder.")
    return results


def evaluation_of(folder: Path, run: RunRecord) -> pd.DataFrame:
    """Read the evaluation table of a run that is done."""
    return read_csv(folder / run.evaluation / CSV_FILE)


def simulator_of_run(folder: Path, run: RunRecord) -> str:
    """Return what played the evaluation of a run that is done."""
    return str(json.loads(read_text(folder / run.evaluation / MANIFEST_FILE))["settings"].get("simulator", "sumo"))


def human_vehicles_of(folder: Path, run: RunRecord) -> pd.DataFrame | None:
    """Read the table of a run on CVs with the parameters of human-driven vehicles; ``None``: there is none."""
    path = folder / run.human_vehicles / CSV_FILE
    return read_csv(path) if path.is_file() else None


def with_run(results: Results, name: str, changed: RunRecord) -> Results:
    """Return the index with one run of one entry replaced (by its seed)."""
    entries = []
    for entry in results.entries:
        if entry.name == name:
            runs = tuple(changed if run.seed == changed.seed else run for run in entry.runs)
            entry = dataclasses.replace(entry, runs=runs)
        entries.append(entry)
    complete = all(run.status == "done" for entry in entries for run in entry.runs)
    return dataclasses.replace(results, entries=tuple(entries), complete=complete)
