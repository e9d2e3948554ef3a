"""Leaderboard files: one JSON file per entry, with the rows from which everything that is said of it is computed.

A file follows ``leaderboard_schema.json`` beside this module. It holds the rows of the entry and of its baselines,
column by column (:func:`packed`). Only playing the episodes again can show that the rows were really measured.

A **leaderboard** (:func:`merge`) groups files by task, simulator and model version, and ranks them by CO2 saved over
uncommanded. Entries with a fault (missing episodes, a file that was changed) are listed without rank.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jsonschema import Draft202012Validator

from izoo.console import counted
from izoo.envs import MODEL_VERSION, SIMULATORS
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, MOVEMENT_METRICS
from izoo.errors import IzooError
from izoo.files import read_text, write_text
from izoo.metrics.pairing import BASELINES, PAIR, PLANNER, simulators
from izoo.metrics.statistics import MIN_TRAIN_SEEDS
from izoo.metrics.summary import summarise
from izoo.report import plots, tables
from izoo.report.tables import Table
from izoo.results.schema import COLUMNS, FEATURES, IDENTITY, KEY, WHOLE
from izoo.results.store import PolicyRecord, read_manifest, read_table
from izoo.training.plots import draw as draw_charts
from izoo.training.plots import save

FORMAT, MERGED_FORMAT = "izoo-leaderboard-3", "izoo-leaderboard-merged-3"
SCHEMA_FILE = "leaderboard_schema.json"
FOLDER = "leaderboard"
KEPT = (*IDENTITY, *FEATURES, *(name for name in APPROACH_METRICS if name not in MOVEMENT_METRICS))
NEEDED = tuple(name for name in KEPT if name not in FEATURES)
"""Columns without which nothing can be said."""
DIGITS = 7
LARGEST = 1e15
"""No number of a row is larger, so that its powers are finite."""
WHOLES = (("entered", ("crossed", "unfinished")), ("due", ("dropped", "waiting", "outside", "early", "entered")))
"""Counts of a row that others add up to."""
LIMITS = (
    *(("crossed_hdv", "crossed"), ("min_ttc_vehicles", "crossed"), ("cohort_left", "cohort")),
    *(("emission_hdv_g", "emission_g"), ("emission_g", "region_emission_g"), ("travel_time_s", "region_time_s")),
    *(("stopped_time_s", "travel_time_s"), ("deferred_steps", "agent_steps"), ("nan_actions", "deferred_steps")),
)
"""Sums of a row that are a part of another one."""


@functools.cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a file."""
    return json.loads((resources.files("izoo.report") / SCHEMA_FILE).read_text())


def write_entries(folder: Path, but: Collection[str] = ()) -> list[Path]:
    """Write the file of every entry of a results folder into ``leaderboard`` there; return their paths.

    Args:
        folder: of the results.
        but: entries that get none; an earlier one's is deleted.
    """
    table, manifest, written = read_table(folder), read_manifest(folder), []
    out = folder / FOLDER
    out.mkdir(parents=True, exist_ok=True)
    table = table[(table["simulator"] == simulators(table)[0]) & (table["policy"] != PLANNER)]
    table = table[table["task"] == manifest.task]
    for name in but:
        (out / _file_name(name)).unlink(missing_ok=True)
    for name in sorted(set(table["policy"]) - {*BASELINES, *but}):
        records = manifest.policies.get(name, {0: PolicyRecord()})
        first = next(iter(records.values()))
        about = {"name": name, "kind": first.kind, "algo": first.algo, "frames": first.frames}
        about["weights"] = [record.weights for record in records.values() if record.weights]
        rows = table[table["policy"].isin({name, *BASELINES})]
        content = make_entry(about, manifest.task, manifest.model_version, manifest.versions, rows)
        written.append(out / _file_name(name))
        write_entry(written[-1], content)
    return written


def _file_name(policy: str) -> str:
    return f"{policy.replace('/', '_')}.json"


