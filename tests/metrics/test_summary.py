"""What a summary says of a table, and the verdict in words."""

import json

import numpy as np
import pandas as pd
import pytest

from izoo.errors import IzooError
from izoo.metrics.figures import FIGURES
from izoo.metrics.statistics import iqm
from izoo.metrics.summary import summarise
from tests.metrics.tables import compared, episode_row

NOISE = np.random.default_rng(0).normal(0.0, 1.0, (4, 20))


def test_the_summary_of_one_entry() -> None:
    table = compared({"ppo": 4.0 + NOISE[0]}, train_seeds={"ppo": 4})
    found = summarise(table)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["task"] == "test" and found["simulators"] == ["sumo"] and found["block"] == "unsaturated"
    assert found["n"] == {"contexts": 20, "intersections": 20, "eval_seeds": 1, "episodes": 120, "left_out": []}
    entry = found["entries"]["ppo"]
    assert entry["train_seeds"] == 4 and not entry["slower"]
    assert list(entry["against"]) == ["uncommanded", "human"]
    block = entry["against"]["uncommanded"]["unsaturated"]
    saved = block["figures"]["co2_saved"]
    assert saved["low"] < saved["value"] < saved["high"] and saved["over"] == "intersections and training seeds"
    assert block["mean"] == pytest.approx(np.mean(4.0 + NOISE[0]))
    assert block["median"] == pytest.approx(np.median(4.0 + NOISE[0]))
    assert (block["gain_share"], block["lose_share"]) == (1.0, 0.0)
    assert set(block["figures"]) == {name for name, figure in FIGURES.items() if figure.paired}
    assert set(entry["levels"]["unsaturated"]) == {name for name, figure in FIGURES.items() if not figure.paired}
    assert entry["levels"]["unsaturated"]["delay_s"] == pytest.approx(20.0)
    assert "saturated" not in entry["levels"] and "saturated" not in entry["against"]["human"]
    assert found["entries"]["human"]["against"] == {} and list(found["entries"]["uncommanded"]["against"]) == ["human"]


def said(savings: dict[str, object], delays: dict[str, float] | None = None, **settings: object) -> str:
    return summarise(compared(savings, delays, **settings))["verdict"]  # type: ignore[arg-type]


def test_verdicts_on_one_entry() -> None:
    where = "on 20 unsaturated intersections"
    good, none, bad = 4.0 + NOISE[0], NOISE[1], -4.0 + NOISE[2]
    assert said({"ppo": good}) == f"ppo saves 3.8 % [3.4, 4.3] CO2 over uncommanded CVs {where}, without more delay."
    slower = said({"ppo": good}, {"ppo": 4.0})
    assert slower.endswith(f"{where}, but is slower: 4.4 s [4.2, 4.5] more delay per vehicle.")
    faster = said({"ppo": good}, {"ppo": -4.0})
    assert faster.endswith(f"{where}, and saves 4.4 s [4.2, 4.5] of delay per vehicle.")
    assert said({"ppo": none}).startswith(f"No difference between ppo and uncommanded CVs is shown {where} (CO2 saved ")
    zero = said({"ppo": [0.0] * 20})
    assert zero == f"No difference between ppo and uncommanded CVs is shown {where} (CO2 saved 0.0 %)."
    assert said({"ppo": none}, {"ppo": -4.0}).startswith("ppo saves 4.4 s [4.2, 4.5] of delay per vehicle over")
    assert said({"ppo": none}, {"ppo": 4.0}).startswith(f"ppo is slower than uncommanded CVs {where}: 4.4 s [4.2, 4.5]")
    assert "burns 3.5 % [" in said({"ppo": bad}) and "more CO2 than uncommanded CVs" in said({"ppo": bad})
    assert said({"ppo": bad}, {"ppo": 4.0}).endswith(", and is slower: 4.4 s [4.2, 4.5] more delay per vehicle.")
    few = "ppo saves 3.5 % CO2 over uncommanded CVs on 2 unsaturated intersections, too few for an interval (6)."
    assert said({"ppo": [3.0, 4.0]}) == few
    assert " on 20 saturated intersections" in said({"ppo": good}, volume_over_capacity=1.5)


def test_verdicts_on_several_entries() -> None:
    clear = said({"ppo": 4.0 + NOISE[0], "glide": 1.0 + NOISE[1]})
    assert clear.startswith("ppo saves 3.8 %") and "points [" in clear and clear.endswith("more than glide.")
    alike = said({"ppo": 4.0 + NOISE[0], "glide": 4.0 + NOISE[1], "mappo": 4.1 + NOISE[2], "bad": NOISE[3]})
    assert alike.startswith("mappo") and alike.endswith("; indistinguishable from glide.")
    many = said({name: 4.0 + NOISE[k] for k, name in enumerate("abcd")} | {"e": 4.0 + NOISE[0] + NOISE[1]})
    assert "; indistinguishable from " in many and many.endswith(" and 2 more.")


