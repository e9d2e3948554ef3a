"""Intervals for a single intersection: over its episode seeds, since there are no other intersections.

They answer: what if other traffic had come to this very intersection, under these very weights? The figure is computed
anew without each episode seed, of the policy and of the baseline at once (the jackknife over paired seeds), and the
interval is Student's. Of a difference of means it is the paired t interval.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd

from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import CONTEXT, by_intersection, pair
from izoo.metrics.statistics import CONFIDENCE, Estimate, student_t_below, student_t_quantile, typical

EPISODE_SEEDS = "episode seeds"
MIN_EPISODE_SEEDS = 5
"""With fewer, no interval is given."""


def over_episode_seeds(table: pd.DataFrame, policy: str, baseline: str, found: dict[str, Estimate]) -> None:
    """Give estimates of a single intersection their intervals over episode seeds.

    Nothing is changed where there are fewer than :data:`MIN_EPISODE_SEEDS`, or where contexts and training seeds were
    not all played with the same ones.

    Args:
        table: rows of that intersection, of one simulator.
        policy, baseline: whose figures are compared.
        found: estimates by figure; changed.
    """
    seeds = table.loc[table["policy"] == policy].groupby(CONTEXT)["seed"].agg(frozenset)
    every = sorted(seeds.iloc[0])
    if len(every) < MIN_EPISODE_SEEDS or seeds.nunique() > 1:
        return
    without = [pair(table[table["seed"] != seed], policy, baseline) for seed in every]
    for name, whole in found.items():
        figure, own = FIGURES[name], []
        for left in without:
            value = by_intersection(left.contexts, figure.value(left.own, left.baseline))[0]
            own.append(float(typical(value)) if value.size else math.nan)
        count = len(own)
        spread = math.sqrt((count - 1) * float(np.var(own)))
        if not spread > 0.0:
            continue
        half = student_t_quantile(0.5 + 0.5 * CONFIDENCE, count - 1) * spread
        found[name] = dataclasses.replace(
            whole,
            low=whole.value - half,
            high=whole.value + half,
            p=2.0 * student_t_below(-abs(whole.value) / spread, count - 1),
            over=EPISODE_SEEDS,
        )