def make_entry(
    policy: Mapping[str, Any], task: str, model_version: int, versions: Mapping[str, str], rows: pd.DataFrame
) -> dict[str, Any]:
    """Return the content of a file.

    Args:
        policy: its record in the manifest, and its ``name``.
        task, model_version, versions: as in the manifest.
        rows: of the policy, human driving and uncommanded.
    """
    content = {"format": FORMAT, "policy": dict(policy), "task": task, "model_version": int(model_version)}
    content |= {"versions": dict(versions), "rows": packed(rows[[name for name in KEPT if name in rows]])}
    return {**content, "hash": content_hash(content)}


def packed(table: pd.DataFrame) -> dict[str, Any]:
    """Return a table by column: its values, or where few differ ``values`` and the ``index`` of each row's."""
    found: dict[str, Any] = {}
    for name, column in table.items():
        values = [_rounded(value) for value in column]
        distinct = list(dict.fromkeys(values))
        if 3 * len(distinct) < len(values) or any(isinstance(value, str) for value in distinct):
            place = {value: k for k, value in enumerate(distinct)}
            found[str(name)] = {"values": distinct, "index": [place[value] for value in values]}
        else:
            found[str(name)] = values
    return found


def unpacked(rows: Mapping[str, Any]) -> pd.DataFrame:
    """Return the table that :func:`packed` was given, its numbers to :data:`DIGITS` digits.

    Raises:
        IzooError: columns differ in length, an index leads nowhere, a number is not finite, or columns are missing.
    """
    found = {}
    for name, column in rows.items():
        if isinstance(column, Mapping):
            if max(column["index"], default=0) >= max(len(column["values"]), 1):
                raise IzooError(f"rows/{name}: an index is beyond the values.")
            found[name] = [column["values"][k] for k in column["index"]]
        else:
            found[name] = column
    if len({len(column) for column in found.values()}) > 1:
        raise IzooError("rows: columns have different lengths.")
    table = pd.DataFrame(found)
    missing = [name for name in NEEDED if name not in table]
    if missing:
        raise IzooError(f"rows: the column(s) {', '.join(missing)} are missing.")
    texts = [name for name in IDENTITY if any(isinstance(value, str) for value in table[name])]
    for name in table.columns.difference(texts):
        try:
            numbers = table[name].astype(float)
        except (TypeError, ValueError) as error:
            raise IzooError(f"rows/{name}: {error}.") from error
        if name not in WHOLE and (numbers.abs() > LARGEST).any():
            raise IzooError(f"rows/{name}: a number is beyond {LARGEST:g}.")
        table[name] = table[name].astype("Int64") if name in WHOLE else numbers
    if table[list(KEY)].isna().any(axis=None):
        raise IzooError(f"rows: {', '.join(KEY)} must be there in every row.")
    if unknown := sorted({*table["simulator"]} - {*SIMULATORS}, key=str):
        raise IzooError(f"rows/simulator: {unknown[0]!r} is none of {', '.join(SIMULATORS)}.")
    if table.duplicated(list(KEY)).any():
        raise IzooError("rows: an episode's approach is there twice.")
    return table.reindex(columns=[name for name in COLUMNS if name in table or not name.startswith("episode_")])


