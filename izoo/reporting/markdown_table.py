"""Leaderboard files as a table in Markdown, as the benchmark's page shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from izoo.console import plain
from izoo.errors import IzooError
from izoo.evaluation.across import aggregate
from izoo.evaluation.aggregates import TASK, shared_rows
from izoo.evaluation.policies import UNCOMMANDED
from izoo.evaluation.show import rounded_percent
from izoo.metrics import statistics
from izoo.reporting.standing import UNTRAINED
from izoo.reporting.submissions import Checked, content_hash, rows_of

COLUMNS = (
    "entry",
    "training",
    "seeds",
    "benefit, exact gate",
    "over uncommanded",
    "whole demand, over uncommanded",
    "whole region, over uncommanded",
    "kept out, over uncommanded",
    "throughput kept",
    "over uncommanded, by seed",
)
SCRIPTED = (UNCOMMANDED, "glide", "constant_2.0", "measured_search")
"""Policies without training that stand first, in this order; others follow by name."""
NAMES = {"ppo": "PPO", "mappo": "MAPPO", "gcrl": "Graph RL", "ddpg": "DDPG"}
LEARNERS = NAMES | {f"{name}_paper": f"{shown}, the paper's preset" for name, shown in NAMES.items()}
"""What learners are called, in the order of their rows; others follow by name, called as they are."""
KEPT_OUT = "kept_out_policy"
HUMAN_DRIVING = ("throughput_baseline", "kept_out_baseline")
"""Columns of a row that human driving alone decides: the same in all files that played the same episodes."""
OTHER = "_uncommanded"
"""Added to the names of columns of the file that is compared with."""


def markdown_table(checked: Sequence[Checked], uncommanded: Checked | None = None) -> str:
    """Return a row per leaderboard file: policies without training, learners by length of training, then the same
    learners untrained.

    Figures are in percent, computed from the files' rows. All but one are aggregates that the files hold as well; what
    is kept out is the share of the vehicles due that had not come to the region, minus that of uncommanded CVs on the
    same approach, in points.

    Args:
        checked: submissions that were tested in the same episodes.
        uncommanded: that of uncommanded CVs, where it is to be no row of the table.

    Raises:
        IzooError: uncommanded CVs are missing or there are several, the episodes of two files differ, or a file was
            changed after it was written.
    """
    reference = _reference(checked, uncommanded)
    rows = _rows(reference)
    lines = sorted((_place(each.submission), _cells(each, _compared(each, rows, reference))) for each in checked)
    return "\n".join([_line(COLUMNS), "|---" * len(COLUMNS) + "|", *(_line(cells) for _, cells in lines)])


def _reference(checked: Sequence[Checked], uncommanded: Checked | None) -> Checked:
    """Return the file of uncommanded CVs, with which the others are compared."""
    found = [each for each in checked if _is_uncommanded(each)]
    if uncommanded is not None:
        if not _is_uncommanded(uncommanded):
            name = plain(uncommanded.submission["policy"]["name"])
            raise IzooError(
                f"--uncommanded is {plain(uncommanded.source)}, the file of {name}; give that of uncommanded CVs."
            )
        found.append(uncommanded)
    if not found:
        raise IzooError(
            "none of the files is that of uncommanded CVs, with which the table compares; add uncommanded.json, or "
            "name it with --uncommanded if it is to have no row."
        )
    if len(found) > 1:
        both = " and ".join(plain(each.source) for each in found[:2])
        raise IzooError(f"{both} are both files of uncommanded CVs; give only one.")
    return found[0]


def _is_uncommanded(item: Checked) -> bool:
    policy = item.submission["policy"]
    return bool(policy["name"] == UNCOMMANDED and policy["kind"] == "scripted")


def _rows(item: Checked) -> pd.DataFrame:
    """Return the rows of a file; columns that files of earlier versions lack are empty.

    Raises:
        IzooError: the file is not as it was written.
    """
    if content_hash(item.submission) != item.submission["hash"]:
        raise IzooError(
            f"{plain(item.source)} was changed after it was written: its hash does not match. Give the file as the "
            "benchmark wrote it."
        )
    rows = rows_of(item.submission)
    missing = [name for name in (KEPT_OUT, *HUMAN_DRIVING) if name not in rows]
    return rows.reindex(columns=[*rows.columns, *missing])


def _compared(item: Checked, uncommanded: pd.DataFrame, reference: Checked) -> pd.DataFrame:
    """Return the rows of a file, beside what uncommanded CVs kept out and human driving did in the reference.

    Raises:
        IzooError: the two were not tested in the same episodes.
    """
    rows, files = _rows(item), f"{plain(item.source)} and {plain(reference.source)}"
    other = uncommanded.drop_duplicates(TASK)[[*TASK, KEPT_OUT, *HUMAN_DRIVING]]
    joined = rows.merge(other, on=TASK, how="left", suffixes=("", OTHER), indicator="found")
    whole = (rows.groupby("train_seed").size() == len(other)).all()
    if (joined["found"] != "both").any() or not whole:
        raise IzooError(f"{files} were tested on different approaches; give only files with the same.")
    for name in HUMAN_DRIVING:
        mine, theirs = joined[name], joined[f"{name}{OTHER}"]
        if not (mine.isna() | theirs.isna() | (mine == theirs)).all():
            raise IzooError(
                f"{files} were tested in different episodes, as human driving differs; give only files with the same."
            )
    return joined


def _place(submission: Mapping[str, Any]) -> tuple[int, int, str, int]:
    """Return what rows are sorted by: kind of entry, its place among the known ones, name, length of training."""
    policy = submission["policy"]
    name = str(policy["name"])
    base = name.removesuffix(UNTRAINED)
    known = SCRIPTED if _is_scripted(policy) else tuple(LEARNERS)
    kind = 0 if _is_scripted(policy) else 1 if policy["kind"] == "trained" else 2
    return kind, known.index(base) if base in known else len(known), base, policy["frames"]


def _is_scripted(policy: Mapping[str, Any]) -> bool:
    return policy["kind"] == "scripted" and not str(policy["name"]).endswith(UNTRAINED)


def _cells(item: Checked, rows: pd.DataFrame) -> list[str]:
    policy, aggregates = item.submission["policy"], aggregate(rows)
    trained, found = policy["kind"] == "trained", aggregates["all"]
    over = [seed["over_uncommanded"]["mean"] for seed in aggregates["per_seed"] if "over_uncommanded" in seed]
    seeds = aggregates["n"]["train_seeds"]
    return [
        _name(policy),
        f"{policy['frames']:,}" if trained else "",
        str(seeds) if trained or seeds > 1 else "",
        _figure(found["exact"]["mean"]),
        *(_figure(found.get(f"{form}over_uncommanded", {}).get("mean")) for form in ("", "demand_", "region_")),
        "" if _is_uncommanded(item) else _figure(_kept_out(rows)),
        _whole(found["throughput"]["share_kept"]["value"]),
        ", ".join(map(_signed, over)) if len(over) > 1 else "",
    ]


def _kept_out(rows: pd.DataFrame) -> dict[str, Any] | None:
    """Estimate how much more is kept out than with uncommanded CVs; ``None`` where one of the two files is from before
    that was counted."""
    rows, seeds = shared_rows(rows[rows["left_out"] == ""])
    more = (rows[KEPT_OUT] - rows[f"{KEPT_OUT}{OTHER}"]).to_numpy(float).reshape(seeds, -1)
    if np.isnan(more).any():
        return None
    return statistics.estimate(more, statistics.mean, rows["intersection"].tolist()[: more.shape[1]]).to_dict()


def _name(policy: Mapping[str, Any]) -> str:
    base = str(policy["name"]).removesuffix(UNTRAINED)
    shown = None if _is_scripted(policy) else LEARNERS.get(base)
    if shown is None:  # somebody's name; as code, in which Markdown obeys nothing but the two that are replaced
        shown = "`" + plain(base).replace("`", "'").replace("|", "\\|") + "`"
    return shown if base == policy["name"] else f"{shown}, untrained"


def _figure(estimate: Mapping[str, Any] | None) -> str:
    """An estimate in percent with its sign, and its interval where it has one."""
    if estimate is None or estimate["value"] is None:
        return ""
    low, high = (None if estimate[k] is None else rounded_percent(estimate[k]) for k in ("low", "high"))
    text = _signed(estimate["value"])
    return text if low is None else f"{text} [{low:.1f}, {high:.1f}]"


def _signed(share: float) -> str:
    value = rounded_percent(share)
    return f"{value:+.1f}" if value else "0.0"


def _whole(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.0f} %"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