def test_a_slower_entry_is_not_the_best() -> None:
    found = summarise(compared({"ppo": 4.0 + NOISE[0], "cap_0.6": 7.0 + NOISE[1]}, {"cap_0.6": 5.0}))
    assert found["entries"]["cap_0.6"]["slower"] and not found["entries"]["ppo"]["slower"]
    assert found["verdict"].startswith("ppo saves") and "cap_0.6" not in found["verdict"]


def test_pairs_are_compared_on_the_contexts_that_they_share() -> None:
    found = summarise(compared({"ppo": 4.0 + NOISE[0], "planner": 8.0 + NOISE[1][:8]}))
    (pair,) = found["pairwise"]
    assert (pair["x"], pair["y"], pair["verdict"]) == ("ppo", "planner", "worse") and pair["p_holm"] < 0.05
    n = {name: found["entries"][name]["against"]["uncommanded"]["all"]["contexts"] for name in ("planner", "ppo")}
    assert n == {"planner": 8, "ppo": 20}
    assert pair["difference"]["value"] == pytest.approx(iqm((4.0 + NOISE[0] - 8.0 - NOISE[1])[:8]))


def in_single_episodes(saved: np.ndarray, behind: np.ndarray, seeds_of_rule: int = 4) -> pd.DataFrame:
    """A rule plays the episodes of four training seeds, which save as much less than it does: ``[20, 4]`` each."""
    rows = [
        episode_row(100.0 - value, policy=policy, context=f"x/{k}/A", seed=seed, train_seed=train_seed)
        for (k, seed), each in np.ndenumerate(saved)
        for policy, value, train_seed in (
            ("uncommanded", 0.0, 0),
            ("glide", each, 0),
            ("ppo", each - behind[k, seed], seed),
        )
        if policy != "glide" or seed < seeds_of_rule
    ]
    return pd.DataFrame(rows)


def test_a_rule_is_compared_in_the_episodes_of_each_training_seed() -> None:
    """Where a few savings are large, the mean of its four episodes is ahead of the same driving in single ones."""
    saved = np.random.default_rng(2).lognormal(1.0, 1.0, (20, 4))
    table = in_single_episodes(saved, np.ones((20, 4)))
    found = summarise(table)
    (pair,) = found["pairwise"]
    assert (pair["x"], pair["difference"]["value"]) == ("glide", pytest.approx(1.0))
    rule, learner = (
        found["entries"][name]["against"]["uncommanded"]["all"]["figures"]["co2_saved"]["value"]
        for name in ("glide", "ppo")
    )
    assert rule > learner + 1.5
    (pair,) = summarise(table, reference="glide")["pairwise"]
    assert (pair["x"], pair["difference"]["value"]) == ("ppo", pytest.approx(-1.0))
    (pair,) = summarise(table[(table["policy"] != "ppo") | (table["train_seed"] == 0)])["pairwise"]
    assert pair["difference"]["value"] == pytest.approx(1.0), "one training seed"


def test_a_rule_that_lacks_episodes_is_compared_with_all_training_seeds() -> None:
    """Of those that it shares episodes with alone, the interval would leave out that seeds differ."""
    behind = NOISE[:4].T + np.array([0.0, 0.0, 0.0, 20.0])
    table = in_single_episodes(np.full((20, 4), 3.0), behind, seeds_of_rule=1)
    (pair,) = summarise(table)["pairwise"]
    assert pair["difference"]["over"] == "intersections and training seeds"
    assert pair["verdict"] == "indistinguishable"


def test_with_a_reference_the_others_are_compared_with_it_alone() -> None:
    table = compared({"full": 4.0 + NOISE[0], "less": 3.0 + NOISE[1], "least": 2.0 + NOISE[2]})
    found = summarise(table, reference="full")["pairwise"]
    assert [(pair["x"], pair["y"]) for pair in found] == [("less", "full"), ("least", "full")]


def test_a_twin_of_an_entry_is_indistinguishable_from_it() -> None:
    (pair,) = summarise(compared({"ppo": 4.0 + NOISE[0], "copy": 4.0 + NOISE[0]}))["pairwise"]
    assert pair["verdict"] == "indistinguishable" and pair["p_holm"] is None


