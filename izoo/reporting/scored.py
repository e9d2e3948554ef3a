"""Numbers of a report: benefits of every policy, over approaches and over training seeds, with intervals and n."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from izoo.evaluation import across
from izoo.evaluation.aggregates import RUN, TASK, score_matrix
from izoo.evaluation.policies import UNCOMMANDED
from izoo.evaluation.summary import approach_table
from izoo.evaluation.table import FEATURES
from izoo.metrics import statistics
from izoo.metrics.benefit import emission_pairs, ratio_of_sums
from izoo.metrics.scores import nan_share_of
from izoo.reporting.material import Entry


@dataclass(frozen=True)
class Scored:
    """A policy with its numbers.

    Attributes:
        entry: what it is.
        tables: per training seed, :func:`izoo.evaluation.summary.approach_table` plus features of the approaches.
        summary: as :func:`izoo.evaluation.across.compare` gives, over all training seeds.
        best: which of ``tables`` has the highest ratio of sums, as the paper chooses, of several that were trained.
        best_summary: its ``compare``.
    """

    entry: Entry
    tables: tuple[pd.DataFrame, ...]
    summary: dict[str, Any]
    best: int = 0
    best_summary: dict[str, Any] | None = None

    @property
    def name(self) -> str:
        return self.entry.name

    @property
    def trained(self) -> bool:
        """Whether the policy came out of training runs."""
        return self.entry.policy != UNCOMMANDED and any(run.run is not None for run in self.entry.runs)

    @property
    def untrained(self) -> bool:
        """Whether the policy has several training seeds, but is what runs begin with and not what they end with."""
        return len(self.tables) > 1 and not self.trained

    @property
    def nan_share(self) -> float:
        """Share of its commands that were NaN, over all runs: SUMO drove those vehicles."""
        return nan_share_of(run.table[run.table["policy"] == self.entry.policy] for run in self.entry.runs)

    @property
    def rows(self) -> pd.DataFrame:
        """All training seeds one after the other, with a column that numbers them."""
        return _numbered(self.tables)

    def matrix(self, column: str) -> pd.DataFrame:
        """``[runs, approaches]`` values of a column over the approaches that count in every run."""
        rows = self.rows
        return score_matrix(rows[rows["left_out"] == ""], column)


def score(entry: Entry) -> Scored:
    """Compare a policy with human driving, and with uncommanded CVs where they were played, in every run.

    Raises:
        IzooError: rows without a partner.
    """
    tables = []
    for run in entry.runs:
        result = approach_table(run.table, entry.policy)
        described = run.table[run.table["policy"] == entry.policy].drop_duplicates(TASK)
        extra = [name for name in FEATURES if name not in result]
        tables.append(result.merge(described[[*TASK, *extra]], on=TASK))
    summary = across.compare(_numbered(tables))
    scored = Scored(entry, tuple(tables), summary)
    if len(tables) == 1 or scored.untrained:
        return scored
    best = int(np.argmax([ratio_of_sums(emission_pairs(table[table["left_out"] == ""], "exact")) for table in tables]))
    return dataclasses.replace(scored, best=best, best_summary=across.compare(tables[best]))


def _numbered(tables: tuple[pd.DataFrame, ...] | list[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat([table.assign(**{RUN: k}) for k, table in enumerate(tables)], ignore_index=True)


def improvement(x: Scored, y: Scored) -> statistics.Estimate | None:
    """:func:`izoo.evaluation.across.improvement`; ``None`` for policies of different evaluations: not paired."""
    return across.improvement(x.rows, y.rows) if x.entry.test == y.entry.test else None


def profile(scored: Scored) -> np.ndarray:
    """:func:`izoo.evaluation.across.profile` of all training seeds."""
    return across.profile(scored.rows)
