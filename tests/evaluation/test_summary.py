"""Aggregates of hand-made tables: the right n, the right baseline, the same numbers twice, and readable."""

from __future__ import annotations

import io
import json

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from izoo.errors import IzooError
from izoo.evaluation import approach_table, print_summary, summarise
from izoo.evaluation.across import aggregate, run_rows
from tests.metrics.tables import episode_row

CONTEXTS = 12


def make_table(engine: str = "combustion") -> pd.DataFrame:
    """Three seeds on twelve approaches of six intersections: 10 % saved, gated on the first, the last saturated."""
    generator = np.random.default_rng(0)
    rows = []
    for k in range(CONTEXTS):
        context = f"town/{k // 2}-{k % 2}/A"
        settings = {"context": context, "engine": engine, "volume_over_capacity": 1.2 if k == CONTEXTS - 1 else 0.5}
        for seed in range(3):
            crossed, emission = 80 + seed, float(generator.normal(1e4, 500))
            fall = 20 if k == 0 else 0
            rows.append(episode_row(crossed, emission, policy="human", seed=seed, **settings))
            rows.append(episode_row(crossed, 0.97 * emission, policy="uncommanded", seed=seed, **settings))
            share = (crossed - fall) / crossed
            rows.append(episode_row(crossed - fall, 0.9 * emission * share, policy="ppo", seed=seed, **settings))
    table = pd.DataFrame(rows)
    return table.assign(intersection=table["context"].str.slice(0, 6))


def test_aggregates_by_hand() -> None:
    summary = summarise(make_table())
    block = summary["policies"]["ppo"]["against"]["human"]
    exact = block["all"]["exact"]
    assert exact["mean"]["value"] == pytest.approx(0.1 * 11 / 12)
    assert exact["mean"]["n"] == 12
    assert exact["mean"]["groups"] == 6
    assert exact["mean"]["low"] < exact["mean"]["value"] <= exact["mean"]["high"]
    assert exact["share_gated"]["value"] == pytest.approx(1 / 12)
    assert exact["share_positive"]["value"] == pytest.approx(11 / 12)
    assert exact["iqm"]["value"] == pytest.approx(0.1)
    assert block["all"]["ungated"]["mean"]["value"] == pytest.approx(0.1)
    assert block["all"]["throughput"]["share_kept"]["value"] == pytest.approx(11 / 12)
    assert block["unsaturated"]["exact"]["mean"]["n"] == 11
    assert len(block["saturated"]) == 1
    assert summary["n"] == {"contexts": 12, "intersections": 6, "seeds": 3, "episodes": 108}


def test_both_baselines_are_shown_and_the_headline_follows_the_engine() -> None:
    summary = summarise(make_table())
    assert set(summary["policies"]) == {"ppo", "uncommanded"}
    assert set(summary["policies"]["ppo"]["against"]) == {"human", "uncommanded"}
    assert summary["policies"]["ppo"]["headline"] == "human"
    electric = summarise(make_table("electric"))
    assert electric["policies"]["ppo"]["headline"] == "uncommanded"
    assert electric["policies"]["uncommanded"]["headline"] == "human"


def test_only_intersections_with_a_figure_are_counted_where_intervals_are_explained() -> None:
    """The last of six intersections is empty: five are too few for intervals, and the sentence says so."""
    table = make_table()
    table.loc[table["intersection"] == table["intersection"].iloc[-1], ["crossed", "crossed_hdv", "emission_g"]] = 0
    summary = summarise(table)
    assert summary["n"]["intersections"] == 6 and summary["policies"]["ppo"]["intersections"] == 5
    assert aggregate(run_rows(table, "ppo", 0))["n"]["intersections"] == 5
    text = io.StringIO()
    print_summary(summary, Console(file=text, width=200))
    assert "5 intersections with a figure. No intervals with fewer than 6 intersections" in text.getvalue()
    assert "Brackets" not in text.getvalue()


def test_the_same_rows_give_the_same_numbers_in_any_order() -> None:
    table = make_table()
    shuffled = table.sample(frac=1.0, random_state=1)
    mean, other = (
        summarise(t)["policies"]["ppo"]["against"]["human"]["all"]["exact"]["iqm"] for t in (table, shuffled)
    )
    assert mean == pytest.approx(other)
    left = approach_table(table, "ppo")
    right = approach_table(shuffled, "ppo")
    pd.testing.assert_frame_equal(left, right)


def test_intervals_of_an_approach_cover_its_benefit() -> None:
    result = approach_table(make_table(), "ppo", "uncommanded")
    assert len(result) == CONTEXTS
    assert np.allclose(result["benefit_ungated"], 1 - 0.9 / 0.97)
    assert result[["low", "high"]].isna().all(axis=None), "episodes that are all alike say nothing of others"


def test_missing_numbers_are_null_in_json() -> None:
    table = make_table().assign(crossed=0, crossed_hdv=0, entered=0, waiting=0)
    summary = summarise(table)
    text = json.dumps(summary, allow_nan=False)
    block = json.loads(text)["policies"]["ppo"]["against"]["human"]
    assert block["all"]["exact"]["mean"]["value"] is None
    assert block["all"]["exact"]["mean"]["n"] == 0
    assert len(block["left_out"]) == CONTEXTS
    assert "no traffic" in block["left_out"][0]
    print_summary(summary, Console(file=io.StringIO()))


def test_printed_summary_names_what_matters() -> None:
    text = io.StringIO()
    print_summary(summarise(make_table()), Console(file=text, width=100))
    for words in (
        "ppo against human on SUMO (headline)",
        "benefit, mean",
        "9.2 %",
        "gated to 0",
        "saturated: 1",
        "uncommanded",
    ):
        assert words in text.getvalue()
    short = io.StringIO()
    print_summary(summarise(make_table().query("seed == 0")), Console(file=short, width=100))
    assert "three or more are needed" in short.getvalue()


def test_a_table_without_human_driving_is_refused() -> None:
    with pytest.raises(IzooError, match="human driving"):
        summarise(make_table().query("policy != 'human'"))
    with pytest.raises(IzooError, match="Did you mean 'ppo'"):
        approach_table(make_table(), "pop")


def test_scores_are_those_of_the_episodes_that_all_policies_have() -> None:
    table = make_table()
    partial = table[(table["policy"] != "ppo") | (table["seed"] == 1)]
    scores = summarise(partial)["scores"]
    human = table[(table["policy"] == "human") & (table["seed"] == 1)]
    assert scores["human"]["throughput"] == human["crossed"].mean()
    assert scores["human"]["emission_g_per_vehicle"] == pytest.approx(
        human["emission_g"].sum() / human["crossed"].sum()
    )


@pytest.mark.parametrize(("simulator", "words"), [("sumo", "on SUMO"), ("twin", "on the twin")])
def test_every_table_says_what_played(simulator: str, words: str) -> None:
    console = Console(file=io.StringIO(), width=200)
    print_summary(summarise(make_table(), simulator), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    compared = sum(line.startswith(("ppo against", "uncommanded against")) for line in text.splitlines())
    assert text.count(words) == 1 + compared == 4
