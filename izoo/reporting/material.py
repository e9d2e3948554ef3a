"""What a report is made of: the evaluations, training runs and trade-offs that a results folder holds."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.envs.config import SIMULATOR_NAMES
from izoo.errors import IzooError
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.table import CSV_FILE, JOURNAL_FILE, MANIFEST_FILE, read_csv
from izoo.files import check_folder, read_text
from izoo.reporting.results import RESULTS_FILE, EntryRecord, read_results
from izoo.training.records import MetricsTable
from izoo.training.runs import CONFIG_FILE, METRICS_FILE
from izoo.training.validation import VALIDATION_FILE

TRADEOFFS_FILE = "tradeoffs.csv"
EVALUATIONS = "evaluations"
BRIEF = "training contexts"
"""What the brief evaluation that ends a run is called; it lies in the run folder itself."""
TRADEOFF_NUMBERS = ("emission_g_per_vehicle", "travel_time_s_per_vehicle")
TRADEOFF_FLAGS = ("throughput_kept", "on_front")
TRADEOFF_COLUMNS = ("point", "kind", *TRADEOFF_NUMBERS, *TRADEOFF_FLAGS)
"""What the report needs of ``tradeoffs.csv``."""


@dataclass(frozen=True)
class Evaluated:
    """One training seed of a policy, evaluated.

    Attributes:
        seed: of training; 0 where nothing was trained.
        folder: of the evaluation.
        table: its rows of the policy, human driving and the uncommanded CV.
        run: the folder of the training run, where it is known.
    """

    seed: int
    folder: Path
    table: pd.DataFrame
    run: Path | None = None


@dataclass(frozen=True)
class Entry:
    """A policy of the report.

    Attributes:
        name: how the report calls it.
        policy: its name in the tables.
        test: which evaluation it belongs to; policies are compared within one.
        runs: its training seeds.
    """

    name: str
    policy: str
    test: str
    runs: tuple[Evaluated, ...]


@dataclass(frozen=True)
class Curve:
    """A training run: its table and, where it has one, that of its validations."""

    name: str
    metrics: pd.DataFrame
    validation: pd.DataFrame | None = None


@dataclass(frozen=True)
class Material:
    """Everything that a report shows.

    Attributes:
        title: for example ``train -> test``.
        kind: ``evaluation``, ``run``, ``benchmark`` or ``tradeoffs``.
        entries: the policies, the uncommanded CV among them where it was evaluated.
        curves: of the training runs.
        facts: label and text of what describes the results.
        tradeoffs: the table of a trade-off sweep.
        unfinished: runs of a benchmark that are not done.
    """

    title: str
    kind: str
    entries: tuple[Entry, ...] = ()
    curves: tuple[Curve, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    tradeoffs: pd.DataFrame | None = None
    unfinished: tuple[str, ...] = field(default=())


def collect(folder: Path, partial: bool = False) -> Material:
    """Read a results folder: an evaluation, a training run, a benchmark, or a trade-off sweep.

    Args:
        partial: accept a benchmark of which runs are not done.

    Raises:
        IzooError: the folder is something else, or what is missing in it.
    """
    check_folder(folder, "give one that izoo.evaluate, izoo.train or a benchmark has written")
    if (folder / RESULTS_FILE).exists():
        return _with_tradeoffs(_benchmark(folder, partial), folder)
    if (folder / CONFIG_FILE).exists():
        return _with_tradeoffs(_run(folder), folder)
    if any((folder / name).exists() for name in (CSV_FILE, MANIFEST_FILE, JOURNAL_FILE)):
        table, facts = read_evaluation(folder)
        title = _label(folder.resolve())
        return Material(title, "evaluation", _entries(folder, table, title, None), (), facts)
    if (folder / TRADEOFFS_FILE).exists():
        return _with_tradeoffs(Material(_label(folder.resolve()), "tradeoffs"), folder)
    raise IzooError(
        f"{folder} holds no results: it has no {CSV_FILE} (izoo.evaluate), {CONFIG_FILE} (izoo.train), "
        f"{RESULTS_FILE} (izoo.benchmarks.generalization) or {TRADEOFFS_FILE} (izoo.benchmarks.tradeoffs)."
    )


def read_evaluation(folder: Path) -> tuple[pd.DataFrame, tuple[tuple[str, str], ...]]:
    """Return the table of a whole evaluation, and facts about it.

    Raises:
        IzooError: the evaluation is half-written, damaged, or lacks human driving.
    """
    if (folder / JOURNAL_FILE).exists():
        raise IzooError(
            f"{folder} holds an evaluation that was interrupted ({JOURNAL_FILE} is there); "
            "start the same command again, it goes on where it stopped."
        )
    missing = [name for name in (CSV_FILE, MANIFEST_FILE) if not (folder / name).is_file()]
    if missing:
        raise IzooError(f"{folder} has no {' and no '.join(missing)}; evaluate again with out={folder}.")
    table = read_csv(folder / CSV_FILE)
    if HUMAN not in set(table["policy"]):
        raise IzooError(f"{folder / CSV_FILE} has no rows of human driving; evaluate again with out={folder}.")
    try:
        manifest = json.loads(read_text(folder / MANIFEST_FILE))
        versions, env = manifest["settings"]["versions"], manifest["settings"]["env"]
        dict(manifest["policies"])  # which a replay needs
        facts = (
            ("played on", SIMULATOR_NAMES[manifest["settings"].get("simulator", "sumo")]),
            ("versions", f"izoo {versions['izoo']}, SUMO {versions['sumo']}"),
            ("episode", f"{env['horizon_s']:g} s, of which the first {env['warmup_s']:g} s are not measured"),
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise IzooError(f"{folder / MANIFEST_FILE} is damaged; remove the folder and evaluate again.") from error
    return table, facts


def _entries(folder: Path, table: pd.DataFrame, test: str, run: Path | None) -> tuple[Entry, ...]:
    names = [name for name in dict.fromkeys(table["policy"]) if name != HUMAN]
    names.sort(key=lambda name: name == UNCOMMANDED)
    entries = []
    for name in names:
        rows = table[table["policy"].isin({HUMAN, UNCOMMANDED, name})]
        entries.append(Entry(name, name, test, (Evaluated(0, folder, rows, run),)))
    return tuple(entries)


def _run(folder: Path) -> Material:
    path = folder.resolve()
    brief = [folder] if (folder / MANIFEST_FILE).exists() else []
    found = [*brief, *sorted(entry.parent for entry in (folder / EVALUATIONS).glob(f"*/{MANIFEST_FILE}"))]
    entries: list[Entry] = []
    facts: dict[str, dict[str, None]] = {}
    for place in found:
        table, stated = read_evaluation(place)
        for name, text in stated:
            facts.setdefault(name, {})[text] = None
        several = len(found) > 1
        test = BRIEF if place == folder else place.name
        named = _entries(place, table, test, path)
        entries += [dataclasses.replace(e, name=f"{e.name} on {test}") if several else e for e in named]
    curve = read_curve(folder, path.name)
    if curve is None and not entries:
        raise IzooError(f"{folder} has neither {METRICS_FILE} nor an evaluation yet; train or evaluate it first.")
    joined = tuple((name, "; ".join(texts)) for name, texts in facts.items())
    return Material(path.name, "run", tuple(entries), (curve,) if curve else (), joined)


def _benchmark(folder: Path, partial: bool) -> Material:
    results = read_results(folder)
    every = [(entry.name, run) for entry in results.entries for run in entry.runs]
    undone = tuple(f"{name} seed {run.seed} ({run.status})" for name, run in every if run.status != "done")
    if undone and not partial:
        raise IzooError(
            f"{folder} is not finished: {', '.join(undone[:6])}{' ...' if len(undone) > 6 else ''}; start the "
            "benchmark again with the same options, it goes on; or report what is there: partial=true."
        )
    entries: list[Entry] = []
    curves: list[Curve] = []
    for record in results.entries:
        for attribute, words in (("evaluation", ""), ("human_vehicles", ", human vehicles")):
            runs = _evaluated(folder, record, attribute)
            if runs:
                entries.append(Entry(record.name + words, record.name, results.title + words, runs))
        for run in record.runs:
            curve = read_curve(folder / run.run, f"{record.name} seed {run.seed}") if run.run else None
            curves += [curve] if curve else []
    if not entries:
        raise IzooError(f"{folder} has no finished run yet; start the benchmark again, it goes on where it stopped.")
    if UNCOMMANDED not in {entry.policy for entry in entries}:
        entries += [
            dataclasses.replace(entry, name=UNCOMMANDED, policy=UNCOMMANDED, runs=entry.runs[:1])
            for entry in entries[:1]
            if UNCOMMANDED in set(entry.runs[0].table["policy"])
        ]
    entries.sort(key=lambda entry: entry.policy == UNCOMMANDED)
    return Material(
        results.title, "benchmark", tuple(entries), tuple(curves), _benchmark_facts(results), unfinished=undone
    )


def _evaluated(folder: Path, record: EntryRecord, attribute: str) -> tuple[Evaluated, ...]:
    """Return an entry's runs of one kind of evaluation; empty unless all of them have it."""
    found = []
    for run in record.done:
        evaluation = folder / getattr(run, attribute)
        if attribute != "evaluation" and not evaluation.is_dir():
            return ()
        table, _ = read_evaluation(evaluation)
        found.append(Evaluated(run.seed, evaluation, table, folder / run.run if run.run else None))
    return tuple(found)


