"""What a finished benchmark says: aggregates over training seeds, curves, and a leaderboard file per entry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from izoo.benchmarks.generalization_options import is_folder
from izoo.benchmarks.plan import Plan, place_name
from izoo.envs.config import EnvConfig
from izoo.evaluation.across import aggregate, compare_entries, run_rows
from izoo.evaluation.folder import differences
from izoo.evaluation.provenance import settings
from izoo.evaluation.show import percent
from izoo.reporting.results import LEADERBOARD_FOLDER, EntryRecord, Results, evaluation_of
from izoo.reporting.submissions import make_submission, write_submission
from izoo.training.plots import compare_curves
from izoo.training.records import MetricsTable
from izoo.training.runs import METRICS_FILE

CURVES_FILE = "learning_curves.png"


def entry_rows(folder: Path, entry: EntryRecord) -> pd.DataFrame:
    """Return the rows of every finished training seed of an entry, against human driving."""
    tables = [run_rows(evaluation_of(folder, run), entry.name, run.seed) for run in entry.done]
    return pd.concat(tables, ignore_index=True)


def sum_up(folder: Path, results: Results) -> dict[str, Any]:
    """Return the ``aggregates`` of the index (:mod:`izoo.reporting.results`)."""
    rows = {entry.name: entry_rows(folder, entry) for entry in results.entries if entry.done}
    return {"entries": {name: aggregate(table) for name, table in rows.items()}, **compare_entries(rows)}


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
    """Return a line per entry: benefits over human driving on the test contexts, with intervals over intersections."""
    table = Table(title=f"{results.title}: benefit over human driving", title_justify="left")
    for column in (
        "entry",
        "seeds",
        "mean, exact gate",
        "IQM",
        "mean, tested gate",
        "ratio of sums",
        "gated",
        "best seed",
    ):
        table.add_column(column, justify="left" if column == "entry" else "right")
    for name, content in results.aggregates["entries"].items():
        block = content["all"]
        places, runs = block["over_intersections"], block["per_seed"]
        sums = [run["exact"]["ratio_of_sums"] for run in runs]
        gated = [run["exact"]["share_gated"] for run in runs]
        table.add_row(
            name,
            str(content["n"]["train_seeds"]),
            percent(places["exact"]["mean"]),
            percent(places["exact"]["iqm"]),
            percent(places["tested"]["mean"]),
            _percent(sum(sums) / max(len(sums), 1)),
            _percent(sum(gated) / max(len(gated), 1)),
            "-" if len(runs) < 2 else _percent(max(sums)),
        )
    table.caption = (
        "Ratio of sums and gated: means over training seeds. Best seed: the ratio of sums of the best one on the test "
        "set, the paper's form."
    )
    return table


def _percent(share: float) -> str:
    return f"{round(100 * share, 1) + 0.0:.1f} %"  # no "-0.0"


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
