"""Leaderboard files: one JSON file per entry of a benchmark, which anyone can check and merge.

A **submission** follows ``leaderboard_schema.json`` beside this module; its rows are its evidence. That the rows were
really measured, only running the benchmark again can show.

A **leaderboard** (:func:`merge`) groups submissions by protocol. Those with a mark (other versions, another
environment, missing contexts, a file that was changed by hand) are listed with their marks and get no rank.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd
from jsonschema import Draft202012Validator

from izoo.console import counted
from izoo.envs.config import SIMULATOR_NAMES
from izoo.errors import IzooError
from izoo.evaluation.across import aggregate
from izoo.evaluation.aggregates import RUN, TASK
from izoo.evaluation.provenance import DECISIVE
from izoo.files import read_text, write_json
from izoo.metrics.statistics import MIN_EVAL_SEEDS, MIN_TRAIN_SEEDS

FORMAT, MERGED_FORMAT = "izoo-leaderboard-2", "izoo-leaderboard-merged-2"
SCHEMA_FILE = "leaderboard_schema.json"
COMPARABLE = ("protocol", "title", "train", "test", "form", "weather", "test_set", "horizon_s", "test_count")
"""Options of the protocol that submissions of one group share."""
LARGEST = 1e15
"""No number of a row is larger, so that its powers are finite."""
FULL_TRAIN_SEEDS, FULL_EVAL_SEEDS = MIN_TRAIN_SEEDS, MIN_EVAL_SEEDS
"""Seeds that the protocols ask for: the fewest over which there are intervals."""


@functools.cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a submission."""
    return json.loads((resources.files("izoo.reporting") / SCHEMA_FILE).read_text())


def make_submission(
    policy: Mapping[str, Any],
    protocol: Mapping[str, Any],
    versions: Mapping[str, str],
    eval_seeds: Sequence[int],
    rows: pd.DataFrame,
    simulator: str = "sumo",
) -> dict[str, Any]:
    """Return a submission.

    Args:
        policy, protocol, versions: as in the schema.
        eval_seeds: numbers of the evaluation's episode seeds, of which each intersection has its own.
        rows: of :func:`izoo.evaluation.across.run_rows`, all training seeds one after the other.
        simulator: what played the episodes.
    """
    columns = list(schema()["properties"]["rows"]["items"]["properties"])
    content: dict[str, Any] = {
        "format": FORMAT,
        "policy": dict(policy),
        "protocol": dict(protocol),
        "simulator": simulator,
        "versions": dict(versions),
        "train_seeds": sorted(int(seed) for seed in rows[RUN].unique()),
        "eval_seeds": [int(seed) for seed in eval_seeds],
        "rows": [
            {name: None if pd.isna(value) else value for name, value in row.items()}
            for row in rows.reindex(columns=columns).astype(object).to_dict("records")
        ],
    }
    content["aggregates"] = aggregate(rows_of(content))
    return {**content, "hash": content_hash(content)}