def _benchmark_facts(results: Any) -> tuple[tuple[str, str], ...]:
    facts = [("protocol", f"{results.protocol.replace('_', '-')}, scale {results.scale}")]
    facts += [(name, str(results.contexts[name])) for name in ("train", "test") if name in results.contexts]
    facts.append(("versions", ", ".join(f"{name} {str(value)[:16]}" for name, value in results.versions.items())))
    return tuple(facts)


def read_curve(run: Path, name: str) -> Curve | None:
    """Return the training curve of a run; ``None`` where it has no metrics yet.

    Raises:
        IzooError: a table cannot be read.
    """
    if not (run / METRICS_FILE).is_file():
        return None
    metrics = _frames_table(run / METRICS_FILE)
    validation = _frames_table(run / VALIDATION_FILE) if (run / VALIDATION_FILE).is_file() else None
    return Curve(name, metrics, validation)


def _frames_table(path: Path) -> pd.DataFrame:
    table = MetricsTable.read(path)
    columns = {name: [float(row[name] or math.nan) for row in table.rows] for name in table.columns or ["frames"]}
    return pd.DataFrame(columns).astype({"frames": int})


def _with_tradeoffs(material: Material, folder: Path) -> Material:
    path = folder / TRADEOFFS_FILE
    if not path.is_file():
        return material
    remedy = "run izoo.benchmarks.tradeoffs again"
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}; {remedy}.") from error
    missing = [name for name in TRADEOFF_COLUMNS if name not in table]
    if missing:
        raise IzooError(f"{path} lacks the column(s) {', '.join(missing)}; {remedy}.")
    for name in (*TRADEOFF_NUMBERS, *TRADEOFF_FLAGS):
        check = pd.api.types.is_bool_dtype if name in TRADEOFF_FLAGS else pd.api.types.is_numeric_dtype
        if len(table) and not check(table[name]):
            raise IzooError(f"{path} is damaged in the column {name}; {remedy}.")
    return dataclasses.replace(material, tradeoffs=table)


def _label(folder: Path) -> str:
    """Name of an evaluation's folder; one inside a run's ``evaluations`` is named after both."""
    if folder.parent.name == EVALUATIONS:
        return f"{folder.parent.parent.name}: {folder.name}"
    return folder.name
