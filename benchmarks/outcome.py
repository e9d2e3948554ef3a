"""What a finished benchmark says: aggregates over training seeds, curves, and a leaderboard file per entry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Group
from rich.table import Table
from rich.text import Text

from izoo.benchmarks.generalization_options import is_folder
from izoo.benchmarks.plan import Plan, default_weather, place_name
from izoo.envs.config import SIMULATOR_NAMES, EnvConfig
from izoo.evaluation.across import aggregate, compare, compare_entries, run_rows
from izoo.evaluation.folder import differences
from izoo.evaluation.provenance import settings
from izoo.evaluation.show import figure_table, intervals_in_words, nan_in_words, percent, stacked
from izoo.metrics.scores import nan_share_of
from izoo.reporting.results import (
    LEADERBOARD_FOLDER,
    EntryRecord,
    Results,
    evaluation_of,
    human_vehicles_of,
    simulator_of_run,
)
from izoo.reporting.submissions import make_submission, write_submission
from izoo.training.plots import compare_curves
from izoo.training.records import MetricsTable
from izoo.training.runs import METRICS_FILE

CURVES_FILE = "learning_curves.png"
TABLES = {
    "benefit over human driving": (
        ("exact gate", "exact", "mean"),
        ("over\nuncommanded", "over_uncommanded", "mean"),
        ("whole demand", "demand_exact", "mean"),
        ("demand, over\nuncommanded", "demand_over_uncommanded", "mean"),
    ),
    "the same, otherwise summed up": (
        ("IQM", "exact", "iqm"),
        ("tested gate", "tested", "mean"),
        ("ratio of sums", "exact", "ratio_of_sums"),
        ("whole region", "region_exact", "mean"),
    ),
    "how much of the demand got through": (
        ("gated to 0", "exact", "share_gated"),
        ("demand served", "served", "policy"),
        ("kept out", "kept_out", "policy"),
    ),
}
"""Tables of the entries: per title the columns, each a label, and part and name of its figure
(:data:`izoo.evaluation.aggregates.FIGURES`)."""


def entry_rows(folder: Path, entry: EntryRecord) -> pd.DataFrame:
    """Return the rows of every finished training seed of an entry, against human driving."""
    tables = [run_rows(evaluation_of(folder, run), entry.name, run.seed) for run in entry.done]
    return pd.concat(tables, ignore_index=True)


def sum_up(folder: Path, results: Results) -> dict[str, Any]:
    """Return the ``aggregates`` of the index (:mod:`izoo.reporting.results`)."""
    done = [entry for entry in results.entries if entry.done]
    rows = {entry.name: entry_rows(folder, entry) for entry in done}
    beside = {entry.name: {"nan_share": nan_share(folder, entry), **human_vehicles(folder, entry)} for entry in done}
    entries = {name: {**aggregate(table), **beside[name]} for name, table in rows.items()}
    return {"entries": entries, **compare_entries(rows)}


def nan_share(folder: Path, entry: EntryRecord) -> float:
    """Return the share of an entry's commands that were NaN, over its training seeds: SUMO drove those vehicles."""
    tables = [evaluation_of(folder, run) for run in entry.done]
    return nan_share_of(table[table["policy"] == entry.name] for table in tables)


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


def outcome_tables(results: Results) -> Group:
    """Return a line per entry: what it saved on the test contexts, with intervals; narrow enough for a terminal."""
    entries: dict[str, Any] = results.aggregates["entries"]
    shown: list[Any] = []
    for title, columns in TABLES.items():
        table = figure_table(f"{title_of(results)}: {title}", "entry", [label for label, _, _ in columns])
        for name, content in entries.items():
            seeds = content["n"]["train_seeds"]
            figures = (content["all"].get(part, {}).get(figure) for _, part, figure in columns)
            table.add_row(f"{name}\n{seeds} seeds" if seeds > 1 else name, *map(stacked, figures))
        shown.append(table)
    shown += _beside(results, entries)
    places = [content["n"]["intersections"] for content in entries.values()]
    trained = [len(entry.done) for entry in results.entries if entry.kind == "trained"]
    words = f"{intervals_in_words(places, trained)} Over uncommanded: without gate, so that a loss shows."
    shares = {name: content.get("nan_share") for name, content in entries.items()}
    words = "\n".join([words, *(nan_in_words(name, share) for name, share in shares.items() if share)])
    return Group(*shown, Text(words))