def test_saturated_contexts_stand_apart() -> None:
    table = compared({"ppo": np.where(np.arange(20) < 8, -5.0, 5.0) + NOISE[0]})
    table.loc[table["context"].isin([f"x/{k}/A" for k in range(8)]), "volume_over_capacity"] = 1.2
    against = summarise(table)["entries"]["ppo"]["against"]["human"]
    assert [against[block]["intersections"] for block in ("unsaturated", "saturated", "all")] == [12, 8, 20]
    found = summarise(table)["entries"]["ppo"]["against"]["uncommanded"]
    assert found["unsaturated"]["mean"] > 4.0 and found["saturated"]["mean"] < -4.0


def test_of_two_simulators_sumo_is_summed_up() -> None:
    sumo, twin = compared({"ppo": 4.0 + NOISE[0]}), compared({"ppo": -4.0 + NOISE[0]}, simulator="twin")
    both = summarise(pd.concat([twin, sumo], ignore_index=True))
    assert both["simulators"] == ["sumo", "twin"]
    assert both["verdict"] == summarise(sumo)["verdict"] != summarise(twin)["verdict"]


def test_contexts_without_demand_are_named() -> None:
    table = compared({"ppo": 4.0 + NOISE[0]})
    sums = ["cohort", "cohort_left", "cohort_region_co2_g", "cohort_blocked_co2_g", "crossed"]
    table.loc[table["context"] == "x/3/A", sums] = 0.0
    found = summarise(table)
    assert found["n"]["left_out"] == ["x/3/A"] and found["n"]["contexts"] == 19
    table[sums] = 0.0
    empty = summarise(table)
    assert empty["verdict"] == "There is nothing to compare: no context has demand, or the baseline burns no CO2."
    assert len(empty["n"]["left_out"]) == 20


def test_without_uncommanded_rows_human_driving_is_the_baseline() -> None:
    table = compared({"ppo": 4.0 + NOISE[0]}, engine="electric")
    found = summarise(table[table["policy"] != "uncommanded"])
    assert "CO2 over human driving" in found["verdict"] and not found["entries"]["ppo"]["slower"]
    alone = summarise(table[table["policy"] == "ppo"])
    assert alone["entries"]["ppo"]["against"] == {} and alone["pairwise"] == []
    assert alone["verdict"] == "There is nothing to compare: the table has no policy with a baseline."
    baselines = summarise(table[table["policy"] != "ppo"])["verdict"]
    assert baselines.startswith("uncommanded driving saves")


def test_a_baseline_that_lacks_episodes_is_refused() -> None:
    table = compared({"ppo": 4.0 + NOISE[0]})
    with pytest.raises(IzooError, match="no episodes"):
        summarise(table.iloc[:0])
    with pytest.raises(IzooError, match="uncommanded lacks 1 episode"):
        summarise(table[(table["policy"] != "uncommanded") | (table["context"] != "x/3/A")])


def test_levels_weigh_vehicles_and_count_by_context() -> None:
    rows = [
        episode_row(co2_g, policy="ppo", context=context, cohort=cohort, collisions_cv=crashes)
        for context, co2_g, cohort, crashes in (("x/1/A", 100.0, 30.0, 3.0), ("x/2/A", 200.0, 10.0, 0.0))
    ]
    levels = summarise(pd.DataFrame(rows))["entries"]["ppo"]["levels"]["all"]
    assert levels["co2_g"] == pytest.approx(125.0) and levels["collisions"] == pytest.approx(1.5)
    assert levels["nan_share"] is None


def test_the_generalisation_gap() -> None:
    seeds = {"ppo": 4}
    test = compared({"ppo": 3.0 + NOISE[0], "glide": NOISE[1]}, train_seeds=seeds)
    training = compared({"ppo": 5.0 + NOISE[0, :12]}, train_seeds=seeds)
    found = summarise(test, trained_on=training)
    assert found["n"]["contexts"] == 20 and found["entries"] == summarise(test)["entries"]
    assert list(found["gaps"]) == ["ppo"], "the others were not played in both"
    gap, training = found["gaps"]["ppo"]["gap"], found["gaps"]["ppo"]["training"]
    here = found["entries"]["ppo"]["against"]["uncommanded"]["all"]["figures"]["co2_saved"]
    assert training["value"] == pytest.approx(iqm(5.0 + NOISE[0, :12]))
    assert gap["value"] == pytest.approx(training["value"] - here["value"])
    assert 0.0 < gap["low"] < gap["value"] < gap["high"]
    assert summarise(test)["gaps"] == {}
