"""What an entry of a benchmark achieved over its training seeds: rows per approach and seed, and their aggregates.

Two uncertainties are kept apart: other training seeds on the same approaches (rliable's stratified bootstrap), and
other intersections for the same training seeds (bootstrap over intersections of each approach's mean over seeds).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from izoo.evaluation.policies import HUMAN
from izoo.evaluation.summary import STATISTICS
from izoo.metrics import statistics
from izoo.metrics.benefit import GATES, benefits, emission_pairs, ratio_of_sums

RUN, TASK = "train_seed", ("context_hash", "approach")
PAPER_FORM = "best of {n} training seeds, chosen by its ratio of sums on the test set: the paper's form"
THRESHOLDS = tuple(round(-1.0 + 0.02 * k, 2) for k in range(101))
"""Benefits at which performance profiles are given."""


def run_rows(table: pd.DataFrame, policy: str, train_seed: int, baseline: str = HUMAN) -> pd.DataFrame:
    """Return a row per approach of one training seed: :func:`izoo.metrics.benefit.benefits` and ``train_seed``.

    Args:
        table: its evaluation table.
        policy: the entry's name in it.
        baseline: what it is compared with.
    """
    chosen, reference = (table[table["policy"] == name] for name in (policy, baseline))
    rows = benefits(chosen, reference)
    rows.insert(0, RUN, train_seed)
    return rows.sort_values(["context", "approach"], kind="stable").reset_index(drop=True)


def aggregate(rows: pd.DataFrame, seed: int = 0, resamples: int = statistics.RESAMPLES) -> dict[str, Any]:
    """Sum up the rows of all training seeds of one entry; plain values, ready for JSON.

    Args:
        rows: of :func:`run_rows`, one after the other; every training seed has the same approaches.
        seed: of the resampling; the same rows and seed give the same numbers.

    Returns:
        ``n``: how many training seeds, approaches (counted, saturated, left out), intersections and evaluation seeds;
        ``all`` and ``unsaturated``: what :func:`_block` returns; ``best_seed``: the paper's form, labelled as such.
    """
    counted = rows[rows["left_out"] == ""]
    tasks = rows.drop_duplicates(list(TASK))
    n = {
        "train_seeds": int(rows[RUN].nunique()),
        "approaches": int((tasks["left_out"] == "").sum()),
        "saturated": int(((tasks["left_out"] == "") & tasks["saturated"]).sum()),
        "left_out": int((tasks["left_out"] != "").sum()),
        "intersections": int(tasks["intersection"].nunique()),
        "eval_seeds": int(rows["seeds"].min()),
    }
    everything = _block(counted, seed, resamples)
    best = max(everything["per_seed"], key=lambda run: run["exact"]["ratio_of_sums"] or 0.0, default=None)
    return {
        "n": n,
        "all": everything,
        "unsaturated": _block(counted[~counted["saturated"].astype(bool)], seed, resamples),
        "best_seed": None if best is None else {"label": PAPER_FORM.format(n=n["train_seeds"]), **best},
    }


def _block(rows: pd.DataFrame, seed: int, resamples: int) -> dict[str, Any]:
    """Return ``per_seed`` (values of each training seed), and per gate the two kinds of interval.

    ``over_train_seeds`` and ``over_intersections``: per gate (and ``ungated``) the statistics of
    :data:`izoo.evaluation.summary.STATISTICS`, each an estimate with its n; ``share_gated`` over training seeds alone.
    """
    columns = {**{gate: f"benefit_{gate}" for gate in GATES}, "ungated": "benefit_ungated"}
    result: dict[str, Any] = {"per_seed": [_run(part, int(k)) for k, part in rows.groupby(RUN)]}
    result["over_train_seeds"] = {gate: {} for gate in columns}
    result["over_intersections"] = {gate: {} for gate in columns}
    groups = rows.drop_duplicates(list(TASK)).sort_values(list(TASK))["intersection"].tolist()
    for gate, column in columns.items():
        scores = score_matrix(rows, column)
        for name, statistic in STATISTICS.items():
            runs = statistics.stratified_bootstrap(scores, statistic, np.random.default_rng(seed), resamples)
            means = scores.mean(axis=0) if len(scores) else np.empty(0)
            places = statistics.bootstrap(means, statistic, np.random.default_rng(seed), groups, resamples)
            result["over_train_seeds"][gate][name] = runs.to_dict()
            result["over_intersections"][gate][name] = places.to_dict()
        if gate in GATES:
            gated = score_matrix(rows, f"gated_{gate}")
            share = statistics.stratified_bootstrap(gated, statistics.mean, np.random.default_rng(seed), resamples)
            result["over_train_seeds"][gate]["share_gated"] = share.to_dict()
    return result


def score_matrix(rows: pd.DataFrame, column: str) -> statistics.Array:
    """Return a column as ``[training seeds, approaches]``, approaches sorted by context and name."""
    wide = rows.pivot(index=RUN, columns=list(TASK), values=column).sort_index(axis=1)
    return wide.to_numpy(dtype=np.float64)


def _run(rows: pd.DataFrame, train_seed: int) -> dict[str, Any]:
    """Return the plain statistics of one training seed."""
    run: dict[str, Any] = {"seed": train_seed}
    for gate in GATES:
        benefit = rows[f"benefit_{gate}"].to_numpy(float)
        run[gate] = {name: float(statistic(benefit)) for name, statistic in STATISTICS.items()}
        run[gate]["share_gated"] = float(rows[f"gated_{gate}"].astype(float).mean())
        run[gate]["ratio_of_sums"] = float(ratio_of_sums(emission_pairs(rows, gate)))
    flows = rows[["throughput_policy", "throughput_baseline"]].to_numpy(float)
    run["throughput"] = {
        "mean": float(rows["throughput_benefit"].mean()),
        "ratio_of_sums": float(-ratio_of_sums(flows)),
        "share_kept": float((flows[:, 0] >= flows[:, 1]).mean()),
    }
    run["n"] = len(rows)
    return run


def compare_entries(rows: Mapping[str, pd.DataFrame], seed: int = 0, resamples: int = 500) -> dict[str, Any]:
    """Compare entries by their gated benefit (exact gate) on the approaches that all of them have.

    Args:
        rows: per entry, of :func:`run_rows`.

    Returns:
        ``improvement``: for each pair, the probability that a training seed of ``x`` beats one of ``y`` on an approach;
        ``profiles``: ``thresholds``, and per entry the share of (training seed, approach) above each; ``approaches``.
    """
    counted = {name: table[table["left_out"] == ""] for name, table in rows.items()}
    keys = {name: list(table[list(TASK)].itertuples(index=False, name=None)) for name, table in counted.items()}
    shared = set.intersection(*(set(there) for there in keys.values()))
    if not shared:
        return {"improvement": [], "profiles": {}, "approaches": 0}
    scores = {
        name: score_matrix(table[[key in shared for key in keys[name]]], "benefit_exact")
        for name, table in counted.items()
    }
    improvement = []
    for x, y in itertools.permutations(scores, 2):
        estimate = statistics.improvement_estimate(scores[x], scores[y], np.random.default_rng(seed), resamples)
        improvement.append({"x": x, "y": y, **estimate.to_dict()})
    profiles: dict[str, Any] = {"thresholds": list(THRESHOLDS)}
    for name, matrix in scores.items():
        profiles[name] = statistics.performance_profile(matrix, THRESHOLDS).tolist()
    return {"improvement": improvement, "profiles": profiles, "approaches": len(shared)}
