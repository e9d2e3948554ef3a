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

from izoo.evaluation.aggregates import SCORES, TASK, aggregates, over_intersections, over_train_seeds, plain
from izoo.evaluation.policies import HUMAN
from izoo.metrics import statistics
from izoo.metrics.benefit import benefits

RUN = "train_seed"
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
    tasks = rows.drop_duplicates(TASK)
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
    """Return ``per_seed``: all figures of each training seed; and their :data:`SCORES` with the two kinds of interval.

    ``over_train_seeds`` pools all training seeds; ``over_intersections`` is of each approach's mean over them.
    """
    rows = rows.sort_values([RUN, *TASK], kind="stable")
    parts = {int(k): part for k, part in rows.groupby(RUN)}
    runs = max(len(parts), 1)
    return {
        "per_seed": [{"seed": k, **aggregates(part, plain), "n": len(part)} for k, part in parts.items()],
        "over_train_seeds": aggregates(rows, over_train_seeds(runs, seed, resamples), SCORES),
        "over_intersections": aggregates(rows, over_intersections(rows, seed, resamples, runs), SCORES),
    }


def score_matrix(rows: pd.DataFrame, column: str) -> statistics.Array:
    """Return a column as ``[training seeds, approaches]``, approaches sorted by context and name."""
    wide = rows.pivot(index=RUN, columns=TASK, values=column).sort_index(axis=1)
    return wide.to_numpy(dtype=np.float64)


def compare_entries(rows: Mapping[str, pd.DataFrame], seed: int = 0, resamples: int = 500) -> dict[str, Any]:
    """Compare entries by their gated benefit (exact gate) on the approaches that all of them have.

    Args:
        rows: per entry, of :func:`run_rows`.

    Returns:
        ``improvement``: for each pair, the probability that a training seed of ``x`` beats one of ``y`` on an approach;
        ``profiles``: ``thresholds``, and per entry the share of (training seed, approach) above each; ``approaches``.
    """
    counted = {name: table[table["left_out"] == ""] for name, table in rows.items()}
    keys = {name: list(table[TASK].itertuples(index=False, name=None)) for name, table in counted.items()}
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
