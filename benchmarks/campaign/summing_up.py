"""What a part of a campaign found: summaries, tables, figures, leaderboard files, and what is still missing.

Everything is read from the part's folder, so a folder that an earlier campaign left can be summed up again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from izoo.benchmarks.campaign.jobs import Job, PartRun
from izoo.benchmarks.campaign.learning_curves import costs, draw_curves
from izoo.console import counted
from izoo.envs import SIMULATORS
from izoo.files import write_json
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import BASELINES, HUMAN, PLANNER, UNCOMMANDED, simulators
from izoo.metrics.paper_form import paper_form
from izoo.metrics.summary import TRAINING, Summary, summarise
from izoo.report import plots, tables
from izoo.report.leaderboard import write_entries
from izoo.report.paper_results import paper_table, published_for
from izoo.report.tables import SAVED, Table
from izoo.results.schema import EPISODE
from izoo.results.store import MANIFEST_FILE, read_manifest, read_table
from izoo.training.plots import draw, save

SUMMARY_FILE, CURVES_FILE, PICTURE_FILE = "summary.json", "curves.png", "saved.png"
COSTS = ("co2_g", "delay_s")
"""Figures that are traded; lower is better."""


def sum_up(run: PartRun, lacking: Sequence[Job] | None, learning: pd.DataFrame) -> list[Summary]:
    """Write the summaries, figures and leaderboard files of a part's folder; return the summaries, by task.

    Args:
        run: the part.
        lacking: what is missing of it. Entries that lack nothing where they are shown have leaderboard files; if
            ``None``, it is not known, and none is written.
        learning: what its training runs cost and saved (:mod:`izoo.benchmarks.campaign.learning_curves`).
    """
    folder = run.folder
    if not (folder / MANIFEST_FILE).exists():
        return []
    table, task = read_table(folder), read_manifest(folder).task
    shown_on = simulators(table)[:1]
    table = table[table["simulator"].isin(shown_on) & (table["policy"] != PLANNER)]
    names = sorted({name for name in table["task"] if not name.endswith(TRAINING)}, key=lambda name: name != task)
    found = []
    for name in names:
        rows, seen = (table[table["task"] == each] for each in (name, name + TRAINING))
        if set(BASELINES) <= set(rows["policy"]):
            found.append(summarise(_paired(rows), run.part.reference, _paired(seen)))
    write_json(folder / SUMMARY_FILE, found)
    if found:
        shown = tables.entries(found[0])
        charts = [dataclasses.replace(plots.forest(shown, column=column), title="") for column in range(2)]
        if charts[0].rows == charts[1].rows:  # named once
            charts[1] = dataclasses.replace(charts[1], rows=[""] * len(charts[1].rows))
        traded = plots.tradeoff(found[0]) if run.part.tradeoff else None
        save(
            draw([*charts, *([traded] if traded else [])], shown.title.removesuffix(" but for one column")),
            folder / PICTURE_FILE,
        )
    if found and lacking is not None:
        unfinished = {job.entry for job in lacking if job.simulator in shown_on or run.has_begun(job)}
        if unfinished.isdisjoint(BASELINES):
            write_entries(folder, but=unfinished)
    curves = draw_curves(learning, run.part.grid)
    if curves:
        save(draw(curves, columns=2), folder / CURVES_FILE)
    return found


def _paired(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of episodes that every baseline has been played in: those of a campaign that still goes on."""
    played = [set(table.loc[table["policy"] == name, "context_hash"]) for name in BASELINES]
    return table[table["context_hash"].isin(set.intersection(*played))]


def as_tables(run: PartRun, summary: Summary, learning: pd.DataFrame) -> list[Table]:
    """Return what is to be printed of a part: the headline, and everything that stands beside it."""
    table = read_table(run.folder)
    table = table[table["task"] == summary["task"]]
    shown = [tables.headline(summary)]
    shown += [tables.gaps(summary)] if summary["gaps"] else []
    shown += [tables.pairwise(summary)] if summary["pairwise"] else []
    return [
        each
        for each in (*shown, beside_paper(table, summary), headroom(table), agreement(table), costs(learning))
        if each is not None and each.rows
    ]


