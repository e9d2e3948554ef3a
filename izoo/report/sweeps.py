"""A sweep as a table and a picture: what its runs differ in, and how well each choice did over its seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from izoo.errors import IzooError
from izoo.files import check_folder, write_text
from izoo.metrics.cell import Cell
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import UNCOMMANDED
from izoo.metrics.summary import summarise
from izoo.networks.dataset.intersections import natural_key
from izoo.options import to_mapping
from izoo.report.tables import SAVED, Table, compared
from izoo.results.store import MANIFEST_FILE, ROWS_FILE, flat, read_table
from izoo.training import plots, run_folder
from izoo.training.loggers import MetricsTable
from izoo.training.validation import VALIDATION_FILE

SWEEP_FILE, RUNS_FILE, CURVES_FILE = "sweep.csv", "sweep_runs.csv", "sweep.png"
NOT_OPTIONS = ("seed", "run_dir", "resume")
"""Options in which repetitions of the same choice differ."""
MEASURE = FIGURES[SAVED]
MEASURES = {
    "best": ("best validation", MEASURE.unit),
    "last": ("last validation", MEASURE.unit),
    "evaluation": ("evaluation", MEASURE.unit),
    "return": ("return", ""),
}
"""Columns of a run that are averaged over seeds: heading and unit. The first three are CO2 saved over uncommanded; the
return is the mean of the last :data:`LAST_ROWS` batches that report one."""
LAST_ROWS = 5
OPTION = "option "


def is_sweep(folder: Path) -> bool:
    """Whether a folder holds training runs, and is neither one itself nor of a benchmark or an evaluation."""
    own = (run_folder.CONFIG_FILE, ROWS_FILE, MANIFEST_FILE)
    return (
        not any((folder / name).exists() for name in own)
        and next(folder.rglob(run_folder.CONFIG_FILE), None) is not None
    )


def read_run(run_dir: Path, imports: bool = False) -> dict[str, Any]:
    """Return what a run has achieved, with its options, each a text, under ``option PATH``.

    ``state`` is ``finished``, ``unfinished`` (killed, stopped, or still running) or a reason why it cannot be read.
    """
    row: dict[str, Any] = {"run": run_dir.name, "state": "unfinished", "frames": 0, "seconds": 0.0}
    row |= dict.fromkeys(MEASURES)
    try:
        config = run_folder.read_config(run_dir, imports)
    except IzooError as error:
        return {**row, "state": str(error)}
    row |= {OPTION + path: "" if value is None else str(value) for path, value in flat(to_mapping(config)).items()}
    table = MetricsTable.read(run_dir / run_folder.METRICS_FILE)
    (frames, seconds), (_, returns) = table.series("seconds"), table.series("return")
    row |= {"frames": max(frames, default=0), "seconds": max(seconds, default=0.0), "evaluation": _evaluated(run_dir)}
    row["return"] = float(np.mean(returns[-LAST_ROWS:])) if returns else None
    validated = MetricsTable.read(run_dir / VALIDATION_FILE).series(SAVED)[1]
    if validated:
        row |= {"best": max(validated), "last": validated[-1]}
    return row | ({"state": "finished"} if row["frames"] >= config.total_frames else {})


def varied(table: pd.DataFrame) -> list[str]:
    """Return the options in which runs differ, but for their seeds.

    The options of a group, such as an algorithm's, are compared among the runs that made the same choice of it.
    """
    found = []
    for column in table.columns[table.columns.str.startswith(OPTION)]:
        path = column.removeprefix(OPTION)
        name = f"{OPTION}{path.split('.')[0]}.name"
        alike = table[name].fillna("") if name in table and name != column else pd.Series("", table.index)
        if path not in NOT_OPTIONS and table[column].groupby(alike).nunique().gt(1).any():
            found.append(path)
    return found or ["algo.name"]


def report(folder: Path, imports: bool = False) -> Path:
    """Print the table of the sweep in ``folder``; write it and the learning curves there; return the choices' file.

    The table has a row per choice: the varied options, ``runs``, ``finished``, the mean of each of :data:`MEASURES`
    over the runs that have it, frames in all, and hours per run. ``imports`` allows to import algorithms that are
    written ``module:Class``.

    Raises:
        IzooError: there are no runs.
    """
    check_folder(folder, "give the folder of a sweep (izoo.train -m ...)")
    runs = (path.parent for path in folder.rglob(run_folder.CONFIG_FILE))
    found = sorted(runs, key=lambda path: natural_key(path.as_posix()))
    table = pd.DataFrame([read_run(run_dir, imports) for run_dir in found])
    table[list(MEASURES)] = table[list(MEASURES)].astype(float)
    options = varied(table)
    chosen = table.reindex(columns=[OPTION + path for path in options]).fillna("").set_axis(options, axis=1)
    grouped = table.groupby([chosen[path] for path in options], sort=False)
    choices = grouped[list(MEASURES)].mean()
    choices.insert(0, "runs", grouped.size())
    choices.insert(1, "finished", grouped["state"].agg(lambda state: (state == "finished").sum()))
    choices["frames"], choices["hours_per_run"] = grouped["frames"].sum(), grouped["seconds"].mean() / 3600.0
    choices = choices.reset_index()
    values = choices[options].itertuples(index=False)
    names = [
        f"{k}: {', '.join(f'{o}={v}' for o, v in zip(options, of, strict=True))}" for k, of in enumerate(values, 1)
    ]
    console = Console()
    _shown(choices, names).show(console)
    for run in table[table["state"] != "finished"].itertuples():
        console.print(f"  {run.run}: {run.state}, {run.frames:,} frames", highlight=False, markup=False)
    write_text(folder / RUNS_FILE, table.to_csv(index=False))
    write_text(folder / SWEEP_FILE, choices.to_csv(index=False))
    curves: dict[str, list[MetricsTable]] = {}
    for run_dir, number in zip(found, grouped.ngroup(), strict=True):
        metrics = MetricsTable.read(run_dir / run_folder.METRICS_FILE)
        if metrics.rows:
            curves.setdefault(names[number], []).append(metrics)
    if curves:
        plots.compare_curves(curves, folder / CURVES_FILE, f"Rows of {SWEEP_FILE}")
    return folder / SWEEP_FILE


def _shown(choices: pd.DataFrame, names: Sequence[str]) -> Table:
    measures = [name for name in MEASURES if choices[name].notna().any()]
    rows = []
    for name, line in zip(names, choices.astype(object).where(choices.notna(), None).to_dict("records"), strict=True):
        cells = [Cell(line[key], unit=MEASURES[key][1], signed=key != "return") for key in measures]
        rows.append((name, f"{line['finished']}/{line['runs']}", *cells, f"{line['hours_per_run']:.2f}"))
    headings = ("choice", "done", *(MEASURES[name][0] for name in measures), "h per run")
    return Table.of(f"Means over runs; {MEASURE.label} is over {UNCOMMANDED}", headings, rows)


def _evaluated(run_dir: Path) -> float | None:
    """Return what the evaluation that ended the run found, where there is one."""
    try:
        summary = summarise(read_table(run_dir / run_folder.EVALUATIONS / run_folder.LAST))
    except IzooError:
        return None
    found = [summary["entries"][name]["against"].get(UNCOMMANDED, {}) for name in compared(summary)]
    return next((of[summary["block"]]["figures"][MEASURE.name]["value"] for of in found if of), None)