def content_hash(content: Mapping[str, Any]) -> str:
    """SHA-256 of a file without its hash: keys sorted, no spaces, numbers as Python's ``repr`` writes them."""
    kept = {key: value for key, value in content.items() if key != "hash"}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def write_entry(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file, whole or not at all: a line per column."""
    heads = [f"{json.dumps(key)}:{json.dumps(value)}" for key, value in content.items() if key != "rows"]
    rows = [
        f"{json.dumps(k)}:{json.dumps(v, separators=(',', ':'), allow_nan=False)}" for k, v in content["rows"].items()
    ]
    write_text(path, "{" + ",\n".join([*heads, '"rows":{\n' + ",\n".join(rows) + "}"]) + "}\n")


@dataclass(frozen=True)
class Entry:
    """A file that was read, and what is to be said of it.

    Attributes:
        source: the file's name.
        content: of the file, without its rows.
        table: its rows.
        faults: why it gets no rank; empty: nothing is wrong.
        notes: what to know about it, without consequence for its rank.
    """

    source: str
    content: Mapping[str, Any]
    table: pd.DataFrame = field(repr=False)
    faults: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of the policy."""
        return str(self.content["policy"]["name"])

    @property
    def simulator(self) -> str:
        """What played most of its episodes."""
        return simulators(self.table)[0]

    @property
    def marks(self) -> tuple[str, ...]:
        """Its faults, and whether it is of another model of the simulation."""
        version = self.content["model_version"]
        other = f"model version {version} of the simulation, not {MODEL_VERSION}"
        return self.faults if version == MODEL_VERSION else (other, *self.faults)


def read_entry(path: Path) -> Entry:
    """Read a file and :func:`check` it.

    Raises:
        IzooError: it cannot be read, or does not follow the schema; the first place that does not is named.
    """
    try:
        content = json.loads(read_text(path))
        json.dumps(content, allow_nan=False)  # Python's JSON reads NaN, and 1e999 as infinity
    except (OSError, ValueError, RecursionError) as error:
        raise IzooError(f"cannot read {path}: {error}; give a leaderboard file.") from error
    problems = sorted(Draft202012Validator(schema()).iter_errors(content), key=lambda error: list(map(str, error.path)))
    if problems:
        where = "/".join(str(part) for part in problems[0].absolute_path) or "the file"
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise IzooError(f"{path} is not a leaderboard file: {where}: {problems[0].message[:200]}{more}.")
    try:
        table = unpacked(content["rows"])
    except IzooError as error:
        raise IzooError(f"{path} is not a leaderboard file: {error}") from error
    return check(content, table, str(path))


def check(content: Mapping[str, Any], table: pd.DataFrame, source: str) -> Entry:
    """Return a well-formed file with its faults and notes."""
    faults, notes, policy = [], [], content["policy"]
    if content_hash(content) != content["hash"]:
        faults.append("the hash does not match: the file was changed after it was written")
    own = table[table["policy"] == policy["name"]]
    seeds = max(1, own["train_seed"].nunique())
    names = dict.fromkeys((policy["name"], *BASELINES))
    faults += [f"rows of {name} are missing" for name in names if _lacks_rows(table, name)]
    faults += [f"rows contradict themselves: {what}" for what in contradictions(table)]
    if policy["kind"] == "trained" and seeds < MIN_TRAIN_SEEDS:
        notes.append(f"{counted(seeds, 'training seed')} of {MIN_TRAIN_SEEDS}")
    return Entry(source, {k: v for k, v in content.items() if k != "rows"}, table, tuple(faults), tuple(notes))


def _lacks_rows(table: pd.DataFrame, policy: str) -> bool:
    """Whether a policy lacks an episode of the table, or one of its training seeds has fewer than another one.

    Training seeds have played the same episodes (:mod:`izoo.evaluate`), or each its own (campaigns).
    """
    own = table[table["policy"] == policy]
    times = own.groupby(list(PAIR)).size()
    if len(times) < len(table[list(PAIR)].drop_duplicates()):
        return True
    counts = own.groupby(["train_seed", "simulator", "context_hash", "approach"]).size().unstack(0, fill_value=0)
    seeds = counts.shape[1]
    return not (counts.eq(counts.iloc[:, 0], axis=0).to_numpy().all() and (times.eq(1).all() or times.eq(seeds).all()))


def contradictions(table: pd.DataFrame) -> list[str]:
    """Return what cannot be in a table of rows."""
    found = [f"{name} is not {' + '.join(parts)}" for name, parts in WHOLES if _differ(table[name], table[[*parts]])]
    found += [f"{part} is above {name}" for part, name in LIMITS if (table[part] > table[name] * (1 + 1e-5)).any()]
    if (table.groupby(["simulator", *PAIR])["cohort"].nunique() > 1).any():
        found.append("the cohort of an episode is not the same for all policies")
    return found


def _differ(whole: pd.Series, parts: pd.DataFrame) -> bool:
    return not np.allclose(whole, parts.sum(axis=1), rtol=1e-5)


def merge(found: Sequence[Entry]) -> dict[str, Any]:
    """Return the leaderboard of several files.

    Returns:
        ``format``, and ``groups``: per task, simulator and model version ``summary`` of the entries without faults
        (:func:`izoo.metrics.summary.summarise`; ``None`` where there is none), and ``entries``: ``name`` in the
        summary, ``rank`` or ``None``, ``source``, ``policy``, ``hash``, ``marks``, ``notes``, best first.
    """
    groups: dict[tuple[str, str, int], dict[str, Entry]] = {}
    for entry in found:
        key = (str(entry.content["task"]), entry.simulator, int(entry.content["model_version"]))
        named = groups.setdefault(key, {})
        same = sum(other.name == entry.name for other in named.values())
        named[f"{entry.name} {same + 1}" if same else entry.name] = entry
    merged = []
    for (task, simulator, version), named in groups.items():
        about = {"task": task, "simulator": simulator, "model_version": version}
        merged.append(about | _ranked(named))
    return {"format": MERGED_FORMAT, "groups": merged}


def board(group: Mapping[str, Any]) -> Table:
    """Return a group of :func:`merge` as a table of its ranked entries, slower ones last."""
    if group["summary"] is None:
        return Table(f"{group['task']}; {_played(group)}", tables.entry_columns(), ())
    shown = tables.entries(group["summary"])
    return dataclasses.replace(shown, title=f"{shown.title}; {_played(group)}")


def _played(group: Mapping[str, Any]) -> str:
    return f"played on {SIMULATORS[group['simulator']].label}"


def _ranked(named: Mapping[str, Entry]) -> dict[str, Any]:
    """Rank the entries that were tested on the same contexts, beside baselines that drove the same."""
    contexts = {name: set(entry.table["context_hash"]) for name, entry in named.items()}
    most = max(map(len, contexts.values()))
    fit: dict[str, Entry] = {}
    unfit: dict[str, Entry] = {}
    for name, entry in named.items():
        few, first = most - len(contexts[name]), next(iter(fit.values()), entry)
        faults = entry.faults + ((f"{counted(few, 'context')} fewer than others of the task",) if few else ())
        if not faults and not _same(entry.table, first.table):
            faults = ("its baselines drove otherwise than those of the other files",)
        (unfit if faults else fit)[name] = dataclasses.replace(entry, faults=faults)
    parts = [e.table.assign(policy=e.table["policy"].replace({e.name: name})) for name, e in fit.items()]
    summary = summarise(pd.concat(parts, ignore_index=True).drop_duplicates(list(KEY))) if parts else None
    order = [name for name in tables.ranking(summary) if name in fit] if summary else []
    lines = [_line(name, fit[name], k) for k, name in enumerate(order, 1)]
    return {"summary": summary, "entries": lines + [_line(name, entry, None) for name, entry in unfit.items()]}


def _same(rows: pd.DataFrame, others: pd.DataFrame) -> bool:
    """Whether baselines did the same in the episodes that two files share."""
    both = rows[rows["policy"].isin(BASELINES)].merge(others, on=list(KEY), suffixes=("", "_other"))
    return all(np.allclose(both[name], both[f"{name}_other"], rtol=1e-5) for name in ("crossed", "cohort_region_co2_g"))


def _line(name: str, entry: Entry, rank: int | None) -> dict[str, Any]:
    kept = {key: entry.content[key] for key in ("policy", "hash")}
    marks = {"marks": list(entry.marks), "notes": list(entry.notes)}
    return {"name": name, "rank": rank, "source": entry.source, **kept, **marks}


def draw(found: Sequence[Entry], path: Path) -> None:
    """Draw what entries saved, a panel per group of :func:`merge`, as PNG."""
    charts = [
        dataclasses.replace(plots.forest(board(group)), title=f"{group['task']}; {_played(group)}")
        for group in merge(found)["groups"]
    ]
    save(draw_charts(charts, columns=2), path)


def _rounded(value: Any) -> Any:
    if value is None or value is pd.NA or value != value:
        return None
    if isinstance(value, str):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)  # a seed may have 19 digits
    number = float(f"{float(value):.{DIGITS}g}")
    return int(number) if number.is_integer() and abs(number) < 2**53 else number
