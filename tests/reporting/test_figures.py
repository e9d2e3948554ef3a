"""Figures of a report: the paper's histogram, Pareto fronts, and text that stays text."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from izoo.reporting.curves import learning_curves, pareto
from izoo.reporting.histograms import cut_height, histogram, zero_count
from izoo.reporting.material import Curve


def test_tall_bars_are_cut_and_their_count_printed() -> None:
    assert cut_height(np.array([5, 40, 6])) == 12
    assert cut_height(np.array([5, 8, 6])) == 8
    figure = histogram(np.concatenate([np.zeros(40), np.full(6, 0.2), [7.0]]), "a -> b", "h")
    assert figure.title == "a -> b (n = 47)"
    assert [note["text"] for note in figure.layout["annotations"]] == ["40"]
    assert max(figure.data[0]["y"]) == 12
    counts = figure.data[0]["customdata"]
    assert (len(counts), sum(counts), counts[-1]) == (150, 47, 1)  # 700 % is clipped into the last bar


def test_the_bar_at_zero() -> None:
    assert zero_count([0.0, 0.001, -0.001, 0.02]) == 2


def test_pareto_figure_joins_the_front_and_marks_lost_throughput() -> None:
    table = pd.DataFrame(
        {
            "point": ["human", "<b>", "ppo", "ppo"],
            "kind": ["human", "scripted", "trained", "trained"],
            "emission_g_per_vehicle": [100.0, 90.0, 80.0, 70.0],
            "travel_time_s_per_vehicle": [40.0, 42.0, 50.0, 90.0],
            "throughput_kept": [True, True, True, False],
            "on_front": [True, False, True, False],
        }
    )
    figure = pareto(table)
    assert [trace["name"] for trace in figure.data] == [
        *("human", "scripted", "trained", "trained, lost throughput", "Pareto front")
    ]
    assert figure.data[1]["text"] == ["&lt;b&gt;"]
    assert figure.data[-1]["x"] == [80.0, 100.0]
    assert figure.alt.endswith("on the Pareto front: ppo, human.")


def test_validations_of_a_single_run_have_error_bars() -> None:
    metrics = pd.DataFrame({"frames": [100, 200], "return": [1.0, 2.0]})
    ends = {"benefit_low": [0.05, None], "benefit_high": [0.2, None]}
    validation = pd.DataFrame({"frames": [100, 200], "benefit": [0.1, 0.3], **ends})
    figure = learning_curves([Curve("ppo", metrics, validation)])[0]
    bars = figure.data[0]["error_y"]
    assert bars["array"] == pytest.approx([0.1, 0.0]) and bars["arrayminus"] == pytest.approx([0.05, 0.0])
    plain = learning_curves([Curve("ppo", metrics, validation[["frames", "benefit"]])])[0]
    assert "error_y" not in plain.data[0]
    seeds = [Curve(f"ppo seed {k}", metrics, validation) for k in range(2)]
    assert not any("error_y" in trace for trace in learning_curves(seeds)[0].data)


def test_learning_curves_smooth_and_leave_out_gaps() -> None:
    values = np.where(np.arange(100) % 2, 1.0, 3.0)
    values[10] = np.nan
    metrics = pd.DataFrame({"frames": np.arange(100), "return": values})
    (figure,) = learning_curves([Curve("ppo seed 0", metrics)])
    assert figure.name == "curve-return"
    assert len(figure.data[0]["x"]) == 99
    assert figure.data[0]["y"][-1] == pytest.approx(
        2.0, abs=0.1
    )  # a running mean, where the column jumps between 1 and 3


def test_seeds_of_a_policy_get_a_band_and_their_mean() -> None:
    """Two seeds of one policy and one of another; the first begin and end at different steps."""
    frames = np.arange(1, 101) * 100.0
    runs = {"ppo seed 0": (frames, 0.01), "ppo seed 1": (frames + 1000.0, 0.03), "ddpg seed 0": (frames, 0.02)}
    curves = [
        Curve(name, pd.DataFrame({"frames": steps, "co2_saved_over_uncommanded": value}))
        for name, (steps, value) in runs.items()
    ]
    (figure,) = learning_curves(curves)
    assert figure.name == "curve-co2-saved-over-uncommanded" and "lowest to the highest" in figure.caption
    area, mean = (trace for trace in figure.data[3:])
    assert [trace["legendgroup"] for trace in figure.data] == ["ppo", "ppo", "ddpg", "ppo", "ppo"]
    assert [trace["showlegend"] for trace in figure.data] == [True, False, True, False, False]
    assert mean["y"] == pytest.approx([0.02] * len(mean["y"]))
    assert (min(area["y"]), max(area["y"])) == (0.01, 0.03)
    assert (mean["x"][0], mean["x"][-1]) == (1100.0, 10000.0), "where both are"
    assert figure.data[0]["opacity"] < figure.data[2]["opacity"], "single seeds stand back"
    (alone,) = learning_curves(curves[2:])
    assert alone.caption == "" and len(alone.data) == 1
