"""Leaderboard files: one JSON file per entry of a benchmark, which anyone can check and merge.

A **submission** follows ``leaderboard_schema.json`` beside this module. Its rows are its evidence: benefits must follow
from the emissions and throughputs of their row, aggregates from the rows, and the hash from everything. What can be
checked without simulating is checked; that the rows were really measured, only running the benchmark again can show.

A **leaderboard** (:func:`merge`) groups submissions by protocol. Those with a mark (other versions, missing contexts,
numbers that do not follow) are listed with their marks and get no rank.
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

from izoo.errors import IzooError
from izoo.evaluation.across import RUN, aggregate
from izoo.evaluation.aggregates import TASK
from izoo.files import write_json
from izoo.metrics.benefit import SIGNIFICANCE

FORMAT, MERGED_FORMAT = "izoo-leaderboard-1", "izoo-leaderboard-merged-1"
SCHEMA_FILE = "leaderboard_schema.json"
COMPARED_VERSIONS = ("izoo", "sumo", "neuralmoves", "code")
"""Versions that a number depends on."""
COMPARABLE = ("protocol", "title", "train", "test", "form", "weather", "test_set", "horizon_s", "test_count")
"""Options of the protocol that submissions of one group share."""
FULL_TRAIN_SEEDS, FULL_EVAL_SEEDS = 4, 3
"""Seeds that the protocols ask for (spec 10 and 11)."""
TOLERANCE = 1e-9


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
) -> dict[str, Any]:
    """Return a submission.

    Args:
        policy, protocol, versions: as in the schema.
        eval_seeds: episode seeds of the evaluation.
        rows: of :func:`izoo.evaluation.across.run_rows`, all training seeds one after the other.
    """
    columns = list(schema()["properties"]["rows"]["items"]["properties"])
    content: dict[str, Any] = {
        "format": FORMAT,
        "policy": dict(policy),
        "protocol": dict(protocol),
        "versions": dict(versions),
        "train_seeds": sorted(int(seed) for seed in rows[RUN].unique()),
        "eval_seeds": [int(seed) for seed in eval_seeds],
        "rows": [
            {name: None if pd.isna(value) else value for name, value in row.items()}
            for row in rows[columns].to_dict("records")
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
    numbers = ("emission_policy_g", "emission_baseline_g", "throughput_benefit", "benefit_exact", "benefit_tested")
    for name in numbers:
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
        content = json.loads(path.read_text())
        json.dumps(content, allow_nan=False)  # Python's JSON reads NaN, and 1e999 as infinity
    except (OSError, ValueError, RecursionError) as error:
        raise IzooError(f"cannot read {path}: {error}; give a leaderboard file.") from error
    problems = sorted(Draft202012Validator(schema()).iter_errors(content), key=lambda error: list(map(str, error.path)))
    if problems:
        where = "/".join(str(part) for part in problems[0].absolute_path) or "the file"
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise IzooError(f"{path} is no leaderboard submission: {where}: {problems[0].message[:200]}{more}.")
    return content


@dataclass(frozen=True)
class Checked:
    """A submission and what is wrong with it.

    Attributes:
        source: the file's name.
        submission: its content.
        marks: why it gets no rank; empty: nothing is wrong.
        notes: what to know about it, without consequence for its rank.
    """

    source: str
    submission: dict[str, Any]
    marks: tuple[str, ...]
    notes: tuple[str, ...]


def check(submission: dict[str, Any], source: str, versions: Mapping[str, str]) -> Checked:
    """Check a well-formed submission against itself, its protocol and the versions that it is to be compared in.

    Args:
        versions: the reference, of :data:`COMPARED_VERSIONS`.
    """
    marks = []
    if content_hash(submission) != submission["hash"]:
        marks.append("the hash does not match: the file was changed after it was written")
    rows = rows_of(submission)
    marks += _row_marks(rows, submission)
    if not rows.duplicated([RUN, *TASK]).any():
        differing = _first_difference(submission["aggregates"], json.loads(json.dumps(aggregate(rows))))
        if differing:
            marks.append(f"the aggregates do not follow from the rows: {differing}")
    for name in COMPARED_VERSIONS:
        if submission["versions"][name] != versions[name]:
            old, new = (text[:12] for text in (submission["versions"][name], versions[name]))
            marks.append(f"other version of {name}: {old}, not {new}")
    if "env" in submission["protocol"]:
        marks.append(f"evaluated in another environment: {submission['protocol']['env']}")
    marks += _plan_marks(rows, submission)
    notes = []
    if submission["policy"]["kind"] == "trained" and len(submission["train_seeds"]) < FULL_TRAIN_SEEDS:
        notes.append(f"{len(submission['train_seeds'])} training seed(s) of {FULL_TRAIN_SEEDS}")
    if submission["protocol"]["scale"] != "paper":
        notes.append(f"trained at scale {submission['protocol']['scale']}")
    return Checked(source, submission, tuple(marks), tuple(notes))


def _plan_marks(rows: pd.DataFrame, submission: Mapping[str, Any]) -> list[str]:
    """In what a submission falls short of its protocol: contexts and evaluation seeds.

    The contexts of the built-in cities and of the procedural protocol are rebuilt; of the user's own folders, only
    the number is known.
    """
    from izoo.benchmarks.plan import evaluation_seeds, published_test_set

    protocol, there = submission["protocol"], set(rows["context_hash"])
    known = published_test_set(protocol)
    count = protocol["test_count"] if known is None else len(known)
    marks = []
    missing = count - len(there if known is None else there & known)
    if missing > 0:
        marks.append(f"{missing} of {count} test contexts are missing")
    if known is not None and there - known:
        marks.append(f"{len(there - known)} context(s) are not of the protocol's test set")
    seeds = submission["eval_seeds"]
    if len(seeds) < FULL_EVAL_SEEDS:
        marks.append(f"{len(seeds)} evaluation seed(s); the protocol asks for {FULL_EVAL_SEEDS}")
    if seeds != evaluation_seeds(len(seeds)):
        marks.append("the evaluation seeds are not the protocol's")
    return marks


def _row_marks(rows: pd.DataFrame, submission: Mapping[str, Any]) -> list[str]:
    """What in the rows contradicts the rows, or what the submission says of them."""
    marks = []
    if rows.duplicated([RUN, *TASK]).any():
        marks.append("an approach appears twice for one training seed")
    if set(rows[RUN]) != set(submission["train_seeds"]):
        marks.append("the rows are of other training seeds than the file says")
    if rows.groupby(RUN).size().nunique() > 1 or rows.groupby(list(TASK)).size().nunique() > 1:
        marks.append("the training seeds were not evaluated on the same approaches")
    if (rows["seeds"] != len(submission["eval_seeds"])).any():
        marks.append("rows rest on other numbers of episodes than the file has evaluation seeds")
    for number, row in enumerate(submission["rows"]):
        problem = _row_problem(row)
        if problem:
            marks.append(f"row {number} ({row['context']}, approach {row['approach']}): {problem}")
            break
    return marks


def _row_problem(row: Mapping[str, Any]) -> str:
    """Say what does not follow within a row, or nothing; with demand from all approaches another may have gated it."""
    counted = row["left_out"] == ""
    ungated = 0.0
    if row["emission_baseline_g"] and row["emission_policy_g"] is not None:
        ungated = 1.0 - row["emission_policy_g"] / row["emission_baseline_g"]
    if not math.isclose(row["benefit_ungated"], ungated, abs_tol=TOLERANCE):
        return "its benefit does not follow from its emissions"
    falls = {
        "exact": row["throughput_policy"] < row["throughput_baseline"],
        "tested": row["throughput_p"] < SIGNIFICANCE,
    }
    for gate, fell in falls.items():
        gated = row[f"gated_{gate}"]
        if gated != (fell and counted) and not (row["demand"] == "all" and gated and counted):
            return f"its {gate} gate does not follow from its throughput"
        expected = None if not counted else 0.0 if gated else row["benefit_ungated"]
        if row[f"benefit_{gate}"] != expected:
            return f"its benefit under the {gate} gate does not follow"
    return ""


def merge(checked: Sequence[Checked]) -> dict[str, Any]:
    """Return the leaderboard of several submissions.

    Returns:
        ``format``, and ``groups``: per protocol its options, ``ranked`` (without marks, best mean benefit under the
        exact gate first) and ``marked``; each with ``source``, ``policy``, ``versions``, ``n``, ``hash``, ``marks``,
        ``notes``, ``aggregates``. Two ranked submissions of one name in one group are both kept, and say so.
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
    """Return the number that ranks: the mean benefit under the exact gate, with its interval over intersections."""
    return line["aggregates"]["all"]["over_intersections"]["exact"]["mean"]


def _line(item: Checked) -> dict[str, Any]:
    content = item.submission
    kept = {name: content[name] for name in ("policy", "versions", "aggregates", "hash")}
    return {
        "source": item.source,
        **kept,
        "n": content["aggregates"].get("n", {}),
        "marks": list(item.marks),
        "notes": list(item.notes),
    }


def _first_difference(old: Any, new: Any, path: str = "") -> str:
    """Name the first place in which two nested values differ by more than rounding, or return nothing."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            found = _first_difference(old.get(key), new.get(key), f"{path}/{key}")
            if found:
                return found
        return ""
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return next(filter(None, (_first_difference(a, b, f"{path}/{k}") for k, (a, b) in pairs)), "")
    numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (old, new))
    same = math.isclose(old, new, rel_tol=1e-6, abs_tol=TOLERANCE) if numbers else old == new
    return "" if same else f"{path.lstrip('/')} is {old}, not {new}"
