"""The paper's form: its exact gate, what is left out, and its aggregates, by hand."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest

from izoo.metrics.paper_form import paper_form
from tests.metrics.tables import episode_row


def rows_of(policy: str, crossed: Sequence[int], emission_g: Sequence[float], **settings: object) -> list[dict]:
    """One approach over ``len(crossed)`` episode seeds."""
    return [
        episode_row(policy=policy, seed=k, **{"entered": n, **settings, "crossed": n, "emission_g": grams})  # type: ignore[arg-type]
        for k, (n, grams) in enumerate(zip(crossed, emission_g, strict=True))
    ]


def both(own: tuple[Sequence[int], Sequence[float]], human: tuple[Sequence[int], Sequence[float]], **settings: object):  # type: ignore[no-untyped-def]
    """The paper's form of one approach: its row and the aggregates."""
    table = pd.DataFrame([*rows_of("ppo", *own, **settings), *rows_of("human", *human, **settings)])
    rows, aggregates = paper_form(table, "ppo")
    return rows.iloc[0], aggregates


def test_the_benefit_compares_means_over_episode_seeds() -> None:
    row, found = both(([10, 12, 11], [900.0, 1200.0, 990.0]), ([10, 11, 11], [1000.0, 1320.0, 1100.0]))
    expected = 1 - np.mean([90, 100, 90]) / np.mean([100, 120, 100])
    assert row["benefit"] == pytest.approx(expected) and not row["gated"]
    assert row["throughput_benefit"] == pytest.approx(1 / 32)
    assert found["ratio_of_sums"] == found["best_ratio_of_sums"] == pytest.approx(expected)
    assert (found["train_seeds"], found["share_kept"]) == (1, 1.0)


def test_one_vehicle_at_the_horizon_closes_the_gate() -> None:
    row, found = both(([100, 99, 100], [5e3, 4950.0, 5e3]), ([100] * 3, [1e4] * 3))
    assert row["benefit_ungated"] == pytest.approx(0.5)
    assert row["gated"] and row["benefit"] == 0.0
    assert found["ratio_of_sums"] == 0.0 and found["share_gated"] == 1.0 and found["share_kept"] == 0.0


def test_a_loss_is_zeroed_by_the_gate_too() -> None:
    row, _ = both(([9] * 3, [2e3] * 3), ([10] * 3, [1e3] * 3))
    assert row["benefit_ungated"] < -1.0 and row["benefit"] == 0.0


def test_with_demand_from_all_approaches_one_fall_zeroes_the_whole_intersection_and_no_other() -> None:
    def table(demand: str) -> pd.DataFrame:
        rows = []
        for context, approach, n in (("x/1", "A", 9), ("x/1", "B", 11), ("x/2", "A", 11)):
            place = {"context": context, "approach": approach, "demand": demand}
            rows += rows_of("ppo", [n], [90.0 * n], **place) + rows_of("human", [10], [1e3], **place)
        return pd.DataFrame(rows)

    for demand, gated in (("all", [True, True, False]), ("one", [True, False, False])):
        found, aggregates = paper_form(table(demand), "ppo")
        assert found["gated"].tolist() == gated and found["fell"].tolist() == [True, False, False]
        assert aggregates["closed_by"] == (["x/1: A (9.0 vehicles, not 10.0)"] if demand == "all" else [])


def test_approaches_without_a_figure_say_why() -> None:
    for own, human, entered, why in ((0, 0, 0, "no traffic"), (0, 0, 7, "nobody crossed"), (3, 0, 3, "nobody crossed")):
        row, found = both(([own], [100.0 * own]), ([human], [0.0]), entered=entered)
        assert row["left_out"] == why and np.isnan(row["benefit"])
        assert found["best_ratio_of_sums"] is None


def test_a_policy_that_lets_nobody_cross_has_no_benefit_and_counts_with_the_baselines_emission() -> None:
    rows = []
    for context, own in (("x/1/A", ([10], [800.0])), ("x/2/A", ([0], [0.0]))):
        rows += rows_of("ppo", *own, context=context, entered=10) + rows_of("human", [10], [1e3], context=context)
    found, aggregates = paper_form(pd.DataFrame(rows), "ppo")
    assert found["benefit"].tolist() == pytest.approx([0.2, 0.0])
    assert aggregates["ratio_of_sums"] == pytest.approx(0.1)
    assert aggregates["mean"] == pytest.approx(0.1)


def test_figures_are_averaged_over_training_seeds_and_the_best_is_said() -> None:
    rows = rows_of("human", [10], [1e3])
    for seed, grams in enumerate((900.0, 700.0)):
        rows += rows_of("ppo", [10], [grams], train_seed=seed)
    found, aggregates = paper_form(pd.DataFrame(rows), "ppo")
    assert len(found) == 2 and aggregates["train_seeds"] == 2
    assert aggregates["mean"] == pytest.approx(0.2) and aggregates["best_ratio_of_sums"] == pytest.approx(0.3)
