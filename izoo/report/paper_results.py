"""Figures of the IntersectionZoo paper (ICLR 2025, arXiv 2410.15221), at adoption 1/3, and ours in the same form."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from izoo.report.tables import Cell, Row, Table

COLUMNS = {
    "ratio_of_sums": "benefit, ratio of sums",
    "best_ratio_of_sums": "of the best seed",
    "mean": "benefit, mean",
    "share_gated": "gated to 0",
    "throughput_mean": "throughput",
    "share_kept": "kept throughput",
}
"""Aggregates of :func:`izoo.metrics.paper_form.paper_form` that are shown: headings."""
BENEFIT = "benefit over human driving, exact gate (%)"
SIGNED = ("ratio_of_sums", "best_ratio_of_sums", "mean", "throughput_mean")


@dataclass(frozen=True)
class Published:
    """One published result.

    Attributes:
        protocol, algorithm: what was trained and tested.
        at_zero: approaches in the histogram's bar at 0.
        approaches: all approaches of the histogram.
        benefit: emission benefit, ratio of sums; ``None`` where none was published.
        throughput_benefit: relative change of throughput.
        throughput_kept: share of approaches whose throughput did not fall.
    """

    protocol: str
    algorithm: str
    at_zero: int
    approaches: int
    benefit: float | None = None
    throughput_benefit: float | None = None
    throughput_kept: float | None = None


PUBLISHED = (
    Published("Salt Lake City", "DDPG", 248, 1048, -0.0185, 0.0648, 0.802),
    Published("Salt Lake City", "PPO", 913, 1048, -0.0959, 0.0154, 0.129),
    Published("Atlanta", "DDPG", 858, 2152, -0.0129, 0.0445, 0.629),
    Published("Atlanta", "PPO", 1581, 2152, -0.1486, 0.0269, 0.266),
    Published("Salt Lake City -> Atlanta", "DDPG", 945, 2152),
    Published("Salt Lake City -> Atlanta", "PPO", 1791, 2152),
    Published("Systematicity", "DDPG", 40, 128),
    Published("Systematicity", "PPO", 119, 128),
)


def published_for(task: str) -> list[Published]:
    """Return what the paper published for a task in its form, such as ``salt_lake_city_to_atlanta, paper``."""
    words = [word for word in re.split("[^a-z]+", task.lower()) if word not in ("", "to")]
    text = " ".join(dict.fromkeys(words))
    found = [p.protocol for p in PUBLISHED if re.sub("[^a-z]+", " ", p.protocol.lower()) in text]
    protocol = max(found, key=len, default="") if "paper" in words else ""
    return [each for each in PUBLISHED if each.protocol == protocol]


def paper_table(aggregates: Mapping[str, Mapping[str, Any]], title: str, task: str = "") -> Table:
    """Return the paper's form of entries, and what it published for the task.

    Args:
        aggregates: of :func:`izoo.metrics.paper_form.paper_form`, by entry.
        title: of the table.
        task: for which something may have been published.
    """
    rows = []
    for name, of in sorted(aggregates.items(), key=lambda item: -(item[1]["ratio_of_sums"] or 0.0)):
        label = name + (f" ({of['train_seeds']} seeds)" if of["train_seeds"] > 1 else "")
        rows.append(Row(label, tuple(_percent(of[key], key) for key in COLUMNS)))
    theirs = []
    for each in published_for(task):
        known = {"best_ratio_of_sums": each.benefit, "throughput_mean": each.throughput_benefit}
        known["share_kept"] = each.throughput_kept
        theirs.append(
            Row(f"{each.algorithm}, {each.protocol}", tuple(_percent(known.get(key), key) for key in COLUMNS))
        )
    return Table(title, ("entry", *COLUMNS.values()), (("", tuple(rows)), ("published", tuple(theirs))))


def _percent(share: float | None, key: str) -> Cell:
    return Cell(None if share is None else 100.0 * share, unit="%", digits=2, signed=key in SIGNED)
