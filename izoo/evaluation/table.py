"""The evaluation table: one row per (policy, context, seed, approach), its columns, and its files."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.contexts.context import Context
from izoo.errors import IzooError
from izoo.evaluation.plausible import ROW_KEY, check_cells
from izoo.evaluation.saturation import volume_over_capacity
from izoo.files import read_text, write_text
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS
from izoo.networks.road import RoadNet

CSV_FILE, JOURNAL_FILE, MANIFEST_FILE, SUMMARY_FILE = (
    "evaluation.csv",
    "evaluation.partial.jsonl",
    "evaluation.json",
    "summary.json",
)
EPISODE_KEY = ("policy", "context_hash", "seed")
IDENTITY = (
    "policy",
    "context",
    "context_hash",
    "context_id",
    "intersection",
    "city",
    "approach",
    "seed",
    "demand",
    "hour",
    "season",
    "engine",
    "adoption",
    "cv_vehicle",
    "temperature_c",
    "humidity_pct",
)
"""Which episode a row belongs to. ``demand`` is ``one`` (approach) or ``all``; the context is the policy's, also in
rows of human driving, so that rows pair up."""
FEATURES = (
    "flow_vph_per_lane",
    "lane_count",
    "lane_length_m",
    "speed_limit_mps",
    "grade",
    "green_share",
    "cycle_s",
    "volume_over_capacity",
)
"""What the approach is like; ``green_share`` is the mean over its movements."""
EPISODE_COLUMNS = tuple(f"episode_{name}" for name in EPISODE_METRICS)
COLUMNS = (*IDENTITY, *FEATURES, *APPROACH_METRICS, *EPISODE_COLUMNS)
_TEXT = tuple(
    name for name in IDENTITY if name not in {"context_id", "seed", "adoption", "temperature_c", "humidity_pct"}
)
_WHOLE = ("context_id", "seed")


def identity(policy: str, context: Context, seed: int, approach: str) -> dict[str, Any]:
    """Return the columns :data:`IDENTITY` of a row."""
    return {
        "policy": policy,
        "context": context.name,
        "context_hash": context.content_hash,
        "context_id": context.context_id,
        "intersection": context.intersection.name,
        "city": context.intersection.city,
        "approach": approach,
        "seed": seed,
        "demand": "all" if context.approach is None else "one",
        "hour": context.hour,
        "season": context.season,
        "engine": context.engine,
        "adoption": context.adoption,
        "cv_vehicle": context.cv_vehicle,
        "temperature_c": context.temperature_c,
        "humidity_pct": context.humidity_pct,
    }


def scored_approaches(context: Context) -> tuple[str, ...]:
    """Approaches that get a row: the one with demand, or all."""
    return context.intersection.approach_names if context.approach is None else (context.approach,)


def features(context: Context, road: RoadNet, approach: str) -> dict[str, float]:
    """Return the columns :data:`FEATURES` of a row."""
    p = road.approaches.index(approach)
    served = road.movement_turn[p] >= 0
    green = float(road.clock.green_s[p][served].mean()) if served.any() else 0.0
    return {
        "flow_vph_per_lane": context.flow_vph_per_lane(approach),
        "lane_count": float(road.lane_count[p]),
        "lane_length_m": float(road.lane_length_m[p]),
        "speed_limit_mps": float(road.speed_limit_mps[p]),
        "grade": float(road.grade[p]),
        "green_share": green / float(road.clock.cycle_s),
        "cycle_s": float(road.clock.cycle_s),
        "volume_over_capacity": volume_over_capacity(context, road, p),
    }


def make_table(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with all columns in order, sorted by policy, context, seed and approach."""
    table = pd.DataFrame(list(rows), columns=list(COLUMNS))
    for column in _TEXT:
        table[column] = table[column].astype(object).where(table[column].notna(), None)
    for column in _WHOLE:
        table[column] = table[column].astype("Int64")
    numbers = [column for column in COLUMNS if column not in _TEXT and column not in _WHOLE]
    table[numbers] = table[numbers].astype(float)
    table = table.sort_values(["policy", "context", "context_hash", "seed", "approach"], kind="stable")
    return table.reset_index(drop=True)


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table whole or not at all; numbers are written so that they read back exactly."""
    write_text(path, table.to_csv(index=False))


def read_csv(path: Path) -> pd.DataFrame:
    """Read an evaluation table.

    Raises:
        IzooError: the file cannot be read, lacks columns, or is cut short.
    """
    try:
        text = read_text(path)
        if not text.endswith("\n"):
            raise ValueError("it is cut short")  # pandas would fill the rest of the last row
        raw = pd.read_csv(
            io.StringIO(text),
            float_precision="round_trip",
            dtype=dict.fromkeys((*_TEXT, *_WHOLE), str),
            keep_default_na=False,  # a policy may be called "null", an intersection "NA"
            na_values=[""],
        )
    except (OSError, ValueError) as error:
        raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}; remove it and evaluate again.") from error
    missing = [column for column in COLUMNS if column not in raw]
    if missing:
        raise IzooError(
            f"{path} lacks the column(s) {', '.join(missing)}: another version of izoo wrote it; choose another folder."
        )
    check_cells(raw, path, _TEXT, _WHOLE)
    rows = raw[list(COLUMNS)].to_dict("records")
    for row in rows:
        for column in (*_TEXT, *_WHOLE):
            value = row[column]
            row[column] = None if isinstance(value, float) and math.isnan(value) else value
        for column in _WHOLE:
            row[column] = None if row[column] is None else int(row[column])
    return make_table(rows)


def read_journal(path: Path) -> list[dict[str, Any]]:
    """Return the rows of the episodes that an interrupted evaluation finished; a last line cut short is dropped.

    Raises:
        IzooError: the file holds something else.
    """
    if not path.exists():
        return []
    try:
        text = read_text(path)
        episodes = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
        rows = [row for rows in episodes for row in rows]
        table = pd.DataFrame(rows, dtype=object)
        missing = [column for column in COLUMNS if rows and column not in table]
        if missing:
            raise ValueError(f"rows lack {', '.join(missing)}")
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise IzooError(f"{path} is damaged ({error}); remove it and evaluate again.") from error
    if rows:
        check_cells(table.drop_duplicates(list(ROW_KEY), keep="last"), path, _TEXT, _WHOLE, first=1)
    return rows
