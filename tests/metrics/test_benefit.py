"""Benefit and its two gates: hand cases, the identical policy, and what pairing is for."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from izoo.errors import IzooError
from izoo.metrics.benefit import MARGIN, benefits, emission_pairs, not_inferior_p_value, ratio_of_sums
from tests.metrics.tables import episode_row, seeds_table


def test_benefit_is_the_comparison_of_means_over_seeds() -> None:
    policy = seeds_table([10, 12, 11], [900.0, 1200.0, 990.0])
    baseline = seeds_table([10, 11, 11], [1000.0, 1320.0, 1100.0])
    row = benefits(policy, baseline).iloc[0]
    expected = 1 - np.mean([90, 100, 90]) / np.mean([100, 120, 100])
    assert row["benefit_exact"] == pytest.approx(expected, abs=1e-15)
    assert row["gated_tested"]  # one of ten vehicles more in one of three seeds rules out no loss of 2 %
    assert row["throughput_benefit"] == pytest.approx(1 / 32)
    assert row["seeds"] == row["emission_seeds"] == 3
    assert not row["gated_exact"]


def test_one_vehicle_at_the_horizon_closes_the_exact_gate_and_not_the_tested() -> None:
    """Of 300 vehicles one crosses half a second after the end of its episode: a saving of half the CO2 is then 0."""
    baseline = seeds_table([100, 100, 100], [1e4] * 3)
    row = benefits(seeds_table([100, 99, 100], [5e3, 4950.0, 5e3]), baseline).iloc[0]
    assert row["benefit_ungated"] == pytest.approx(0.5)
    assert row["gated_exact"] and row["benefit_exact"] == 0.0
    assert not row["gated_tested"] and row["benefit_tested"] == pytest.approx(0.5)
    even = benefits(seeds_table([100, 100, 100], [5e3] * 3), baseline).iloc[0]
    assert not even["gated_exact"] and even["benefit_exact"] == pytest.approx(0.5)


def test_a_clear_fall_closes_both_gates_and_so_does_one_that_cannot_be_ruled_out() -> None:
    baseline = seeds_table([100, 100, 100], [1e4] * 3)
    for crossed in ([90, 91, 89], [97, 97, 97], [101, 95, 103]):
        row = benefits(seeds_table(crossed, [5e3] * 3), baseline).iloc[0]
        assert row["gated_exact"] and row["gated_tested"] and row["benefit_tested"] == 0.0
    loud = benefits(seeds_table([106, 95, 103], [5e3] * 3), baseline).iloc[0]
    assert not loud["gated_exact"] and loud["gated_tested"]  # three seeds cannot show that less than 2 % is lost


def open_gates(loss: float, seeds: int, spread: float = 0.01, count: int = 4000) -> float:
    """Share of approaches whose tested gate stays open: differences with a mean of ``-loss``, in shares of the flow."""
    differences = np.random.default_rng(7).normal(-loss, spread, (count, seeds))
    return float(np.mean([not_inferior_p_value(d, MARGIN) < 0.05 for d in differences]))


def test_what_the_tested_gate_does_with_three_seeds_and_with_ten() -> None:
    """Episodes of about a hundred vehicles differ by about one of them: a spread of 1 %."""
    assert open_gates(MARGIN, 3) == pytest.approx(0.05, abs=0.015)
    assert open_gates(MARGIN, 10) == pytest.approx(0.05, abs=0.015)
    assert 0.5 < open_gates(0.0, 3) < 0.75
    assert open_gates(0.0, 10) > 0.99
    assert open_gates(0.01, 3) < 0.35
    assert open_gates(0.01, 10) > 0.8
    assert open_gates(0.0, 3, spread=0.03) < 0.2  # without a margin it would pass 19 of 20 of these


def test_the_whole_region_shows_what_is_shifted_behind_the_stop_line() -> None:
    baseline = seeds_table([10] * 3, [1000.0] * 3, region_emission_g=1500.0)
    row = benefits(seeds_table([10] * 3, [800.0] * 3, region_emission_g=1500.0), baseline).iloc[0]
    assert row["benefit_exact"] == pytest.approx(0.2)
    assert row["benefit_region_exact"] == row["benefit_region_tested"] == row["benefit_region_ungated"] == 0.0
    assert row["region_emission_policy_g"] == pytest.approx(150.0)
    fewer = benefits(seeds_table([9] * 3, [700.0] * 3, region_emission_g=900.0, entered=10), baseline).iloc[0]
    assert fewer["benefit_region_ungated"] == pytest.approx(0.4) and fewer["benefit_region_exact"] == 0.0


def test_keeping_vehicles_out_saves_nothing_by_demand() -> None:
    """A fifth less on the approach, but who waits outside, and who has not crossed, burns it all the same."""
    baseline = seeds_table([10] * 3, [1000.0] * 3, unfinished_emission_g=40.0, held_up_emission_g=60.0)
    holding = seeds_table([10] * 3, [800.0] * 3, unfinished_emission_g=90.0, held_up_emission_g=320.0)
    row = benefits(holding, baseline).iloc[0]
    assert row["benefit_exact"] == pytest.approx(0.2)
    assert (row["demand_emission_policy_g"], row["demand_emission_baseline_g"]) == pytest.approx((121.0, 110.0))
    assert row["benefit_demand_ungated"] == row["benefit_demand_exact"] == pytest.approx(1.0 - 121.0 / 110.0)
    fewer = benefits(seeds_table([8] * 3, [800.0] * 3, held_up_emission_g=80.0), baseline).iloc[0]
    assert fewer["benefit_demand_ungated"] == pytest.approx(0.0) and fewer["benefit_demand_exact"] == 0.0


def test_the_demand_that_was_not_served_stands_in_the_rows() -> None:
    sums = {"entered": 12, "unfinished": 2, "waiting": 3, "outside": 4, "dropped": 1, "early": 9, "due": 29}
    row = benefits(seeds_table([10, 10], [1e3] * 2, **sums), seeds_table([12, 12], [1e3] * 2, entered=15)).iloc[0]
    assert row["served_policy"] == pytest.approx(10 / 20)
    assert row["served_baseline"] == pytest.approx(12 / 15)
    assert (row["kept_out_policy"], row["kept_out_baseline"]) == (pytest.approx(7 / 20), 0.0)


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
    assert result["gated_tested"].mean() > 0.9  # arrivals that differ by a tenth rule out no loss of 2 %


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


def test_by_demand_a_policy_is_charged_for_the_episodes_in_which_it_lets_nobody_cross() -> None:
    baseline = seeds_table([20] * 3, [2000.0] * 3)
    for crossed, charged_g in (([0, 0, 0], 9000.0), ([20, 0, 20], (95.0 + 9000.0 + 95.0) / 3)):
        policy = seeds_table(crossed, [95.0 * n for n in crossed])
        policy.loc[policy["crossed"] == 0, "unfinished_emission_g"] = 9000.0
        row = benefits(policy, baseline).iloc[0]
        assert row["demand_emission_policy_g"] == pytest.approx(charged_g)
        assert row["benefit_demand_ungated"] == pytest.approx(1.0 - charged_g / 100.0)
        assert row["benefit_demand_exact"] == 0.0


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


@pytest.mark.parametrize(("difference", "p"), [([0, 0, 0], 0.0), ([-2, -2, -2], 0.0), ([-3, -3], 1.0), ([-3], 1.0)])
def test_without_variance_the_mean_decides(difference: list[float], p: float) -> None:
    assert not_inferior_p_value(difference, 2.0) == p


def test_nothing_to_compare_is_refused() -> None:
    nothing = seeds_table([10], [900.0]).iloc[:0]
    with pytest.raises(IzooError, match="there are no rows to compare"):
        benefits(nothing, nothing)
