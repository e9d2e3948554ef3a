"""Figures of the IntersectionZoo paper (ICLR 2025, arXiv 2410.15221), at adoption 1/3, and ours in the same form."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from izoo.metrics.cell import Cell
from izoo.report.tables import Row, Table
from izoo.tasks.built_in import PAPER

COLUMNS = {
    "ratio_of_sums": "benefit, ratio of sums",
    "best_ratio_of_sums": "of the best seed",
    "mean": "benefit, mean",
    "share_gated": "gated to 0",
    "throughput_mean": "throughput",
    "share_kept": "kept throughput",
}
"""Aggregates of :func:`izoo.metrics.paper_form.paper_form` that are shown: headings."""
SIGNED = ("ratio_of_sums", "best_ratio_of_sums", "mean", "throughput_mean")


class Published(NamedTuple):
    """One published result.

    Attributes:
        algorithm: what was trained.
        at_zero: approaches in the histogram's bar at 0.
        approaches: all approaches of the histogram.
        benefit: emission benefit, ratio of sums; ``None`` where none was published.
        throughput_benefit: relative change of throughput.
        throughput_kept: share of approaches whose throughput did not fall.
    """

    algorithm: str
    at_zero: int
    approaches: int
    benefit: float | None = None
    throughput_benefit: float | None = None
    throughput_kept: float | None = None


_SALT_LAKE_CITY = (
    Published("DDPG", 248, 1048, -0.0185, 0.0648, 0.802),
    Published("PPO", 913, 1048, -0.0959, 0.0154, 0.129),
)
_TO_ATLANTA = (Published("DDPG", 945, 2152), Published("PPO", 1791, 2152))
PUBLISHED = {
    "salt_lake_city": _SALT_LAKE_CITY,
    "measured": _SALT_LAKE_CITY,
    "atlanta": (
        Published("DDPG", 858, 2152, -0.0129, 0.0445, 0.629),
        Published("PPO", 1581, 2152, -0.1486, 0.0269, 0.266),
    ),
    "salt_lake_city_to_atlanta": _TO_ATLANTA,
    "measured_to_atlanta": _TO_ATLANTA,
    "systematicity": (Published("DDPG", 40, 128), Published("PPO", 119, 128)),
}
"""By the task whose form of the paper it belongs to; the paper's Salt Lake City is the measured one."""


def published_for(task: str) -> tuple[Published, ...]:
    """Return what the paper published for a task in its form, such as ``salt_lake_city_to_atlanta_paper``."""
    name = task.removesuffix(PAPER)
    return PUBLISHED.get(name, ()) if name != task else ()


def paper_table(aggregates: Mapping[str, Mapping[str, Any]], task: str) -> Table:
    """Return the paper's form of entries, and what it published for the task.

    Args:
        aggregates: of :func:`izoo.metrics.paper_form.paper_form`, by entry.
        task: for which something may have been published.
    """
    rows = []
    for name, of in sorted(aggregates.items(), key=lambda item: -(item[1]["ratio_of_sums"] or 0.0)):
        label = name + (f" ({of['train_seeds']} seeds)" if of["train_seeds"] > 1 else "")
        rows.append(Row(label, tuple(_percent(of[key], key) for key in COLUMNS)))
    theirs = []
    for each in published_for(task):
        known = {"best_ratio_of_sums": each.benefit, "throughput_mean": each.throughput_benefit}
        known |= {"share_kept": each.throughput_kept, "share_gated": each.at_zero / each.approaches}
        cells = {key: _percent(known.get(key), key) for key in COLUMNS}
        cells["share_gated"] = dataclasses.replace(cells["share_gated"], note="benefit of 0")
        theirs.append(Row(each.algorithm, tuple(cells.values())))
    return Table("", ("entry", *COLUMNS.values()), (("", tuple(rows)), ("published", tuple(theirs))))


def _percent(share: float | None, key: str) -> Cell:
    return Cell(None if share is None else 100.0 * share, unit="%", digits=2, signed=key in SIGNED)
