"""The one converter for leaderboard files of the format ``izoo-leaderboard-2``: rows of the paper's form."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from izoo.errors import IzooError
from izoo.files import read_text
from izoo.metrics.pairing import HUMAN, UNCOMMANDED
from izoo.report.leaderboard import PAPER_COLUMNS, make_entry, write_entry

OLD_FORMAT = "izoo-leaderboard-2"
WHY = "figures of an earlier measure; a row is the mean over {seeds} episode seeds"
UNTRAINED = "_untrained"
Rows = dict[tuple[Any, ...], dict[str, Any]]
"""Rows by policy, training seed, context and approach."""


class _Old(NamedTuple):
    """A file of the old format: its content, and the rows of its policy and of human driving."""

    content: Mapping[str, Any]
    own: Rows
    human: Rows


def convert(paths: Sequence[Path], out: Path) -> list[Path]:
    """Write files of the format before this one in the present format into ``out``, in the folders they lie in.

    Rows are means over episode seeds, so that CO2 is the product of its mean per vehicle that crossed and their mean
    number. Rows of uncommanded are those of a file among ``paths`` that was played in the same episodes; where there
    is none, the file has none.

    Raises:
        IzooError: a file cannot be read, or is of another format.
    """
    old = {path: _read(path) for path in paths}
    uncommanded = [each for each in old.values() if each.content["policy"]["name"] == UNCOMMANDED]
    written, common = [], os.path.commonpath([path.parent for path in paths])
    for path, each in old.items():
        beside = next((other.own for other in uncommanded if _covers(other.human, each.human)), {})
        written.append(out / path.relative_to(common))
        written[-1].parent.mkdir(parents=True, exist_ok=True)
        write_entry(written[-1], _converted(each, beside))
    return written


def _read(path: Path) -> _Old:
    try:
        content = json.loads(read_text(path))
        if content["format"] != OLD_FORMAT:
            raise IzooError(f"{path} is of the format {str(content['format'])[:40]!r}, not {OLD_FORMAT!r}.")
        return _Old(content, _side(content, content["policy"]["name"], "policy"), _side(content, HUMAN, "baseline"))
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise IzooError(f"cannot read {path}: {type(error).__name__}: {error}; give a file of {OLD_FORMAT}.") from error


def _converted(old: _Old, uncommanded: Rows) -> dict[str, Any]:
    policy, protocol = old.content["policy"], old.content["protocol"]
    rows, approaches = old.own | old.human, {key[2:] for key in old.human}
    if policy["name"] != UNCOMMANDED:
        rows |= {key: row for key, row in uncommanded.items() if key[2:] in approaches}
    untrained = policy["name"].endswith(UNTRAINED)
    about = {**policy, "kind": "untrained" if untrained else policy["kind"], "weights": []}
    task = f"{protocol['title']}, {protocol['scale']}" + (f", {protocol['env']}" if "env" in protocol else "")
    table = pd.DataFrame(list(rows.values())).reindex(columns=list(PAPER_COLUMNS)).assign(task=task)
    why = WHY.format(seeds=len(old.content["eval_seeds"]))
    return make_entry(about, task, 0, old.content["versions"], table, why)


def _side(content: Mapping[str, Any], name: str, side: str) -> Rows:
    """Rows of a policy, or of its baseline, by policy, training seed, context and approach."""
    found: Rows = {}
    for row in content["rows"]:
        crossed, grams = row[f"throughput_{side}"], row[f"emission_{side}_g"]
        seed = row["train_seed"] if side == "policy" else 0
        about = {key: row[key] for key in ("context", "context_hash", "intersection", "approach", "demand")}
        sums = {"crossed": crossed, "emission_g": crossed * (grams or 0.0)}
        played = {"policy": name, "train_seed": seed, "simulator": content.get("simulator", "sumo"), "seed": 0}
        found.setdefault((name, seed, row["context_hash"], row["approach"]), {**played, **about, **sums})
    return found


def _covers(own: Rows, other: Rows) -> bool:
    """Whether human driving did the same in all episodes of the other file."""
    return all(key in own and abs(own[key]["crossed"] - row["crossed"]) < 1e-9 for key, row in other.items())
