"""What an evaluation says: benefits per approach, and aggregates with intervals and their n."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from izoo.errors import IzooError, check_choice
from izoo.evaluation.across import compare, counted_intersections, headline_baseline, played_all, policy_rows
from izoo.evaluation.aggregates import TASK
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.metrics import statistics
from izoo.metrics.benefit import PAIR
from izoo.metrics.scores import SCORES, pool

BASELINES = (HUMAN, UNCOMMANDED)


def seeds_per_context(table: pd.DataFrame) -> int:
    """Return how many episode seeds the context with the most of them has; contexts have their own."""
    return int(table.groupby("context_hash")["seed"].nunique().max())


def approach_table(table: pd.DataFrame, policy: str, baseline: str = HUMAN) -> pd.DataFrame:
    """Return the benefit of ``policy`` over ``baseline`` for every approach, with its interval over episode seeds.

    Args:
        table: an evaluation table (:mod:`izoo.evaluation.table`).

    Returns:
        :func:`izoo.evaluation.across.policy_rows`, plus ``low`` and ``high`` of ``benefit_ungated``; NaN with fewer
        than :data:`izoo.metrics.statistics.MIN_EVAL_SEEDS` seeds.
    """
    for name in (policy, baseline):
        check_choice("policy of the evaluation", name, tuple(table["policy"].unique()))
    rows = policy_rows(table, policy, baseline)
    chosen, reference = (table[table["policy"] == name] for name in (policy, baseline))
    return rows.merge(_seed_intervals(chosen, reference), on=TASK, how="left")


def _seed_intervals(chosen: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Return ``low`` and ``high`` of the relative saving of each (context, approach)."""
    columns = [*PAIR, "emission_g", "crossed"]
    both = chosen[columns].merge(reference[columns], on=list(PAIR), suffixes=("_policy", "_baseline"))
    both = both[(both["crossed_policy"] > 0) & (both["crossed_baseline"] > 0)].sort_values(list(PAIR))
    rows = []
    for (context, approach), group in both.groupby(TASK, sort=False):
        policy_g = (group["emission_g_policy"] / group["crossed_policy"]).to_numpy(float)
        baseline_g = (group["emission_g_baseline"] / group["crossed_baseline"]).to_numpy(float)
        found = statistics.paired_saving(policy_g, baseline_g)
        rows.append({"context_hash": context, "approach": approach, "low": found.low, "high": found.high})
    return pd.DataFrame(rows, columns=[*TASK, "low", "high"])


def summarise(table: pd.DataFrame, simulator: str = "sumo") -> dict[str, Any]:
    """Sum up an evaluation; plain values, ready for JSON (missing numbers are ``None``).

    Args:
        table: an evaluation table with rows of human driving.
        simulator: what played the episodes.

    Returns:
        ``simulator``, ``n`` (contexts, intersections, seeds, episodes), ``scores`` per policy (every vehicle weighs
        the same), and under ``policies``, per policy, ``headline`` (the baseline of its main figure: human driving, or
        with electric CVs the uncommanded CV), ``intersections`` (on how many its figures rest, without approaches that
        are left out) and ``against``, per baseline, what :func:`izoo.evaluation.across.compare` returns. Uncommanded
        CVs are a baseline where they played all of a policy's episodes.

    Raises:
        IzooError: no rows of human driving, or unpaired rows.
    """
    names = list(dict.fromkeys(table["policy"]))
    if HUMAN not in names:
        raise IzooError("the evaluation has no rows of human driving; evaluate the baseline too.")
    summary: dict[str, Any] = {"simulator": simulator, "n": _counts(table), "scores": _scores(table), "policies": {}}
    for name in names:
        if name == HUMAN:
            continue
        baselines = [b for b in BASELINES if b != name and (b == HUMAN or played_all(table, b, name))]
        rows = {b: policy_rows(table, name, b) for b in baselines}
        summary["policies"][name] = {
            "headline": headline_baseline(table, name),
            "intersections": counted_intersections(rows[HUMAN]),
            "against": {b: compare(found) for b, found in rows.items()},
        }
    return summary


def _counts(table: pd.DataFrame) -> dict[str, int]:
    episodes = table[["policy", "context_hash", "seed"]].drop_duplicates()
    return {
        "contexts": int(table["context_hash"].nunique()),
        "intersections": int(table["intersection"].nunique()),
        "seeds": seeds_per_context(table),
        "episodes": len(episodes),
    }


def _shared(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of the (context, seed, approach) that every policy has been evaluated on; where there are none, all rows."""
    policies = table.groupby(list(PAIR))["policy"].transform("nunique")
    shared = table[policies == table["policy"].nunique()]
    return shared if len(shared) else table


def _scores(table: pd.DataFrame) -> dict[str, dict[str, float | None]]:
    """Scores of each policy over the rows that all of them have; counts are per episode and approach."""
    scores: dict[str, dict[str, float | None]] = {}
    for _, row in pool(_shared(table), ["policy"]).iterrows():
        values: dict[str, float | None] = {}
        for name, score in SCORES.items():
            value = float(row[name]) / (1.0 if score.denominator else float(row["rows"]))
            values[name] = None if np.isnan(value) else value
        values["objective_g"] = float(row["objective_g"]) / float(row["rows"])
        scores[str(row["policy"])] = values
    return scores
