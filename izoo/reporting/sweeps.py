"""A sweep as a table and a picture: what its runs differ in, and how well each choice did over its seeds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from izoo.conf.mapping import to_mapping
from izoo.errors import IzooError
from izoo.evaluation.folder import flat
from izoo.evaluation.table import CSV_FILE, JOURNAL_FILE, MANIFEST_FILE, SUMMARY_FILE, write_csv
from izoo.files import check_folder
from izoo.metrics import statistics
from izoo.reporting.material import TRADEOFFS_FILE
from izoo.reporting.results import RESULTS_FILE
from izoo.training import plots, runs
from izoo.training.records import MetricsTable
from izoo.training.validation import VALIDATION_FILE

SWEEP_FILE, RUNS_FILE, CURVES_FILE = "sweep.csv", "sweep_runs.csv", "sweep.png"
NOT_OPTIONS = ("seed", "run_dir", "resume")
"""Options in which repetitions of the same choice differ."""
MEASURES = {
    "benefit_best": ("best validation", "{:.1%}"),
    "benefit_last": ("last validation", "{:.1%}"),
    "benefit_evaluation": ("evaluation", "{:.1%}"),
    "return": ("return", "{:.1f}"),
}
"""Columns of a run that are averaged over seeds: heading, and how a value is shown. Benefits are means over approaches
with the exact gate; the return is the mean of the last :data:`LAST_ROWS` batches that report one."""
LAST_ROWS = 5
FEW_OPTIONS = 3
"""So many options are named in the picture, and shown on any terminal; ``sweep.csv`` has all."""
CHARACTERS_PER_OPTION = 25
"""A terminal shows one option for so many characters of its width; the other columns need the rest."""
Row = dict[str, Any]


def is_sweep(folder: Path) -> bool:
    """Whether a folder holds training runs, and is neither one itself nor of a benchmark or an evaluation."""
    own = (runs.CONFIG_FILE, RESULTS_FILE, TRADEOFFS_FILE, CSV_FILE, MANIFEST_FILE, JOURNAL_FILE)
    return not any((folder / name).exists() for name in own) and next(folder.rglob(runs.CONFIG_FILE), None) is not None


def find_runs(folder: Path) -> list[Path]:
    """Return the run folders below ``folder``, in the order of their names.

    Raises:
        IzooError: there is none.
    """
    check_folder(folder, "give the folder of a sweep (izoo.train -m ...)")
    found = sorted((path.parent for path in folder.rglob(runs.CONFIG_FILE)), key=_natural)
    if not found:
        raise IzooError(f"{folder} holds no training runs; give the folder of a sweep (izoo.train -m ...).")
    return found


def read_run(run_dir: Path) -> Row:
    """Return what a run has achieved, with its options under their paths.

    ``state`` is ``finished``, ``unfinished`` (killed, stopped, or still running) or a reason why it cannot be read.
    """
    row: Row = {"run": run_dir.name, "state": "unfinished", "frames": 0, "seconds": 0.0}
    try:
        config = runs.read_config(run_dir)
    except IzooError as error:
        return {**row, "state": str(error)}
    row |= {f"option {path}": value for path, value in flat(to_mapping(config)).items()}
    table = MetricsTable.read(run_dir / runs.METRICS_FILE)
    if table.rows:
        row["frames"], row["seconds"] = int(table.rows[-1]["frames"]), float(table.rows[-1]["seconds"])
        returns = table.series("return")[1]
        row["return"] = float(np.mean(returns[-LAST_ROWS:])) if returns else None
    validated = MetricsTable.read(run_dir / VALIDATION_FILE).series("benefit")[1]
    if validated:
        row |= {"benefit_best": max(validated), "benefit_last": validated[-1]}
    row["benefit_evaluation"] = _evaluated(run_dir / SUMMARY_FILE)
    if row["frames"] >= config.total_frames:
        row["state"] = "finished"
    return row


def varied(rows: Sequence[Row]) -> list[str]:
    """Return the options in which runs differ, but for their seeds.

    The options of a group, such as an algorithm's, are compared among the runs that made the same choice of it.
    """
    keys = list(dict.fromkeys(key for row in rows for key in row if key.startswith("option ")))
    found = []
    for key in keys:
        path = key.removeprefix("option ")
        if path in NOT_OPTIONS:
            continue
        name = f"option {path.split('.')[0]}.name"
        values: dict[Any, set[str]] = {}
        for row in rows:
            if key in row:
                choice = None if key == name else row.get(name)
                values.setdefault(choice, set()).add(repr(row[key]))
        if any(len(distinct) > 1 for distinct in values.values()):
            found.append(path)
    return found


def aggregate(rows: Sequence[Row]) -> tuple[pd.DataFrame, list[str]]:
    """Return a table with a row per choice, and the options that make a choice.

    Columns: the varied options, ``runs``, ``finished``, per measure of :data:`MEASURES` its mean and
    interquartile mean over the runs that have it, frames in all, and hours per run.
    """
    options = varied(rows) or ["algo.name"]
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(_choice(row, options), []).append(row)
    lines = []
    for choice, members in groups.items():
        line: Row = dict(zip(options, choice, strict=True))
        line["runs"] = len(members)
        line["finished"] = sum(row["state"] == "finished" for row in members)
        for measure in MEASURES:
            known = np.array([row[measure] for row in members if row.get(measure) is not None], float)
            line[f"{measure}_mean"] = float(statistics.mean(known)) if len(known) else None
            line[f"{measure}_iqm"] = float(statistics.iqm(known)) if len(known) else None
        line["frames"] = sum(row["frames"] for row in members)
        line["hours_per_run"] = float(np.mean([row["seconds"] for row in members])) / 3600.0
        lines.append(line)
    return pd.DataFrame(lines), options


def _choice(row: Row, options: Sequence[str]) -> tuple[str, ...]:
    return tuple(_word(row.get(f"option {path}")) for path in options)


def report(folder: Path, console: Console | None = None) -> Path:
    """Print the table of the sweep in ``folder``; write it and the learning curves there; return the choices' file.

    Raises:
        IzooError: there are no runs, or the tables cannot be written.
    """
    found = find_runs(folder)
    rows = [read_run(run_dir) for run_dir in found]
    table, options = aggregate(rows)
    console = console or Console()
    shown = options[: max(FEW_OPTIONS, console.width // CHARACTERS_PER_OPTION)]
    console.print(_printed(table, shown, numbered=len(options) > FEW_OPTIONS))
    if len(shown) < len(options):
        more = (
            f"  {len(options)} options differ, of which {len(shown)} are shown; {SWEEP_FILE} has all, in the same rows."
        )
        console.print(more, highlight=False)
    for row in rows:
        if row["state"] != "finished":
            console.print(f"  {row['run']}: {row['state']}, {row['frames']:,} frames", highlight=False)
    path = folder / SWEEP_FILE
    try:
        write_csv(pd.DataFrame(rows), folder / RUNS_FILE)
        write_csv(table, path)
        choices = list(dict.fromkeys(_choice(row, options) for row in rows))
        curves: dict[str, list[MetricsTable]] = {}
        for run_dir, row in zip(found, rows, strict=True):
            metrics = MetricsTable.read(run_dir / runs.METRICS_FILE)
            if metrics.rows:
                choice = _choice(row, options)
                curves.setdefault(_legend_entry(choice, choices.index(choice) + 1), []).append(metrics)
        if curves:
            rest = f" and {len(options) - FEW_OPTIONS} more" if len(options) > FEW_OPTIONS else ""
            plots.compare_curves(curves, folder / CURVES_FILE, ", ".join(options[:FEW_OPTIONS]) + rest)
    except OSError as error:
        raise IzooError(f"cannot write {path}: {error.strerror}.") from error
    return path


def _legend_entry(choice: Sequence[str], number: int) -> str:
    """Return what a choice is called: its options, or its row in the table and the first of them."""
    row = f"row {number}: " if len(choice) > FEW_OPTIONS else ""
    return row + ", ".join(choice[:FEW_OPTIONS])


def _printed(table: pd.DataFrame, options: Sequence[str], numbered: bool) -> Table:
    """Return the table for a terminal; rows are ``numbered`` where the options shown may not tell them apart."""
    shown = [measure for measure in MEASURES if table[f"{measure}_mean"].notna().any()]
    printed = Table(title="Means over runs (interquartile means in brackets)", title_justify="left", padding=0)
    if numbered:
        printed.add_column("row", justify="right")
    for heading in (*options, "finished", *(MEASURES[measure][0] for measure in shown), "frames", "h per run"):
        printed.add_column(heading, justify="left" if heading in options else "right", overflow="fold")
    for number, line in enumerate(table.to_dict("records"), 1):
        cells = [str(number)] if numbered else []
        cells += [str(line[path]) for path in options] + [f"{line['finished']}/{line['runs']}"]
        for measure in shown:
            form = MEASURES[measure][1]
            mean, iqm = line[f"{measure}_mean"], line[f"{measure}_iqm"]
            cells.append("-" if pd.isna(mean) else f"{form.format(mean)} ({form.format(iqm)})")
        printed.add_row(*cells, f"{line['frames']:,}", f"{line['hours_per_run']:.2f}")
    return printed


def _evaluated(path: Path) -> float | None:
    """Return the mean benefit of the run's policy over its headline baseline, from the evaluation that ended it."""
    try:
        policies = json.loads(path.read_text())["policies"]
        learned = [policies[name] for name in policies if name != "uncommanded"]
        return learned[0]["against"][learned[0]["headline"]]["all"]["exact"]["mean"]["value"]
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _word(value: Any) -> str:
    return "" if value is None else str(value)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key under which ``10-ppo`` follows ``9-ppo``."""
    words = path.as_posix().replace("-", "/").split("/")
    return [(0, int(word), "") if word.isdigit() else (1, 0, word) for word in words]
