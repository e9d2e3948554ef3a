"""Benefit and its two gates: hand cases, the identical policy, and what pairing is for."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from izoo.errors import IzooError
from izoo.metrics.benefit import benefits, emission_pairs, fall_p_value, ratio_of_sums, student_t_below
from tests.metrics.tables import episode_row, seeds_table


def test_benefit_is_the_comparison_of_means_over_seeds() -> None:
    policy = seeds_table([10, 12, 11], [900.0, 1200.0, 990.0])
    baseline = seeds_table([10, 11, 11], [1000.0, 1320.0, 1100.0])
    row = benefits(policy, baseline).iloc[0]
    expected = 1 - np.mean([90, 100, 90]) / np.mean([100, 120, 100])
    assert row["benefit_exact"] == pytest.approx(expected, abs=1e-15)
    assert row["benefit_tested"] == row["benefit_exact"]
    assert row["throughput_benefit"] == pytest.approx(1 / 32)
    assert row["seeds"] == row["emission_seeds"] == 3
    assert not row["gated_exact"]
    assert not row["gated_tested"]


def test_a_fall_of_throughput_zeroes_the_exact_benefit_and_only_a_clear_one_the_tested() -> None:
    baseline = seeds_table([100, 100, 100], [1e4] * 3)
    unclear = benefits(seeds_table([100, 99, 100], [5e3] * 3), baseline).iloc[0]
    assert unclear["gated_exact"]
    assert unclear["benefit_exact"] == 0.0
    assert not unclear["gated_tested"]
    assert unclear["benefit_tested"] > 0.4
    clear = benefits(seeds_table([90, 91, 89], [5e3] * 3), baseline).iloc[0]
    assert clear["gated_tested"]
    assert clear["benefit_tested"] == 0.0


def test_a_loss_is_zeroed_by_the_gate_too() -> None:
    row = benefits(seeds_table([9, 9, 9], [2e3] * 3), seeds_table([10, 10, 10], [1e3] * 3)).iloc[0]
    assert row["benefit_ungated"] < -1.0
    assert row["benefit_exact"] == 0.0


def test_identical_policy_has_exactly_no_benefit_and_passes_both_gates() -> None:
    generator = np.random.default_rng(1)
    tables = [
        seeds_table(list(generator.poisson(80, 3)), list(generator.normal(1e4, 300, 3)), context=f"x/{k}/A")
        for k in range(50)
    ]
    table = pd.concat(tables, ignore_index=True)
    result = benefits(table, table)
    assert (result["benefit_exact"] == 0.0).all()
    assert (result["benefit_tested"] == 0.0).all()
    assert not result["gated_exact"].any()
    assert not result["gated_tested"].any()
    assert ratio_of_sums(emission_pairs(result, "exact")) == 0.0


def test_an_unpaired_comparison_fails_the_exact_gate_about_half_the_time() -> None:
    """The same driver twice, but with other arrivals: what the released evaluation did."""
    generator = np.random.default_rng(2)

    def run() -> pd.DataFrame:
        tables = [seeds_table(list(generator.poisson(80, 3)), [1e4] * 3, context=f"x/{k}/A") for k in range(400)]
        return pd.concat(tables, ignore_index=True)

    result = benefits(run(), run())
    assert 0.4 < result["gated_exact"].mean() < 0.6
    assert result["gated_tested"].mean() < 0.1


def test_with_all_approach_demand_one_fall_zeroes_the_whole_intersection_and_no_other() -> None:
    def table(crossed: dict[tuple[str, str], int]) -> pd.DataFrame:
        rows = [
            episode_row(n, 100.0 * n - 10.0 * (n - 9), context=c, approach=a, seed=s, demand="all")
            for (c, a), n in crossed.items()
            for s in range(3)
        ]
        return pd.DataFrame(rows)

    baseline = table({("x/1", "A"): 10, ("x/1", "B"): 10, ("x/2", "A"): 10})
    policy = table({("x/1", "A"): 9, ("x/1", "B"): 11, ("x/2", "A"): 11})
    result = benefits(policy, baseline).set_index(["context", "approach"])
    assert result.loc[("x/1", "A"), "gated_exact"]
    assert result.loc[("x/1", "B"), "gated_exact"]
    assert result.loc[("x/1", "B"), "benefit_exact"] == 0.0
    assert not result.loc[("x/2", "A"), "gated_exact"]
    alone = benefits(policy.assign(demand="one"), baseline.assign(demand="one")).set_index(["context", "approach"])
    assert not alone.loc[("x/1", "B"), "gated_exact"]


def test_approaches_without_traffic_are_left_out_and_say_why() -> None:
    policy = pd.concat([seeds_table([0, 0], [0.0, 0.0]), seeds_table([5, 0], [500.0, 0.0], context="x/2/A")])
    baseline = pd.concat([seeds_table([0, 0], [0.0, 0.0]), seeds_table([5, 0], [600.0, 0.0], context="x/2/A")])
    empty, quiet = (row for _, row in benefits(policy, baseline).iterrows())
    assert empty["left_out"] == "no traffic"
    assert np.isnan(empty["benefit_exact"])
    assert quiet["left_out"] == ""
    assert quiet["emission_seeds"] == 1
    assert quiet["benefit_exact"] == pytest.approx(1 / 6)


def test_a_baseline_that_lets_nobody_cross_is_left_out() -> None:
    stuck = seeds_table([0, 0], [0.0, 0.0], entered=7, waiting=3)
    row = benefits(stuck, stuck).iloc[0]
    assert row["left_out"] == "nobody crossed"
    assert row["saturated"]


def test_a_policy_that_stops_everyone_has_no_benefit_under_either_gate() -> None:
    result = benefits(seeds_table([0, 0], [0.0, 0.0], entered=3), seeds_table([1, 0], [100.0, 0.0]))
    row = result.iloc[0]
    assert row["benefit_exact"] == row["benefit_tested"] == 0.0
    assert ratio_of_sums(emission_pairs(result, "tested")) == 0.0


def test_the_ratio_of_sums_counts_the_baseline_of_an_approach_that_the_policy_blocks() -> None:
    baseline = pd.concat([seeds_table([10], [1000.0]), seeds_table([10], [1000.0], context="x/2/A")])
    for crossed in (0, 1):
        blocked = seeds_table([crossed], [90.0 * crossed], context="x/2/A")
        result = benefits(pd.concat([seeds_table([10], [800.0]), blocked]), baseline)
        assert ratio_of_sums(emission_pairs(result, "exact")) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("settings", "saturated"),
    [
        ({}, False),
        ({"waiting": 1.0}, True),
        ({"volume_over_capacity": 1.01}, True),
        ({"volume_over_capacity": np.nan}, False),
    ],
)
def test_saturation(settings: dict[str, float], saturated: bool) -> None:
    baseline = seeds_table([10, 10, 10], [1e3] * 3, **settings)
    assert benefits(baseline, baseline)["saturated"].tolist() == [saturated]


def test_waiting_under_the_policy_alone_is_not_saturation() -> None:
    baseline = seeds_table([10, 10, 10], [1e3] * 3)
    assert not benefits(seeds_table([10, 10, 10], [1e3] * 3, waiting=4), baseline)["saturated"].any()


def test_ratio_of_sums_takes_the_baseline_of_gated_approaches() -> None:
    policy = pd.concat([seeds_table([10], [500.0]), seeds_table([9], [90.0], context="x/2/A")])
    baseline = pd.concat([seeds_table([10], [1000.0]), seeds_table([10], [3000.0], context="x/2/A")])
    assert ratio_of_sums(emission_pairs(benefits(policy, baseline), "exact")) == pytest.approx(1 - (50 + 300) / 400)


def test_a_missing_baseline_and_a_repeated_row_are_refused() -> None:
    policy = seeds_table([10, 10], [1e3] * 2)
    with pytest.raises(IzooError, match=r"1 row\(s\) have no baseline.*seed 1"):
        benefits(policy, seeds_table([10], [1e3]))
    with pytest.raises(IzooError, match="twice"):
        benefits(policy, pd.concat([policy, policy]))


@pytest.mark.parametrize(
    ("degrees", "t", "below"),
    # Quantiles of Student's t as printed in any table (Abramowitz and Stegun, table 26.10).
    [(1, 6.314, 0.95), (2, 2.920, 0.95), (2, 4.303, 0.975), (3, 2.353, 0.95), (9, 1.833, 0.95), (30, 1.697, 0.95)],
)
def test_student_t_agrees_with_the_printed_table(degrees: int, t: float, below: float) -> None:
    assert student_t_below(t, degrees) == pytest.approx(below, abs=2e-4)
    assert student_t_below(-t, degrees) == pytest.approx(1 - below, abs=2e-4)
    assert student_t_below(0.0, degrees) == pytest.approx(0.5)


@pytest.mark.parametrize(("difference", "p"), [([0, 0, 0], 1.0), ([-1, -1, -1], 0.0), ([-1], 0.0), ([2], 1.0)])
def test_no_variance_means_comparison_for_equality(difference: list[float], p: float) -> None:
    assert fall_p_value(difference) == p
