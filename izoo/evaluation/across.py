"""What an entry of a benchmark achieved over its training seeds: rows per approach and seed, and their aggregates.

A training seed is one policy on all approaches. Every figure is a mean over training seeds, and its interval is over
other intersections and, from four training seeds on, over other training seeds as well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from izoo.evaluation.aggregates import OVER_UNCOMMANDED, RUN, TASK, estimates, plain_figures, score_matrix
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.metrics import statistics
from izoo.metrics.benefit import FORMS, PAIR, benefits

PAPER_FORM = "best of {n} training seeds, chosen by its ratio of sums on the test set: the paper's form"
THRESHOLDS = tuple(round(-1.0 + 0.01 * k, 2) for k in range(201))
"""Benefits at which performance profiles are given."""


def policy_rows(table: pd.DataFrame, policy: str, baseline: str = HUMAN) -> pd.DataFrame:
    """Return a row per approach: :func:`izoo.metrics.benefit.benefits` over ``baseline``, sorted by context.

    Where the uncommanded CV played all of the policy's episodes, and neither policy nor baseline is that one, the
    columns :data:`izoo.evaluation.aggregates.OVER_UNCOMMANDED` say what the policy saved of its emission.

    Args:
        table: an evaluation table, or one of several training seeds.
        policy: its name in it.
    """
    chosen = table[table["policy"] == policy]
    rows = benefits(chosen, _matching(table, baseline, chosen))
    if UNCOMMANDED not in (policy, baseline) and played_all(table, UNCOMMANDED, policy):
        over = benefits(chosen, _matching(table, UNCOMMANDED, chosen))
        names = {f"benefit_{form}ungated": OVER_UNCOMMANDED.format(form=form) for form in FORMS}
        rows = rows.merge(over[[*TASK, *names]].rename(columns=names), on=TASK)
    return rows.sort_values(["context", "approach"], kind="stable").reset_index(drop=True)


def played_all(table: pd.DataFrame, baseline: str, policy: str) -> bool:
    """Return whether a baseline has a row for each row of a policy."""
    chosen = table[table["policy"] == policy]
    return len(_matching(table, baseline, chosen)) == len(chosen)


def drives_electric(table: pd.DataFrame, policy: str) -> bool:
    """Return whether a policy drives electric CVs, whose engine saves most of what they save over human driving."""
    return bool((table.loc[table["policy"] == policy, "engine"] == "electric").any())


def headline_baseline(table: pd.DataFrame, policy: str) -> str:
    """Return what a policy's main figure is over: human driving, or with electric CVs uncommanded ones."""
    electric = drives_electric(table, policy)
    return UNCOMMANDED if electric and policy != UNCOMMANDED and played_all(table, UNCOMMANDED, policy) else HUMAN


def run_rows(table: pd.DataFrame, policy: str, train_seed: int, baseline: str = HUMAN) -> pd.DataFrame:
    """Return :func:`policy_rows` of one training seed, with its column ``train_seed``."""
    rows = policy_rows(table, policy, baseline)
    rows.insert(0, RUN, train_seed)
    return rows


def _matching(table: pd.DataFrame, baseline: str, chosen: pd.DataFrame) -> pd.DataFrame:
    """Rows of a baseline that ``chosen`` has a partner for."""
    return table[table["policy"] == baseline].merge(chosen[list(PAIR)], on=list(PAIR), how="inner")


def compare(rows: pd.DataFrame) -> dict[str, Any]:
    """Aggregate the benefits of a policy over approaches, and over training seeds where there are several.

    Args:
        rows: of :func:`policy_rows`, or of :func:`run_rows`, one training seed after the other.

    Returns:
        ``all`` and ``unsaturated`` (without the flagged approaches), each with what
        :func:`izoo.evaluation.aggregates.estimates` returns; ``saturated`` and ``left_out``: which approaches they are.
    """
    counted = rows[rows["left_out"] == ""]
    blocks = {"all": counted, "unsaturated": counted[~counted["saturated"].astype(bool)]}
    tasks = rows.drop_duplicates(TASK)
    saturated = tasks[(tasks["left_out"] == "") & tasks["saturated"].astype(bool)]
    left_out = tasks[tasks["left_out"] != ""]
    return {
        **{name: estimates(part) for name, part in blocks.items()},
        "saturated": [f"{row.context} {row.approach}" for row in saturated.itertuples()],
        "left_out": [f"{row.context} {row.approach}: {row.left_out}" for row in left_out.itertuples()],
    }


