"""The block of aggregates: every figure that sums up benefits over approaches, defined once.

Evaluations, benchmarks over training seeds, reports and leaderboards take it from here: plain numbers of one training
seed (:func:`plain_figures`), or estimates with intervals over all of them (:func:`estimates`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from izoo.metrics import statistics
from izoo.metrics.benefit import FORMS, GATES, emission_pairs, ratio_of_sums

TASK = ["context_hash", "approach"]
"""What identifies an approach."""
RUN = "train_seed"
"""Column of the training seed, in rows of several of them."""
OVER_UNCOMMANDED = "benefit_{form}over_uncommanded"
"""Column of the benefit over the CVs that nobody commands, without gate, so that a loss shows."""


class Figure(NamedTuple):
    """A figure: what it takes of every row (``[N]``, or ``[N, 2]`` for sums), and the statistic over them.

    ``share``: the statistic is a share of approaches.
    """

    values: Callable[[pd.DataFrame], statistics.Array]
    statistic: statistics.Statistic
    share: bool = False


def _column(name: str) -> Callable[[pd.DataFrame], statistics.Array]:
    return lambda rows: rows[name].to_numpy(float)


def _flows(rows: pd.DataFrame) -> statistics.Array:
    """``[N, 2]``: vehicles that crossed under the policy and under the baseline."""
    return rows[["throughput_policy", "throughput_baseline"]].to_numpy(float)


def _kept(rows: pd.DataFrame) -> statistics.Array:
    flows = _flows(rows)
    return (flows[:, 0] >= flows[:, 1]).astype(float)


def _benefit(column: str) -> dict[str, Figure]:
    return {
        "mean": Figure(_column(column), statistics.mean),
        "iqm": Figure(_column(column), statistics.iqm),
        "share_positive": Figure(_column(column), statistics.share_positive, share=True),
    }


def _gated(gate: str, form: str) -> dict[str, Figure]:
    return {
        **_benefit(f"benefit_{form}{gate}"),
        "share_gated": Figure(_column(f"gated_{gate}"), statistics.mean, share=True),
        "ratio_of_sums": Figure(functools.partial(emission_pairs, gate=gate, form=form), ratio_of_sums),
    }


FIGURES: dict[str, dict[str, Figure]] = {
    **{f"{form}{gate}": _gated(gate, form) for form in FORMS for gate in GATES},
    **{f"{form}ungated": _benefit(f"benefit_{form}ungated") for form in FORMS},
    **{f"{form}over_uncommanded": _benefit(OVER_UNCOMMANDED.format(form=form)) for form in FORMS},
    "throughput": {
        "mean": Figure(_column("throughput_benefit"), statistics.mean),
        "ratio_of_sums": Figure(_flows, lambda pairs: -ratio_of_sums(pairs)),
        "share_kept": Figure(_kept, statistics.mean, share=True),
    },
    "served": {
        "policy": Figure(_column("served_policy"), statistics.mean),
        "baseline": Figure(_column("served_baseline"), statistics.mean),
    },
    "kept_out": {
        "policy": Figure(_column("kept_out_policy"), statistics.mean),
        "baseline": Figure(_column("kept_out_baseline"), statistics.mean),
    },
}
"""Every figure, by part and name: by form and gate the benefit, the share of gated approaches, the ratio of sums."""
OPTIONAL = {
    **{part: f"benefit_{part}" for part in (f"{form}over_uncommanded" for form in FORMS)},
    **{part: f"benefit_{part}" for part in (f"demand_{kind}" for kind in (*GATES, "ungated"))},
    "kept_out": "kept_out_policy",
}
"""Parts that not all rows have numbers for, and the column that tells: rows that were never compared with the
uncommanded CV, and those of submissions from before there was such a column."""


def figures_of(rows: pd.DataFrame) -> dict[str, dict[str, Figure]]:
    """Return the part of :data:`FIGURES` that the rows have numbers for."""
    lacking = {part for part, column in OPTIONAL.items() if column not in rows or rows[column].isna().any()}
    return {part: named for part, named in FIGURES.items() if part not in lacking}


def plain_figures(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Return every figure of one training seed's rows as a plain number, by part and name.

    Args:
        rows: approaches that count, of :func:`izoo.metrics.benefit.benefits`.
    """
    return {
        part: {name: float(figure.statistic(figure.values(rows))) for name, figure in named.items()}
        for part, named in figures_of(rows).items()
    }


def estimates(rows: pd.DataFrame) -> dict[str, dict[str, dict[str, Any]]]:
    """Return every figure with its interval (:func:`izoo.metrics.statistics.estimate`), by part and name.

    Args:
        rows: as for :func:`plain_figures`; with a column :data:`RUN`, of several training seeds, of which the figures
            are averaged. Approaches that are not there in every training seed are left out.
    """
    rows, seeds = shared_rows(rows)
    groups = rows["intersection"].tolist()[: len(rows) // seeds]

    def estimate(figure: Figure) -> dict[str, Any]:
        values = figure.values(rows)
        scores = values.reshape(seeds, len(groups), *values.shape[1:])
        return statistics.estimate(scores, figure.statistic, groups, share=figure.share).to_dict()

    return {
        part: {name: estimate(figure) for name, figure in named.items()} for part, named in figures_of(rows).items()
    }


def shared_rows(rows: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Return the approaches that all training seeds have, sorted by training seed and approach; and how many seeds."""
    if RUN not in rows:
        return rows.sort_values(TASK, kind="stable"), 1
    seeds = int(rows[RUN].nunique())
    shared = rows[rows.groupby(TASK)[RUN].transform("nunique") == seeds]
    return shared.sort_values([RUN, *TASK], kind="stable"), max(seeds, 1)


def score_matrix(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column as ``[training seeds, approaches]``, over the approaches that all training seeds have."""
    shared, _ = shared_rows(rows)
    return shared.pivot(index=RUN, columns=TASK, values=column).sort_index(axis=1).astype(np.float64)