def content_hash(submission: Mapping[str, Any]) -> str:
    """SHA-256 of a submission without its hash: keys sorted, no spaces, numbers as Python's ``repr`` writes them."""
    content = {key: value for key, value in submission.items() if key != "hash"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def rows_of(submission: Mapping[str, Any]) -> pd.DataFrame:
    """Return the rows of a submission as :func:`izoo.evaluation.across.aggregate` takes them."""
    table = pd.DataFrame(submission["rows"])
    for name, column in schema()["properties"]["rows"]["items"]["properties"].items():
        if name in table and column.get("type") == ["number", "null"]:
            table[name] = table[name].astype(float)
    return table


def write_submission(path: Path, submission: Mapping[str, Any]) -> None:
    """Write a submission, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, submission)


def read_submission(path: Path) -> dict[str, Any]:
    """Read a submission and check its form.

    Raises:
        IzooError: the file cannot be read, or does not follow the schema; the first place that does not is named.
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
        raise IzooError(f"{path} is no leaderboard submission: {where}: {problems[0].message[:200]}{more}.")
    for k, row in enumerate(content["rows"]):
        for name, value in row.items():
            if isinstance(value, int | float) and abs(value) > LARGEST:
                raise IzooError(f"{path} is no leaderboard submission: rows/{k}/{name}: {value} is beyond {LARGEST:g}.")
    return content


@dataclass(frozen=True)
class Checked:
    """A submission and what is wrong with it.

    Attributes:
        source: the file's name.
        submission: its content.
        aggregates: what follows from its rows, which is what is ranked.
        marks: why it gets no rank; empty: nothing is wrong.
        notes: what to know about it, without consequence for its rank.
    """

    source: str
    submission: dict[str, Any]
    aggregates: dict[str, Any]
    marks: tuple[str, ...]
    notes: tuple[str, ...]


def check(submission: dict[str, Any], source: str, versions: Mapping[str, str]) -> Checked:
    """Check a well-formed submission against its hash, its protocol and the versions that it is to be compared in.

    Args:
        versions: the reference, of :data:`izoo.evaluation.provenance.DECISIVE`.

    Raises:
        IzooError: its training seeds have different approaches, or one repeatedly, so that nothing follows from them.
    """
    marks = []
    if content_hash(submission) != submission["hash"]:
        marks.append("the hash does not match: the file was changed after it was written")
    for name in DECISIVE:
        if submission["versions"][name] != versions[name]:
            old, new = (text[:12] for text in (submission["versions"][name], versions[name]))
            marks.append(f"other version of {name}: {old}, not {new}")
    if simulator_of(submission) != "sumo":
        marks.append(f"played on {SIMULATOR_NAMES[simulator_of(submission)]}; only what SUMO played is ranked")
    if "env" in submission["protocol"]:
        marks.append(f"evaluated in another environment: {submission['protocol']['env']}")
    rows = rows_of(submission)
    if (rows.groupby(list(TASK))[RUN].agg(["size", "nunique"]) != rows[RUN].nunique()).any(axis=None):
        raise IzooError(f"{source} lacks or repeats approaches; its rows must hold each once per training seed.")
    aggregates = aggregate(rows)
    if not _follows(submission["aggregates"], aggregates):
        marks.append("the aggregates do not follow from the rows")
    if sorted(rows[RUN].unique()) != sorted(submission["train_seeds"]):
        marks.append(f"train_seeds are {submission['train_seeds']}, the rows have {sorted(rows[RUN].unique())}")
    count = submission["protocol"]["test_count"]
    there = int(rows.groupby(RUN)["context_hash"].nunique().min())
    if there < count:
        marks.append(f"{count - there} of {count} test contexts are missing")
    seeds = min(len(submission["eval_seeds"]), int(rows["seeds"].min()))
    if seeds < FULL_EVAL_SEEDS:
        marks.append(f"{counted(seeds, 'evaluation seed')}; the protocol asks for {FULL_EVAL_SEEDS}")
    notes = []
    if submission["policy"]["kind"] == "trained" and len(submission["train_seeds"]) < FULL_TRAIN_SEEDS:
        notes.append(f"{counted(len(submission['train_seeds']), 'training seed')} of {FULL_TRAIN_SEEDS}")
    if submission["protocol"]["scale"] != "paper":
        notes.append(f"trained at scale {submission['protocol']['scale']}")
    return Checked(source, submission, aggregates, tuple(marks), tuple(notes))


def _follows(stated: Any, found: Any) -> bool:
    """Return whether what a file states is what was found; an older file may state less."""
    if isinstance(stated, Mapping):
        return isinstance(found, Mapping) and all(k in found and _follows(v, found[k]) for k, v in stated.items())
    if isinstance(stated, list):
        return isinstance(found, list) and len(stated) == len(found) and all(map(_follows, stated, found))
    if isinstance(stated, float) and isinstance(found, float):
        return math.isclose(stated, found, rel_tol=1e-6, abs_tol=1e-9)
    return stated == found


def simulator_of(submission: Mapping[str, Any]) -> str:
    """Return what played a submission's episodes; before the twin there was only SUMO, and files did not say so."""
    return str(submission.get("simulator", "sumo"))


def merge(checked: Sequence[Checked]) -> dict[str, Any]:
    """Return the leaderboard of several submissions.

    Returns:
        ``format``, and ``groups``: per protocol its options, ``ranked`` (without marks, best mean benefit under the
        exact gate first) and ``marked``; each with ``source``, ``policy``, ``simulator``, ``versions``, ``n``,
        ``hash``, ``marks``, ``notes``, ``aggregates``. Two ranked submissions of one name in one group are both kept,
        and say so.
    """
    groups: dict[str, dict[str, Any]] = {}
    for item in checked:
        protocol = {name: item.submission["protocol"][name] for name in COMPARABLE}
        key = json.dumps(protocol, sort_keys=True)
        group = groups.setdefault(key, {"protocol": protocol, "ranked": [], "marked": []})
        group["marked" if item.marks else "ranked"].append(_line(item))
    for group in groups.values():
        group["ranked"].sort(key=lambda line: -(headline(line)["value"] or 0.0))
        names = [line["policy"]["name"] for line in group["ranked"]]
        for rank, line in enumerate(group["ranked"], start=1):
            line["rank"] = rank
            if names.count(line["policy"]["name"]) > 1:
                line["notes"].append("another submission has the same name")
    return {"format": MERGED_FORMAT, "groups": list(groups.values())}


def headline(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the number that ranks: the mean benefit under the exact gate, with its interval."""
    return line["aggregates"]["all"]["exact"]["mean"]


def _line(item: Checked) -> dict[str, Any]:
    content = item.submission
    kept = {name: content[name] for name in ("policy", "versions", "hash")}
    return {
        "source": item.source,
        "simulator": simulator_of(content),
        **kept,
        "aggregates": item.aggregates,
        "n": item.aggregates["n"],
        "marks": list(item.marks),
        "notes": list(item.notes),
    }