def beside_paper(table: pd.DataFrame, summary: Summary) -> Table | None:
    """Return the entries in the paper's measure, beside what it published for the task; ``None``: nothing."""
    task = summary["task"]
    if not published_for(task):
        return None
    rows = table[table["simulator"] == summary["simulators"][0]]
    found = paper_table({name: paper_form(rows, name)[1] for name in summary["entries"] if name != HUMAN}, task)
    return dataclasses.replace(found, title="In the paper's measure, over human driving")


def agreement(table: pd.DataFrame) -> Table | None:
    """Return what entries save in SUMO and on the twin, in the episodes that both have played; ``None``: not both."""
    keys = [name for name in EPISODE if name != "simulator"]
    sides = {name: pd.MultiIndex.from_frame(part[keys]) for name, part in table.groupby("simulator")}
    if len(sides) < 2:
        return None
    alike = pd.MultiIndex.from_frame(table[keys])
    both = table[np.logical_and.reduce([alike.isin(own) for own in sides.values()])]
    if UNCOMMANDED not in set(both["policy"]):
        return None
    found = [summarise(both[both["simulator"] == name]) for name in sides]
    block = found[0]["block"]
    rows = [
        (name, *(tables.figure_cell(each["entries"][name], SAVED, UNCOMMANDED, block) for each in found))
        for name in tables.ranking(found[0])
        if name not in BASELINES
    ]
    title = f"{FIGURES[SAVED].label} over {UNCOMMANDED} in the same episodes, {block} intersections"
    return Table.of(title, ("entry", *(SIMULATORS[name].label for name in sides)), rows)


def headroom(table: pd.DataFrame) -> Table | None:
    """Return what entries save in the planner's episodes, and their share of what it saves; ``None``: it has none."""
    keys = ["simulator", "context_hash", "seed"]
    own = pd.MultiIndex.from_frame(table.loc[table["policy"] == PLANNER, keys])
    if not len(own):
        return None
    summary = summarise(table[pd.MultiIndex.from_frame(table[keys]).isin(own)])
    cells = {
        name: tables.figure_cell(summary["entries"][name], SAVED, UNCOMMANDED, summary["block"])
        for name in tables.ranking(summary)
        if name not in BASELINES
    }
    most = cells[PLANNER].value or 0.0
    rows = [
        (name, cell, "-" if cell.value is None or most <= 0.0 else f"{100.0 * cell.value / most:.0f} %")
        for name, cell in cells.items()
    ]
    title = f"Headroom: {counted(summary['n']['contexts'], 'context')} that the planner played"
    return Table.of(title, ("entry", FIGURES[SAVED].label, "share of the planner's"), rows)


def verdict(run: PartRun, summary: Summary) -> str:
    """Return the verdict of a part in one sentence."""
    said = str(summary["verdict"])
    if run.part.reference is not None:
        apart = [p for p in summary["pairwise"] if p["verdict"] != "indistinguishable" and p["x"] not in BASELINES]
        words = ", ".join(f"{p['x']} ({p['difference']['value']:+.1f} points)" for p in apart)
        said = (
            f"{len(apart)} of {counted(len(summary['pairwise']), 'difference')} from {run.part.reference} can be told "
        )
        said += f"from 0{': ' if words else ''}{words}."
    if run.part.tradeoff:
        said = f"{said[:-1]}; on the Pareto front of CO2 and delay: {', '.join(on_front(summary)) or 'none'}."
    return said


def on_front(summary: Mapping[str, Any]) -> list[str]:
    """Return the entries that no other one dominates: has no more CO2 and delay per vehicle, and less of one."""
    levels = {name: entry["levels"].get(summary["block"], {}) for name, entry in summary["entries"].items()}
    costs = {name: [of[key] for key in COSTS] for name, of in levels.items() if None not in map(of.get, COSTS)}

    def dominated(mine: list[float]) -> bool:
        return any(other != mine and all(o <= m for o, m in zip(other, mine, strict=True)) for other in costs.values())

    return [name for name, mine in costs.items() if not dominated(mine)]


def missing_words(lacking: Sequence[Job] | None) -> str:
    """Say which jobs are missing: the first ones, and how many."""
    if lacking is None:
        return "Give dataset=FOLDER to see what is missing, and to write leaderboard files."
    if not lacking:
        return ""
    more = ", ..." if len(lacking) > 3 else ""
    return f"Still missing: {counted(len(lacking), 'job')} ({'; '.join(map(str, lacking[:3]))}{more})."