def aggregate(rows: pd.DataFrame) -> dict[str, Any]:
    """Sum up the rows of all training seeds of one entry; plain values, ready for JSON.

    Args:
        rows: of :func:`run_rows`, one after the other.

    Returns:
        ``n``: how many training seeds, approaches (counted, saturated, left out), intersections and evaluation seeds;
        what :func:`compare` returns; ``per_seed``: every figure of each training seed; ``best_seed``: the paper's form,
        labelled as such.
    """
    compared = compare(rows)
    tasks = rows.drop_duplicates(TASK)
    parts = [(int(seed), part[part["left_out"] == ""]) for seed, part in rows.groupby(RUN)]
    per_seed: list[dict[str, Any]] = [
        {"seed": seed, **_without_nan(plain_figures(part)), "n": len(part)} for seed, part in parts if len(part)
    ]
    best = max(per_seed, key=lambda run: run["exact"]["ratio_of_sums"], default=None)
    n = {
        "train_seeds": len(parts),
        "approaches": int((tasks["left_out"] == "").sum()),
        "saturated": len(compared["saturated"]),
        "left_out": len(compared["left_out"]),
        "intersections": counted_intersections(rows),
        "eval_seeds": int(rows["seeds"].min()),
    }
    label = PAPER_FORM.format(n=len(parts))
    return {"n": n, **compared, "per_seed": per_seed, "best_seed": best and {"label": label, **best}}


def _without_nan(figures: dict[str, dict[str, float]]) -> dict[str, dict[str, float | None]]:
    return {
        part: {name: None if math.isnan(value) else value for name, value in named.items()}
        for part, named in figures.items()
    }


def counted_intersections(rows: pd.DataFrame) -> int:
    """Return on how many intersections figures of :func:`policy_rows` rest: without approaches that are left out."""
    return int(rows.loc[rows["left_out"] == "", "intersection"].nunique())


def improvement(x: pd.DataFrame, y: pd.DataFrame) -> statistics.Estimate | None:
    """Return the probability that a training seed of X has more benefit (exact gate) on an approach than one of Y.

    Ties count one half. ``None`` without common approaches.

    Args:
        x, y: of :func:`run_rows`, one training seed after the other.
    """
    a, b = _scores(x), _scores(y)
    tasks = a.columns.intersection(b.columns)
    if tasks.empty:
        return None
    places = x.drop_duplicates(TASK).set_index(TASK)["intersection"]
    return statistics.improvement(a[tasks].to_numpy(), b[tasks].to_numpy(), places.loc[tasks].tolist())


def profile(rows: pd.DataFrame) -> np.ndarray:
    """Share of (training seed, approach) with a benefit above each of :data:`THRESHOLDS`; empty without approaches."""
    values = _scores(rows).to_numpy()
    return statistics.performance_profile(values, THRESHOLDS) if values.size else np.empty(0)


def _scores(rows: pd.DataFrame) -> pd.DataFrame:
    return score_matrix(rows[rows["left_out"] == ""], "benefit_exact")


def compare_entries(rows: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Compare entries by their gated benefit (exact gate) on the approaches that all of them have.

    Args:
        rows: per entry, of :func:`run_rows`.

    Returns:
        ``improvement``: for each pair, the probability that a training seed of ``x`` beats one of ``y`` on an approach;
        ``profiles``: ``thresholds``, and per entry the share of (training seed, approach) above each; ``approaches``.
    """
    keys = {name: set(_scores(table).columns) for name, table in rows.items()}
    shared = set.intersection(*keys.values())
    if not shared:
        return {"improvement": [], "profiles": {}, "approaches": 0}
    common = {
        name: table[[key in shared for key in table[TASK].itertuples(index=False, name=None)]]
        for name, table in rows.items()
    }
    found = []
    for x, y in itertools.permutations(common, 2):
        estimate = improvement(common[x], common[y])
        found.append({"x": x, "y": y, **(estimate.to_dict() if estimate else {})})
    profiles = {"thresholds": list(THRESHOLDS), **{name: profile(table).tolist() for name, table in common.items()}}
    return {"improvement": found, "profiles": profiles, "approaches": len(shared)}
