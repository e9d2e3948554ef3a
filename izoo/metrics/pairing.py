"""Rows of a policy beside those of a baseline: one row per training seed and context.

Rows are paired by :data:`PAIR`: same demand, same drivers, same arrival times. Sums are added over the approaches of a
context and averaged over its episode seeds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS
from izoo.metrics.figures import Array
from izoo.metrics.statistics import pooled

UNCOMMANDED, HUMAN = "uncommanded", "human"
BASELINES = (UNCOMMANDED, HUMAN)
"""What policies are compared with, the headline's first."""
PAIR = ("simulator", "context_hash", "seed", "approach")
"""What a policy row and its baseline row agree on."""
CONTEXT = ["train_seed", "context_hash"]
SUMS = list(APPROACH_METRICS)


class Paired(NamedTuple):
    """Contexts that a policy was compared in, three tables with the same rows.

    Attributes:
        contexts: ``train_seed``, ``context_hash``, ``context``, ``intersection``, ``saturated``; per training seed
            and context.
        own, baseline: the sums of each, mean over episode seeds.
    """

    contexts: pd.DataFrame
    own: pd.DataFrame
    baseline: pd.DataFrame


def of_policy(table: pd.DataFrame, policy: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the contexts (as in :class:`Paired`) and the sums of a policy."""
    rows = table[table["policy"] == policy]
    return _contexts(rows), _sums(rows, rows[SUMS].to_numpy(float))


def pair(table: pd.DataFrame, policy: str, baseline: str) -> Paired:
    """Join the rows of a policy with those of a baseline.

    Contexts without demand (a cohort of 0) are left out.

    Args:
        table: rows of one simulator.

    Raises:
        IzooError: the baseline lacks episodes of the policy.
    """
    rows = table[table["policy"] == policy]
    others = table[table["policy"] == baseline].drop_duplicates(list(PAIR), keep="last")
    places = others.set_index(list(PAIR)).index.get_indexer(pd.MultiIndex.from_frame(rows[list(PAIR)]))
    if (places < 0).any():
        lacking = rows[places < 0]
        episodes = lacking[["context_hash", "seed"]].drop_duplicates()
        first = lacking.iloc[0]
        raise IzooError(
            f"{baseline} lacks {len(episodes)} episode(s) of {policy} (the first: context {first['context']}, "
            f"seed {first['seed']}); evaluate it on the same contexts and seeds."
        )
    contexts = _contexts(rows)
    own = _sums(rows, rows[SUMS].to_numpy(float))
    beside = _sums(rows, others[SUMS].to_numpy(float)[places])
    kept = ((own["cohort"] > 0) & (beside["cohort"] > 0)).to_numpy()
    return Paired(*(part[kept].reset_index(drop=True) for part in (contexts, own, beside)))


def by_intersection(contexts: pd.DataFrame, values: Array) -> tuple[Array, list[str], int]:
    """Pool a figure's values by intersection, over the contexts that every training seed has a value in.

    Args:
        contexts: of :class:`Paired`.
        values: ``[N]``, one per row of it.

    Returns:
        ``[S, I]`` values, the names of the intersections, and the number of contexts.
    """
    matrix = context_matrix(contexts, values)
    names = contexts.drop_duplicates("context_hash").set_index("context_hash")["intersection"]
    places = names.loc[matrix.columns].tolist()
    return pooled(matrix.to_numpy(), places), list(dict.fromkeys(places)), matrix.shape[1]


def context_matrix(contexts: pd.DataFrame, values: Array) -> pd.DataFrame:
    """Return values ``[N]`` as ``[training seeds, contexts]``, over the contexts that all training seeds have."""
    long = contexts[CONTEXT].assign(value=values)
    return long.pivot(index="train_seed", columns="context_hash", values="value").dropna(axis=1)


def _contexts(rows: pd.DataFrame) -> pd.DataFrame:
    """Description of each training seed and context of ``rows``."""
    grouped = rows.groupby(CONTEXT, sort=False)
    found = grouped[["context", "intersection"]].first()
    found["saturated"] = grouped["volume_over_capacity"].max() > 1.0
    return found.reset_index()


def _sums(rows: pd.DataFrame, sums: np.ndarray) -> pd.DataFrame:
    """Add sums ``[N, M]``, a row for each of ``rows``, by training seed and context; mean over episode seeds."""
    keys = rows.groupby(CONTEXT, sort=False)
    number = keys.ngroup().to_numpy()
    added = np.zeros((keys.ngroups, sums.shape[1]))
    np.add.at(added, number, sums)
    return pd.DataFrame(added / keys["seed"].nunique().to_numpy()[:, None], columns=SUMS)
