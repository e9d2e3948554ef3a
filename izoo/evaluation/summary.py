"""What an evaluation says: benefits per approach, and aggregates with intervals and their n."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from izoo.errors import IzooError, check_choice
from izoo.evaluation.aggregates import aggregates, over_intersections
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.metrics import statistics
from izoo.metrics.benefit import PAIR, benefits
from izoo.metrics.scores import SCORES, pool

BASELINES = (HUMAN, UNCOMMANDED)


def approach_table(
    table: pd.DataFrame, policy: str, baseline: str = HUMAN, seed: int = 0, resamples: int = statistics.RESAMPLES
) -> pd.DataFrame:
    """Return the benefit of ``policy`` over ``baseline`` for every approach, with its interval over seeds.

    Args:
        table: an evaluation table (:mod:`izoo.evaluation.table`).
        seed: of the resampling.

    Returns:
        :func:`izoo.metrics.benefit.benefits`, plus ``low`` and ``high`` of ``benefit_ungated`` (paired bootstrap
        over seeds), sorted by context and approach.
    """
    for name in (policy, baseline):
        check_choice("policy of the evaluation", name, tuple(table["policy"].unique()))
    chosen, reference = (table[table["policy"] == name] for name in (policy, baseline))
    result = benefits(chosen, _matching(reference, chosen))
    intervals = _seed_intervals(chosen, reference, np.random.default_rng(seed), resamples)
    result = result.merge(intervals, on=["context_hash", "approach"], how="left")
    return result.sort_values(["context", "approach"], kind="stable").reset_index(drop=True)


def _matching(reference: pd.DataFrame, chosen: pd.DataFrame) -> pd.DataFrame:
    """Rows of ``reference`` that ``chosen`` has a partner for."""
    return reference.merge(chosen[list(PAIR)], on=list(PAIR), how="inner")


def _seed_intervals(
    chosen: pd.DataFrame, reference: pd.DataFrame, generator: np.random.Generator, resamples: int
) -> pd.DataFrame:
    """Return ``low`` and ``high`` of the relative saving of each (context, approach)."""
    columns = [*PAIR, "emission_g", "crossed"]
    both = chosen[columns].merge(reference[columns], on=list(PAIR), suffixes=("_policy", "_baseline"))
    both = both[(both["crossed_policy"] > 0) & (both["crossed_baseline"] > 0)].sort_values(list(PAIR))
    rows = []
    for (context, approach), group in both.groupby(["context_hash", "approach"], sort=False):
        policy_g = (group["emission_g_policy"] / group["crossed_policy"]).to_numpy(float)
        baseline_g = (group["emission_g_baseline"] / group["crossed_baseline"]).to_numpy(float)
        known = baseline_g.sum() > 0.0
        estimate = statistics.paired_bootstrap(
            policy_g if known else baseline_g + 1.0,
            baseline_g if known else baseline_g + 1.0,
            statistics.relative_saving,
            generator,
            resamples,
        )
        rows.append({"context_hash": context, "approach": approach, "low": estimate.low, "high": estimate.high})
    return pd.DataFrame(rows, columns=["context_hash", "approach", "low", "high"])


def summarise(table: pd.DataFrame, seed: int = 0, resamples: int = statistics.RESAMPLES) -> dict[str, Any]:
    """Sum up an evaluation; plain values, ready for JSON (missing numbers are ``None``).

    Args:
        table: an evaluation table with rows of human driving.
        seed: of the resampling; the same table and seed give the same numbers.

    Returns:
        ``n`` (contexts, intersections, seeds, episodes), ``scores`` per policy (every vehicle weighs the same), and
        under ``policies``, per policy, ``headline`` (the baseline of its main figure: human driving, or with electric
        CVs the uncommanded CV) and ``against``, per baseline, what :func:`compare` returns.

    Raises:
        IzooError: no rows of human driving, or unpaired rows.
    """
    names = list(dict.fromkeys(table["policy"]))
    if HUMAN not in names:
        raise IzooError("the evaluation has no rows of human driving; evaluate the baseline too.")
    summary: dict[str, Any] = {"n": _counts(table), "scores": _scores(table), "policies": {}}
    for name in names:
        if name == HUMAN:
            continue
        baselines = [b for b in BASELINES if b in names and b != name]
        electric = bool((table.loc[table["policy"] == name, "engine"] == "electric").any())
        headline = UNCOMMANDED if electric and UNCOMMANDED in baselines else HUMAN
        against = {b: compare(approach_table(table, name, b, seed, resamples), seed, resamples) for b in baselines}
        summary["policies"][name] = {"headline": headline, "against": against}
    return summary


def compare(table: pd.DataFrame, seed: int = 0, resamples: int = statistics.RESAMPLES) -> dict[str, Any]:
    """Aggregate the benefits of a policy over approaches.

    Args:
        table: from :func:`approach_table`.

    Returns:
        ``all`` and ``unsaturated`` (without the flagged approaches), each with the estimates of
        :func:`izoo.evaluation.aggregates.aggregates` over other intersections; ``saturated`` and ``left_out``: which
        approaches those are.
    """
    counted = table[table["left_out"] == ""]
    left_out = table[table["left_out"] != ""]
    saturated = counted[counted["saturated"]]
    blocks = {"all": counted, "unsaturated": counted[~counted["saturated"]]}
    return {
        **{name: aggregates(rows, over_intersections(rows, seed, resamples)) for name, rows in blocks.items()},
        "saturated": [f"{row.context} {row.approach}" for row in saturated.itertuples()],
        "left_out": [f"{row.context} {row.approach}: {row.left_out}" for row in left_out.itertuples()],
    }


def _counts(table: pd.DataFrame) -> dict[str, int]:
    episodes = table[["policy", "context_hash", "seed"]].drop_duplicates()
    return {
        "contexts": int(table["context_hash"].nunique()),
        "intersections": int(table["intersection"].nunique()),
        "seeds": int(table["seed"].nunique()),
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
            value = float(row[name]) / (float(row["rows"]) if score.denominator is None else 1.0)
            values[name] = None if np.isnan(value) else value
        values["objective_g"] = float(row["objective_g"]) / float(row["rows"])
        scores[str(row["policy"])] = values
    return scores
