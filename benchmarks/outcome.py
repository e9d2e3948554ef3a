"""What a finished benchmark says: aggregates over training seeds, curves, and a leaderboard file per entry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from izoo.benchmarks.generalization_options import is_folder
from izoo.benchmarks.plan import Plan, place_name
from izoo.envs.config import EnvConfig
from izoo.evaluation.across import aggregate, compare, compare_entries, run_rows
from izoo.evaluation.folder import differences
from izoo.evaluation.provenance import settings
from izoo.evaluation.show import intervals_in_words, percent
from izoo.reporting.results import LEADERBOARD_FOLDER, EntryRecord, Results, evaluation_of, human_vehicles_of
from izoo.reporting.submissions import make_submission, write_submission
from izoo.training.plots import compare_curves
from izoo.training.records import MetricsTable
from izoo.training.runs import METRICS_FILE

CURVES_FILE = "learning_curves.png"
COLUMNS = (
    ("mean, exact gate", "exact", "mean"),
    ("IQM", "exact", "iqm"),
    ("over uncommanded", "over_uncommanded", "mean"),
    ("whole region", "region_exact", "mean"),
    ("region, over uncommanded", "region_over_uncommanded", "mean"),
    ("mean, tested gate", "tested", "mean"),
    ("ratio of sums", "exact", "ratio_of_sums"),
    ("gated", "exact", "share_gated"),
    ("demand served", "served", "policy"),
)
"""Columns of the table of entries: label, part and name of :data:`izoo.evaluation.aggregates.FIGURES`."""
NOTHING: dict[str, Any] = {"value": None}


def entry_rows(folder: Path, entry: EntryRecord) -> pd.DataFrame:
    """Return the rows of every finished training seed of an entry, against human driving."""
    tables = [run_rows(evaluation_of(folder, run), entry.name, run.seed) for run in entry.done]
    return pd.concat(tables, ignore_index=True)


def sum_up(folder: Path, results: Results) -> dict[str, Any]:
    """Return the ``aggregates`` of the index (:mod:`izoo.reporting.results`)."""
    done = [entry for entry in results.entries if entry.done]
    rows = {entry.name: entry_rows(folder, entry) for entry in done}
    beside = {entry.name: human_vehicles(folder, entry) for entry in done}
    entries = {name: {**aggregate(table), **beside[name]} for name, table in rows.items()}
    return {"entries": entries, **compare_entries(rows)}


def human_vehicles(folder: Path, entry: EntryRecord) -> dict[str, Any]:
    """Return what an entry did on CVs with the parameters of human-driven vehicles; empty where nobody asked."""
    tables = [(run.seed, human_vehicles_of(folder, run)) for run in entry.done]
    parts = [run_rows(table, entry.name, seed) for seed, table in tables if table is not None]
    return {"human_vehicles": compare(pd.concat(parts, ignore_index=True))} if len(parts) == len(tables) else {}


def draw_curves(folder: Path, results: Results) -> None:
    """Write the learning curves of all training runs as a picture, :data:`CURVES_FILE`; without any, nothing."""
    curves = {
        entry.name: [MetricsTable.read(folder / run.run / METRICS_FILE) for run in entry.runs if run.run]
        for entry in results.entries
        if entry.kind == "trained"
    }
    if curves:
        compare_curves(curves, folder / CURVES_FILE, f"{results.title}: training")


def outcome_table(results: Results) -> Table:
    """Return a line per entry: what it saved on the test contexts, with intervals."""
    table = Table(title=f"{results.title}: benefit over human driving", title_justify="left")
    entries = results.aggregates["entries"]
    beside = any("human_vehicles" in content for content in entries.values())
    labels = [*(label for label, _, _ in COLUMNS), *(["human vehicles"] if beside else []), "best seed"]
    for column in ("entry", "seeds", *labels):
        table.add_column(column, justify="left" if column == "entry" else "right")
    for name, content in entries.items():
        sums = [run["exact"]["ratio_of_sums"] for run in content["per_seed"]]
        table.add_row(
            name,
            str(content["n"]["train_seeds"]),
            *(percent(content["all"].get(part, {}).get(figure, NOTHING)) for _, part, figure in COLUMNS),
            *([_beside(content)] if beside else []),
            "-" if len(sums) < 2 else f"{100.0 * max(sums) + 0.0:.1f} %",
        )
    places = [content["n"]["intersections"] for content in entries.values()]
    trained = [len(entry.done) for entry in results.entries if entry.kind == "trained"]
    table.caption = (
        f"{intervals_in_words(places, trained)} Over uncommanded: benefit over CVs that nobody commands, without gate. "
        "Best seed: the ratio of sums of the best one on the test set, the paper's form."
        + (" Human vehicles: mean, exact gate, on CVs with the parameters of human-driven ones." if beside else "")
    )
    return table


def _beside(content: dict[str, Any]) -> str:
    """The headline on CVs that nobody could tell from human-driven ones but by their commands."""
    return percent(content["human_vehicles"]["all"]["exact"]["mean"]) if "human_vehicles" in content else "-"


def other_environment(env: EnvConfig) -> str:
    """Return in what an evaluation's environment differs from that of the protocols, or nothing."""
    mine, theirs = (settings(config)["env"] for config in (env, EnvConfig(horizon_s=env.horizon_s)))
    return differences({**theirs, "reward": None}, {**mine, "reward": None})


def _place(place: str | None) -> str | None:
    """Return a city's name, or a folder's with a slash at its end, so that no folder passes for a built-in city."""
    if place is None:
        return None
    return f"{place_name(place)}/" if is_folder(place) else place_name(place)


def write_submissions(folder: Path, results: Results, plan: Plan, env: EnvConfig) -> list[Path]:
    """Write ``leaderboard/<entry>.json`` for every entry, evaluated in ``env``; returns the files."""
    options, written = results.settings, []
    names = ("protocol", "scale", "form", "weather", "test_set", "horizon_s")
    places = {name: _place(options[name]) for name in ("train", "test")}
    protocol = {name: options[name] for name in names}
    protocol.update(title=results.title, test_count=plan.test_count, **places)
    if changed := other_environment(env):
        protocol["env"] = changed
    for entry in results.entries:
        policy = {name: getattr(entry, name) for name in ("name", "kind", "algo", "action")}
        policy["frames"] = max(run.frames for run in entry.runs)
        content = make_submission(policy, protocol, results.versions, plan.seeds, entry_rows(folder, entry))
        written.append(folder / LEADERBOARD_FOLDER / f"{entry.name}.json")
        write_submission(written[-1], content)
    return written
