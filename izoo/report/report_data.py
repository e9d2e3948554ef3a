"""What a folder of results holds: evaluations, and training runs with their learning curves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.errors import IzooError
from izoo.files import check_folder
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import BASELINES, HUMAN, PLANNER, UNCOMMANDED, pair, simulators
from izoo.metrics.paper_form import paper_form
from izoo.metrics.summary import TRAINING, summarise
from izoo.report.tables import ranking
from izoo.results.schema import FEATURES
from izoo.results.store import MANIFEST_FILE, ROWS_FILE, Manifest, read_manifest, read_table
from izoo.training.loggers import MetricsTable
from izoo.training.run_folder import CONFIG_FILE, EVALUATIONS, METRICS_FILE
from izoo.training.validation import VALIDATION_FILE

TRAIN_FOLDER = "train"
Curves = dict[str, list[tuple[MetricsTable, MetricsTable | None]]]


@dataclass(frozen=True)
class Evaluation:
    """The rows of a task in a results folder, played on one simulator.

    Attributes:
        name: how the report calls it.
        trained_on: rows of the same policies on contexts of their training.
        run: the folder of the training run that it belongs to.
    """

    name: str
    task: str
    folder: Path
    table: pd.DataFrame = field(repr=False)
    trained_on: pd.DataFrame = field(repr=False)
    manifest: Manifest
    run: Path | None = None

    @cached_property
    def summary(self) -> dict[str, Any]:
        """:func:`izoo.metrics.summary.summarise` of the table."""
        return summarise(self.table, trained_on=self.trained_on)

    @property
    def policies(self) -> list[str]:
        """Names of the policies, the best first and uncommanded last; human driving is only compared with."""
        return sorted((name for name in ranking(self.summary) if name != HUMAN), key=UNCOMMANDED.__eq__)

    def contexts(self, policy: str) -> pd.DataFrame:
        """Return every figure over uncommanded per training seed and context (:class:`izoo.metrics.pairing.Paired`)."""
        contexts, own, baseline = pair(self.table, policy, UNCOMMANDED)
        return contexts.assign(**{name: figure.value(own, baseline) for name, figure in FIGURES.items()})

    @cached_property
    def paper(self) -> dict[str, dict[str, Any]]:
        """The paper's form of every policy."""
        return {name: paper_form(self.table, name)[1] for name in self.policies}


@dataclass(frozen=True)
class Results:
    """Everything that a report shows: its title, evaluations, learning curves, and facts with their labels."""

    title: str
    evaluations: tuple[Evaluation, ...] = ()
    curves: Curves = field(default_factory=dict)
    facts: tuple[tuple[str, str], ...] = ()


def collect(folder: Path, partial: bool = False) -> Results:
    """Read the folder of an evaluation, of a training run and its evaluations, or of a benchmark.

    Args:
        partial: accept results that are not complete.

    Raises:
        IzooError: the folder is something else, or what is missing in it.
    """
    check_folder(folder, "give one that izoo.evaluate, izoo.train or a benchmark has written")
    name, run = folder.resolve().name, folder if (folder / CONFIG_FILE).exists() else None
    places = [folder] if (folder / MANIFEST_FILE).exists() or (folder / ROWS_FILE).exists() else []
    places += sorted(path.parent for path in (folder / EVALUATIONS).glob(f"*/{MANIFEST_FILE}"))
    found = tuple(each for place in places for each in _evaluations(place, run, partial))
    curves = read_curves(folder)
    if not found and not curves:
        raise IzooError(
            f"{folder} holds no results: neither {ROWS_FILE} (izoo.evaluate, a benchmark) nor {METRICS_FILE} "
            "(izoo.train)."
        )
    if len(found) == 1 and found[0].task not in ("", name) and run is None:
        name = f"{name}: {found[0].task}"
    if folder.resolve().parent.name == EVALUATIONS:
        name = f"{folder.resolve().parent.parent.name}: {name}"
    return Results(name, found, curves, _facts(found))


def _evaluations(folder: Path, run: Path | None, partial: bool) -> list[Evaluation]:
    """Return the evaluations of a folder, one per task, the manifest's first."""
    table, manifest = read_table(folder), read_manifest(folder)
    if not manifest.complete and not partial:
        raise IzooError(
            f"{folder} is not finished; start the same command again, it goes on where it stopped; or report what is "
            "there: partial=true."
        )
    table = table[(table["simulator"] == simulators(table)[0]) & (table["policy"] != PLANNER)]
    parts = {str(task): rows for task, rows in table.groupby("task")}
    tasks = sorted((task for task in parts if not task.endswith(TRAINING)), key=lambda task: task != manifest.task)
    found = []
    for task in tasks:
        rows = parts[task]
        lacking = [baseline for baseline in BASELINES if baseline not in set(rows["policy"])]
        if lacking:
            raise IzooError(f"{folder} has no rows of {' and '.join(lacking)}; evaluate again with out={folder}.")
        name = task if len(tasks) > 1 else folder.resolve().name
        trained_on = parts.get(task + TRAINING, rows.iloc[:0])
        found.append(Evaluation(name, task, folder, rows, trained_on, manifest, run))
    return found


def _facts(found: tuple[Evaluation, ...]) -> tuple[tuple[str, str], ...]:
    texts: dict[str, dict[str, None]] = {}
    for evaluation in found:
        manifest = evaluation.manifest
        versions = ", ".join(f"{name} {str(text)[:16]}" for name, text in manifest.versions.items())
        for label, text in (
            ("task", manifest.task),
            ("model version", str(manifest.model_version)),
            ("versions", versions),
            ("state", "" if manifest.complete else f"{evaluation.name} is not complete"),
        ):
            if text:
                texts.setdefault(label, {})[text] = None
    return tuple((label, "; ".join(of)) for label, of in texts.items())


def read_curves(folder: Path) -> Curves:
    """Return the learning curves of a run, or of the runs ``train/NAME/seedK`` of a benchmark."""
    found: Curves = {}
    for path in [folder / METRICS_FILE, *sorted((folder / TRAIN_FOLDER).glob(f"*/*/{METRICS_FILE}"))]:
        if path.is_file():
            run = path.parent
            name = run.resolve().name if run == folder else run.parent.name
            validation = run / VALIDATION_FILE
            pair = MetricsTable.read(path), MetricsTable.read(validation) if validation.is_file() else None
            found.setdefault(name, []).append(pair)
    return found


def context_rows(evaluations: tuple[Evaluation, ...]) -> dict[str, list[Any]]:
    """Return a row per policy and context as columns: names, every figure over uncommanded, and :data:`FEATURES`.

    Of several training seeds the numbers are means.
    """
    parts = []
    for evaluation in evaluations:
        grouped = evaluation.table.groupby("context_hash")
        features = grouped[list(FEATURES)].first()
        for policy in evaluation.policies:
            found = evaluation.contexts(policy)
            means = found.groupby("context_hash")[list(FIGURES)].mean()
            means["context"] = found.groupby("context_hash")["context"].first()
            means["train_seeds"] = found.groupby("context_hash")["train_seed"].nunique()
            parts.append(means.join(features).assign(policy=policy, test=evaluation.name))
    columns = ["context", "policy", "test", *FIGURES, *FEATURES, "train_seeds"]
    rows = pd.concat(parts) if parts else pd.DataFrame(columns=columns)

    def shown(value: Any) -> Any:
        """Six digits are more than is shown, and keep the page small; JSON has no NaN."""
        return value if isinstance(value, str) else float(f"{value:.6g}") if math.isfinite(value) else None

    return {name: list(map(shown, rows[name])) for name in columns}
