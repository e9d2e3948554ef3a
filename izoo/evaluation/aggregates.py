"""The block of aggregates: every figure that sums up benefits over approaches, defined once.

Evaluations, benchmarks over training seeds, reports and leaderboards differ only in the estimator that they hand to
:func:`aggregates`: plain numbers, intervals over intersections, or intervals over training seeds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from izoo.metrics import statistics
from izoo.metrics.benefit import GATES, emission_pairs, ratio_of_sums

TASK = ["context_hash", "approach"]
"""What identifies an approach."""
STATISTICS: dict[str, statistics.Statistic] = {
    "mean": statistics.mean,
    "iqm": statistics.iqm,
    "share_positive": statistics.share_positive,
}
"""Aggregates of the benefit over approaches."""
Estimator = Callable[[statistics.Array, statistics.Statistic], Any]
"""Turns the values of all rows, ``[N]`` or ``[N, 2]``, and a statistic of them into a number or an estimate."""


class Figure(NamedTuple):
    """A figure: what it takes of every row (``[N]``, or ``[N, 2]`` for sums), and the statistic over them."""

    values: Callable[[pd.DataFrame], statistics.Array]
    statistic: statistics.Statistic


def _column(name: str) -> Callable[[pd.DataFrame], statistics.Array]:
    return lambda rows: rows[name].to_numpy(float)


def _flows(rows: pd.DataFrame) -> statistics.Array:
    """``[N, 2]``: vehicles that crossed under the policy and under the baseline."""
    return rows[["throughput_policy", "throughput_baseline"]].to_numpy(float)


def _kept(rows: pd.DataFrame) -> statistics.Array:
    flows = _flows(rows)
    return (flows[:, 0] >= flows[:, 1]).astype(float)


def _benefit(column: str) -> dict[str, Figure]:
    return {name: Figure(_column(column), statistic) for name, statistic in STATISTICS.items()}


def _gated(gate: str) -> dict[str, Figure]:
    return {
        **_benefit(f"benefit_{gate}"),
        "share_gated": Figure(_column(f"gated_{gate}"), statistics.mean),
        "ratio_of_sums": Figure(functools.partial(emission_pairs, gate=gate), ratio_of_sums),
    }


FIGURES: dict[str, dict[str, Figure]] = {
    **{gate: _gated(gate) for gate in GATES},
    "ungated": _benefit("benefit_ungated"),
    "throughput": {
        "mean": Figure(_column("throughput_benefit"), statistics.mean),
        "ratio_of_sums": Figure(_flows, lambda pairs: -ratio_of_sums(pairs)),
        "share_kept": Figure(_kept, statistics.mean),
    },
}
"""Every figure, by part and name: per gate the benefit, the share of gated approaches and the ratio of sums."""
SCORES: dict[str, dict[str, Figure]] = {
    part: {name: figure for name, figure in figures.items() if name != "ratio_of_sums"}
    for part, figures in FIGURES.items()
    if part != "throughput"
}
"""The figures that have one benefit per approach, as comparisons over training seeds need."""


def aggregates(
    rows: pd.DataFrame, estimate: Estimator, figures: dict[str, dict[str, Figure]] = FIGURES
) -> dict[str, dict[str, Any]]:
    """Return what ``estimate`` makes of each of ``figures``, by part and name.

    Args:
        rows: approaches that count, of :func:`izoo.metrics.benefit.benefits`; of several training seeds one after the
            other, each with the same approaches in the same order.
    """
    return {
        part: {name: estimate(figure.values(rows), figure.statistic) for name, figure in named.items()}
        for part, named in figures.items()
    }


def plain(values: statistics.Array, statistic: statistics.Statistic) -> float:
    """Estimate nothing: the statistic as it is."""
    return float(statistic(values))


def over_intersections(rows: pd.DataFrame, seed: int, resamples: int, runs: int = 1) -> Estimator:
    """Return what estimates with an interval over other intersections, as approaches of one are not independent.

    Args:
        rows: as for :func:`aggregates`.
        seed: of the resampling; the same rows and seed give the same numbers.
        runs: training seeds whose values are averaged for each approach first; 1: values as they are.
    """
    groups = rows["intersection"].tolist()[: len(rows) // runs]

    def estimate(values: statistics.Array, statistic: statistics.Statistic) -> dict[str, Any]:
        means = values.reshape(runs, len(groups), *values.shape[1:]).mean(axis=0)
        generator = np.random.default_rng(seed)
        return statistics.bootstrap(means, statistic, generator, groups, resamples).to_dict()

    return estimate


def over_train_seeds(runs: int, seed: int, resamples: int) -> Estimator:
    """Return what estimates with an interval over ``runs`` other training seeds on the same approaches (rliable)."""

    def estimate(values: statistics.Array, statistic: statistics.Statistic) -> dict[str, Any]:
        scores = values.reshape(runs, -1)
        generator = np.random.default_rng(seed)
        return statistics.stratified_bootstrap(scores, statistic, generator, resamples).to_dict()

    return estimate
