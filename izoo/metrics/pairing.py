"""Rows of a policy beside those of a baseline: one row per training seed and context.

Rows are paired by :data:`PAIR`: same demand, same drivers, same arrival times. Sums are added over the approaches of a
context and averaged over its episode seeds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from izoo.errors import IzooError
from izoo.metrics import REFERENCE
from izoo.metrics.figures import Array
from izoo.metrics.statistics import pooled

UNCOMMANDED, HUMAN = "uncommanded", "human"
BASELINES = (UNCOMMANDED, HUMAN)
"""What policies are compared with, the headline's first."""
PLANNER = "planner"
"""Knows the future: an estimate of what there is to gain, and no entry beside the others."""
PAIR = ("simulator", "context_hash", "seed", "approach")
"""What a policy row and its baseline row agree on."""
CONTEXT = ["train_seed", "context_hash"]
Episodes = tuple[tuple[int, str, int], ...]
"""What each training seed of a policy played: training seed, ``context_hash`` and episode seed."""


def simulators(table: pd.DataFrame) -> list[str]:
    """Return what played a table, the one with most episodes first; of two with as many, the reference."""
    episodes = table.drop_duplicates(["policy", "train_seed", "simulator", "context_hash", "seed"])
    counts = episodes["simulator"].value_counts()
    return sorted(counts.index, key=lambda name: (-counts[name], name != REFERENCE))


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
    return _contexts(rows), _sums(rows, rows)


def matched(table: pd.DataFrame, policy: str, baseline: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the rows of a policy, and the row of the baseline that each is paired with, in the same order.

    Args:
        table: rows of one simulator.

    Raises:
        IzooError: the baseline lacks episodes of the policy.
    """
    rows = table[table["policy"] == policy]
    others = table[table["policy"] == baseline].drop_duplicates(list(PAIR), keep="last")
    places = pd.MultiIndex.from_frame(others[list(PAIR)]).get_indexer(pd.MultiIndex.from_frame(rows[list(PAIR)]))
    lacking = rows[places < 0]
    if len(lacking):
        first = lacking.iloc[0]
        raise IzooError(
            f"{baseline} lacks {len(lacking[['context_hash', 'seed']].drop_duplicates())} episode(s) of {policy} (the "
            f"first: context {first['context']}, seed {first['seed']}); evaluate it on the same contexts and seeds."
        )
    return rows, others.iloc[places]


def pair(table: pd.DataFrame, policy: str, baseline: str) -> Paired:
    """Join the rows of a policy with those of a baseline, as :func:`matched` does.

    Contexts without demand (a cohort of 0) are left out.
    """
    rows, others = matched(table, policy, baseline)
    own, beside = (_sums(rows, part) for part in (rows, others))
    kept = (own["cohort"] > 0).to_numpy()
    return Paired(*(part[kept].reset_index(drop=True) for part in (_contexts(rows), own, beside)))


def episodes_of(table: pd.DataFrame, policy: str) -> Episodes:
    """Return what each training seed of a policy played, in order."""
    rows = table.loc[table["policy"] == policy, [*CONTEXT, "seed"]].drop_duplicates()
    return tuple(sorted(rows.itertuples(index=False, name=None)))


def pair_in_episodes(table: pd.DataFrame, policy: str, baseline: str, episodes: Episodes) -> Paired:
    """As :func:`pair`, once for each training seed of another policy, in the episodes that this seed played.

    The mean of all episodes of a policy is no match for single ones of another: where savings are skewed, their
    interquartile means differ.

    Args:
        episodes: of the other policy (:func:`episodes_of`).
    """
    played = pd.DataFrame(list(episodes), columns=[*CONTEXT, "seed"])
    own = table[table["policy"] == policy].drop(columns="train_seed").merge(played, on=["context_hash", "seed"])
    return pair(pd.concat([own, table[table["policy"] == baseline]], ignore_index=True), policy, baseline)


def by_intersection(contexts: pd.DataFrame, values: Array) -> tuple[Array, int]:
    """Pool a figure's values by intersection, over the contexts that every training seed has a value in.

    Args:
        contexts: of :class:`Paired`.
        values: ``[N]``, one per row of it.

    Returns:
        ``[S, I]`` values, and the number of contexts.
    """
    matrix = context_matrix(contexts, values)
    return pooled(matrix.to_numpy(), intersections_of(contexts, matrix.columns)), matrix.shape[1]


def intersections_of(contexts: pd.DataFrame, keys: pd.Index) -> list[str]:
    """Return the intersection of each ``context_hash`` in ``keys``."""
    first = contexts.drop_duplicates("context_hash")
    return list(first["intersection"].to_numpy(object)[pd.Index(first["context_hash"]).get_indexer(keys)])


def context_matrix(contexts: pd.DataFrame, values: Array) -> pd.DataFrame:
    """Return values ``[N]`` as ``[training seeds, contexts]``, over the contexts that all training seeds have."""
    seeds, labels = pd.factorize(contexts["train_seed"], sort=True)
    columns, keys = pd.factorize(contexts["context_hash"])
    matrix = np.full((len(labels), len(keys)), np.nan)
    matrix[seeds, columns] = values
    known = ~np.isnan(matrix).any(axis=0)
    return pd.DataFrame(matrix[:, known], index=labels, columns=keys[known])


def _contexts(rows: pd.DataFrame) -> pd.DataFrame:
    """Description of each training seed and context of ``rows``."""
    grouped = rows.groupby(CONTEXT, sort=False)
    found = grouped[["context", "intersection"]].first()
    found["saturated"] = grouped["volume_over_capacity"].max() > 1.0
    return found.reset_index()


def _sums(rows: pd.DataFrame, played: pd.DataFrame) -> pd.DataFrame:
    """Add the numbers of ``played``, a row for each of ``rows``, by training seed and context; mean over episode seeds.

    All columns of floating-point numbers are added up; figures read the sums and counts among them.
    """
    sums = played.select_dtypes("float")
    keys = rows.groupby(CONTEXT, sort=False)
    number = keys.ngroup().to_numpy()
    added = np.zeros((keys.ngroups, sums.shape[1]))
    np.add.at(added, number, sums.to_numpy())
    return pd.DataFrame(added / keys["seed"].nunique().to_numpy()[:, None], columns=sums.columns)