def title_of(results: Results) -> str:
    """Return the title of a table: what was trained on and tested on, and what played the tests."""
    return f"{results.title}, on {SIMULATOR_NAMES[results.settings['simulator']]}"


def _beside(results: Results, entries: Mapping[str, Any]) -> list[Table]:
    """The paper's form of several training seeds, and what was played on human vehicles, where there is any."""
    best = any(content["n"]["train_seeds"] > 1 for content in entries.values())
    human = any("human_vehicles" in content for content in entries.values())
    columns = [*(["ratio of sums of the best\nseed on the test set:\nthe paper's form"] if best else [])]
    columns += ["exact gate, on CVs with\nthe parameters of\nhuman-driven vehicles"] if human else []
    if not columns:
        return []
    table = figure_table(f"{title_of(results)}: beside", "entry", columns)
    for name, content in entries.items():
        sums = [run["exact"]["ratio_of_sums"] for run in content["per_seed"]]
        cells = [percent({"value": max(sums), "low": None}) if len(sums) > 1 else "-"] if best else []
        vehicles = content["human_vehicles"]["all"]["exact"]["mean"] if "human_vehicles" in content else None
        table.add_row(name, *cells, *([stacked(vehicles)] if human else []))
    return [table]


OF_AN_ENTRY = ("reward", "observed", "neighbours", "hold_s", "num_agents", "num_vehicles")
"""Settings of an environment that belong to the policy, not to the task."""


def other_environment(env: EnvConfig) -> str:
    """Return in what an evaluation's environment differs from that of the protocols, or nothing.

    What an entry looks at of what there is to see, how long its decisions last, and what it was paid, are its own.
    """
    mine, theirs = (settings(config)["env"] for config in (env, EnvConfig(horizon_s=env.horizon_s)))
    own = dict.fromkeys(OF_AN_ENTRY)
    return differences({**theirs, **own}, {**mine, **own})


def _place(place: str | None) -> str | None:
    """Return a city's name, or a folder's with a slash at its end, so that no folder passes for a built-in city."""
    if place is None:
        return None
    return f"{place_name(place)}/" if is_folder(place) else place_name(place)


def write_submissions(folder: Path, results: Results, plan: Plan, envs: Mapping[str, EnvConfig]) -> list[Path]:
    """Write ``leaderboard/<entry>.json`` for every entry, evaluated in its own of ``envs``; returns the files."""
    options, written = results.settings, []
    names = ("protocol", "scale", "form", "weather", "test_set", "horizon_s")
    places = {name: _place(options[name]) for name in ("train", "test")}
    protocol = {name: options[name] for name in names}
    protocol.update(title=results.title, test_count=plan.test_count, **places)
    used = [options[name] for name in ("train", "test") if options[name] is not None]
    if all(default_weather(place) == options["weather"] for place in used):
        protocol["weather"] = None  # what null stands for
    for entry in results.entries:
        changed = other_environment(envs[entry.name])
        played_in = {"env": changed} if changed else {}
        policy = {name: getattr(entry, name) for name in ("name", "kind", "algo", "action")}
        policy["frames"] = max(run.frames for run in entry.runs)
        played = simulator_of_run(folder, entry.done[0])
        content = make_submission(
            policy,
            {**protocol, **played_in},
            results.versions,
            range(len(plan.seeds)),
            entry_rows(folder, entry),
            played,
        )
        written.append(folder / LEADERBOARD_FOLDER / f"{entry.name}.json")
        write_submission(written[-1], content)
    return written
