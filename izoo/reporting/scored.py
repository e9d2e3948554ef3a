"""Numbers of a report: benefits of every policy, over approaches and over training seeds, with intervals and n."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from izoo.evaluation.aggregates import TASK, aggregates, over_intersections, over_train_seeds
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.summary import approach_table, compare
from izoo.evaluation.table import FEATURES
from izoo.metrics import statistics
from izoo.metrics.benefit import PAIR, benefits, emission_pairs, ratio_of_sums
from izoo.reporting.material import Entry

SEED = 0
"""Seed of all resampling, so that the same results give the same page."""
THRESHOLDS = np.linspace(-0.5, 0.5, 201)
"""Benefits at which the performance profile is given."""


@dataclass(frozen=True)
class Scored:
    """A policy with its numbers.

    Attributes:
        entry: what it is.
        baseline: what its benefit is over: human driving, or with electric CVs the uncommanded CV.
        tables: per training seed, :func:`izoo.evaluation.summary.approach_table` plus features of the approaches.
        summary: as :func:`izoo.evaluation.summary.compare` gives, over all training seeds.
        best: which of ``tables`` has the highest ratio of sums, as the paper chooses, where there are several.
        best_summary: its ``compare``.
        over_uncommanded: mean benefit over the uncommanded CV without gate, as an estimate; ``None`` for itself.
    """

    entry: Entry
    baseline: str
    tables: tuple[pd.DataFrame, ...]
    summary: dict[str, Any]
    best: int = 0
    best_summary: dict[str, Any] | None = None
    over_uncommanded: dict[str, Any] | None = None

    @property
    def name(self) -> str:
        return self.entry.name

    def matrix(self, column: str) -> pd.DataFrame:
        """``[tasks, runs]`` values of a column over the approaches that count in every run, indexed by task."""
        parts = [table[table["left_out"] == ""].set_index(TASK)[column] for table in self.tables]
        return pd.concat(parts, axis=1, join="inner", keys=range(len(parts))).astype(float)


def score(entry: Entry, resamples: int = statistics.RESAMPLES) -> Scored:
    """Compare a policy with its baseline, in every run.

    Raises:
        IzooError: rows without a partner.
    """
    first = entry.runs[0].table
    own = first[first["policy"] == entry.policy]
    has_uncommanded = UNCOMMANDED in set(first["policy"]) and entry.policy != UNCOMMANDED
    baseline = UNCOMMANDED if has_uncommanded and (own["engine"] == "electric").any() else HUMAN
    tables = []
    for run in entry.runs:
        result = approach_table(run.table, entry.policy, baseline, SEED, resamples)
        described = run.table[run.table["policy"] == entry.policy].drop_duplicates(TASK)
        extra = [name for name in FEATURES if name not in result]
        tables.append(result.merge(described[[*TASK, *extra]], on=TASK))
    over = _over_uncommanded(entry, resamples) if has_uncommanded else None
    if len(tables) == 1:
        return Scored(entry, baseline, tuple(tables), compare(tables[0], SEED, resamples), over_uncommanded=over)
    best = int(np.argmax([ratio_of_sums(emission_pairs(table[table["left_out"] == ""], "exact")) for table in tables]))
    scored = Scored(entry, baseline, tuple(tables), {}, best, compare(tables[best], SEED, resamples), over)
    scored.summary.update(_over_runs(scored, resamples))
    return scored


def _over_uncommanded(entry: Entry, resamples: int) -> dict[str, Any]:
    """Mean ungated benefit over the uncommanded CV; intersections are resampled."""
    parts = []
    for run in entry.runs:
        chosen, reference = (run.table[run.table["policy"] == name] for name in (entry.policy, UNCOMMANDED))
        reference = reference.merge(chosen[list(PAIR)], on=list(PAIR), how="inner")
        result = benefits(chosen, reference)
        parts.append(result[result["left_out"] == ""])
    table = pd.concat(parts).groupby(TASK, sort=False).agg({"benefit_ungated": "mean", "intersection": "first"})
    estimate = _bootstrap(table["benefit_ungated"].to_numpy(float), statistics.mean, table["intersection"], resamples)
    return estimate.to_dict()


def _over_runs(scored: Scored, resamples: int) -> dict[str, Any]:
    """Estimates over all training seeds, in the layout of ``compare``.

    Intersections are resampled, as with a single run, so that policies compare; ``over_seeds`` of an estimate is its
    interval over other training seeds on the same approaches (rliable's stratified bootstrap).
    """
    flags = scored.matrix("saturated").any(axis=1)
    first = scored.tables[0]
    left_out = first[first["left_out"] != ""]
    labels = first.set_index(TASK)["context"].astype(str)
    return {
        "all": _block(scored, flags.index, resamples),
        "unsaturated": _block(scored, flags.index[~flags], resamples),
        "saturated": [f"{labels[task]} {task[1]}" for task in flags.index[flags]],
        "left_out": [f"{row.context} {row.approach}: {row.left_out}" for row in left_out.itertuples()],
    }


def _block(scored: Scored, tasks: pd.Index, resamples: int) -> dict[str, Any]:
    pooled = pd.concat([table.set_index(TASK).loc[tasks] for table in scored.tables])
    places = over_intersections(pooled, SEED, resamples)
    seeds = over_train_seeds(len(scored.tables), SEED, resamples)

    def estimate(values: statistics.Array, statistic: statistics.Statistic) -> dict[str, Any]:
        found = places(values, statistic)
        if values.ndim > 1:
            return found
        interval = seeds(values, statistic)
        return {**found, "over_seeds": [interval["low"], interval["high"]]}

    return aggregates(pooled, estimate)


def _bootstrap(values: Any, statistic: statistics.Statistic, groups: pd.Series, resamples: int) -> statistics.Estimate:
    return statistics.bootstrap(values, statistic, np.random.default_rng(SEED), groups.tolist(), resamples)


def improvement(x: Scored, y: Scored, resamples: int = statistics.RESAMPLES) -> statistics.Estimate | None:
    """Probability that a run of ``x`` has the higher benefit (exact gate) on an approach than one of ``y``.

    Ties count one half. Intersections are resampled. ``None`` without common approaches, and for policies of different
    evaluations, which are not paired.
    """
    if x.entry.test != y.entry.test:
        return None
    a, b = x.matrix("benefit_exact"), y.matrix("benefit_exact")
    tasks = a.index.intersection(b.index)
    if tasks.empty:
        return None
    one, two = a.loc[tasks].to_numpy().T[:, None], b.loc[tasks].to_numpy().T[None]
    wins = ((one > two) + 0.5 * (one == two)).mean(axis=(0, 1))
    groups = x.tables[0].set_index(TASK)["intersection"].loc[tasks]
    return _bootstrap(wins, statistics.mean, groups, resamples)


def profile(scored: Scored) -> np.ndarray:
    """Share of approaches (all runs) whose benefit is above each of :data:`THRESHOLDS`; empty without approaches."""
    values = scored.matrix("benefit_exact").to_numpy()
    return statistics.performance_profile(values, THRESHOLDS) if values.size else np.empty(0)
