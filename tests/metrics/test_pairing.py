"""Pairing: which episodes are compared, and what a context's sums are."""

import pandas as pd
import pytest

from izoo.errors import IzooError
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import by_intersection, pair
from tests.metrics.tables import compared, episode_row


def test_approaches_are_added_and_episode_seeds_averaged() -> None:
    rows = [
        episode_row(co2_g, policy=policy, context="x/1", approach=approach, seed=seed, cohort=cohort)
        for policy, scale in (("ppo", 0.9), ("uncommanded", 1.0))
        for seed, grams in ((3, 100.0), (4, 140.0))
        for approach, cohort, co2_g in (("A", 30.0, scale * grams), ("B", 10.0, scale * 2.0 * grams))
    ]
    found = pair(pd.DataFrame(rows), "ppo", "uncommanded")
    assert len(found.own) == 1 and found.own["cohort"][0] == 40.0
    burned = 0.5 * (30 * 100 + 10 * 200 + 30 * 140 + 10 * 280)
    assert found.baseline["cohort_region_co2_g"][0] + found.baseline["cohort_blocked_co2_g"][0] == pytest.approx(burned)
    assert FIGURES["co2_saved"].value(found.own, found.baseline)[0] == pytest.approx(10.0)


def test_each_training_seed_is_compared_in_its_own_episodes() -> None:
    rows = [episode_row(100.0 + seed, policy="human", seed=seed) for seed in range(4)]
    rows += [episode_row(0.5 * (100.0 + seed), train_seed=seed, seed=seed) for seed in range(4)]
    found = pair(pd.DataFrame(rows), "ppo", "human")
    assert found.contexts["train_seed"].tolist() == [0, 1, 2, 3]
    assert FIGURES["co2_saved"].value(found.own, found.baseline) == pytest.approx([50.0] * 4)


def test_contexts_are_pooled_by_intersection_where_all_training_seeds_have_them() -> None:
    keys = [("x/1/A", 10.0), ("x/1/B", 30.0), ("x/2/A", 5.0)]
    rows = [
        episode_row(100.0 - saved, policy=policy, context=context, train_seed=seed)
        for context, saving in keys
        for policy, saved, seeds in (("human", 0.0, (0,)), ("ppo", saving, (0, 1)))
        for seed in seeds
        if (context, seed) != ("x/2/A", 1)
    ]
    found = pair(pd.DataFrame(rows), "ppo", "human")
    values, n = by_intersection(found.contexts, FIGURES["co2_saved"].value(found.own, found.baseline))
    assert n == 2, "one training seed lacks x/2/A"
    assert values == pytest.approx(pd.DataFrame([[20.0], [20.0]]).to_numpy())


def test_episodes_that_a_baseline_lacks_are_one_sentence() -> None:
    table = compared({"ppo": [1.0] * 3})
    lacking = table[(table["policy"] != "human") | (table["context"] != "x/1/A")]
    with pytest.raises(IzooError, match=r"^human lacks 1 episode\(s\) of ppo \(the first: context x/1/A, seed 0\);"):
        pair(lacking, "ppo", "human")


def test_baseline_rows_that_two_tables_share_count_once() -> None:
    table = compared({"ppo": [1.0] * 3})
    again = pd.concat([table, table[table["policy"] == "human"]], ignore_index=True)
    assert pair(again, "ppo", "human").baseline["cohort"].tolist() == [10.0] * 3
