"""Intervals of a single intersection: the paired t of its episode seeds, and said to be that."""

import numpy as np
import pandas as pd
import pytest

from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import pair
from izoo.metrics.statistics import estimate, student_t_quantile
from izoo.metrics.summary import EPISODE_SEEDS, MIN_EPISODE_SEEDS, over_episode_seeds, summarise
from izoo.report.tables import counts
from tests.metrics.tables import episode_row


def played(generator: np.random.Generator, seeds: int, saved: float = 0.05, places: int = 1) -> pd.DataFrame:
    """Episodes of one policy whose traffic differs much between seeds, and its savings little."""
    rows = []
    for place in range(places):
        for seed in range(seeds):
            co2_g, delay_s = generator.lognormal(5.0, 0.3), generator.lognormal(3.0, 0.5)
            for policy in ("human", "uncommanded", "ppo"):
                own = (1.0 - saved + generator.normal(0.0, 0.02), generator.normal(-1.0, 1.0))
                of = (co2_g * own[0], delay_s + own[1]) if policy == "ppo" else (co2_g, delay_s)
                rows.append(episode_row(*of, policy=policy, seed=seed, context=f"x/{place}/A"))
    return pd.DataFrame(rows)


def test_the_interval_of_delay_is_the_paired_t_of_the_seeds() -> None:
    table = played(np.random.default_rng(1), 8)
    summary = summarise(table)
    found = summary["entries"]["ppo"]["against"]["uncommanded"]["unsaturated"]["figures"]["delay_change_s"]
    table["delay"] = table["cohort_region_delay_s"] + table["cohort_blocked_s"]
    sums = table.pivot(index="seed", columns="policy", values="delay")
    apart = (sums["ppo"] - sums["uncommanded"]) / 10.0
    half = student_t_quantile(0.975, 7) * apart.std(ddof=1) / np.sqrt(8)
    assert (found["low"], found["high"]) == pytest.approx((apart.mean() - half, apart.mean() + half))
    assert found["over"] == EPISODE_SEEDS
    assert "over its episode seeds" in summary["verdict"] and "8 episode seeds of this intersection" in counts(summary)


def test_there_is_none_with_few_seeds_two_intersections_or_other_episodes_for_each_training_seed() -> None:
    trained = [played(np.random.default_rng(k), 8).assign(train_seed=k) for k in range(2)]
    trained[1]["seed"] += 100
    few, places = ((MIN_EPISODE_SEEDS - 1, 1), (8, 2))
    tables = [played(np.random.default_rng(1), seeds, places=count) for seeds, count in (few, places)]
    for table in (*tables, pd.concat(trained)):
        found = summarise(table)["entries"]["ppo"]["against"]["uncommanded"]["unsaturated"]["figures"]
        assert {each["low"] for each in found.values()} == {None}


def test_intervals_hold() -> None:
    generator, held, runs = np.random.default_rng(3), 0, 60
    for _ in range(runs):
        table = played(generator, 5)
        paired = pair(table, "ppo", "uncommanded")
        saved = FIGURES["co2_saved"].value(paired.own, paired.baseline)
        found = {"co2_saved": estimate(saved[None])}
        over_episode_seeds(table, "ppo", "uncommanded", found)
        held += found["co2_saved"].low <= 5.0 <= found["co2_saved"].high
    assert held >= 0.9 * runs
