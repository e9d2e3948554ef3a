"""The block of aggregates: the same figures, whoever asks for them."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from izoo.evaluation.across import aggregate, compare_entries, run_rows
from izoo.evaluation.aggregates import FIGURES, estimates, plain_figures
from izoo.evaluation.summary import summarise
from izoo.evaluation.table import COLUMNS
from izoo.metrics.benefit import benefits
from izoo.reporting.material import Entry, Evaluated
from izoo.reporting.scored import score
from tests.metrics.tables import seeds_table


def table(train_seed: int) -> pd.DataFrame:
    """Nine approaches on six intersections, two of them saturated; throughput falls here and there."""
    mine, world = np.random.default_rng(100 + train_seed), np.random.default_rng(9)
    parts = []
    for k in range(9):
        intersection = f"c/{'zyxwvu'[k % 6]}"
        crossed = [int(n) for n in world.integers(5, 20, 3)]
        kept = [n + int(change) for n, change in zip(crossed, mine.integers(-1, 2, 3), strict=True)]
        base, share, idle = 80.0 + 10.0 * k, 1.0 - 0.2 * mine.random(), 1.0 - 0.05 * world.random()
        about = {"context": f"{intersection}{k}/A", "volume_over_capacity": 1.2 if k in (3, 4) else 0.5}
        for policy, count, grams in (
            ("human", crossed, [base * n for n in crossed]),
            ("uncommanded", crossed, [idle * base * n for n in crossed]),
            ("ppo", kept, [share * base * n for n in kept]),
        ):
            rows = seeds_table(count, grams, policy=policy, **about)
            digest = hashlib.sha256(str(about["context"]).encode()).hexdigest()
            parts.append(rows.assign(context_hash=digest, intersection=intersection))
    found = pd.concat(parts, ignore_index=True)
    return found.assign(**{name: 0.0 for name in COLUMNS if name not in found})


TABLES = [table(k) for k in range(3)]


def all_rows() -> pd.DataFrame:
    return pd.concat([run_rows(rows, "ppo", k) for k, rows in enumerate(TABLES)], ignore_index=True)


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    """What an evaluation, a benchmark and a report say."""
    entry = Entry("ppo", "ppo", "test", tuple(Evaluated(k, Path(), rows) for k, rows in enumerate(TABLES)))
    summary = summarise(TABLES[0])["policies"]["ppo"]["against"]["human"]
    return {"summary": summary, "across": aggregate(all_rows()), "report": score(entry).summary}


def test_all_three_agree_where_they_say_the_same(found: dict[str, Any]) -> None:
    across, report = found["across"], found["report"]
    first = across["per_seed"][0]
    for part, figures in FIGURES.items():
        for name in figures:
            assert first[part][name] == pytest.approx(found["summary"]["all"][part][name]["value"])
            assert across["all"][part][name] == report["all"][part][name]
            mean = np.mean([seed[part][name] for seed in across["per_seed"]])
            assert across["all"][part][name]["value"] == pytest.approx(mean)
    assert across["unsaturated"] == report["unsaturated"]
    assert across["saturated"] == report["saturated"] and len(across["saturated"]) == 2


def test_three_training_seeds_have_an_interval_over_intersections_alone(found: dict[str, Any]) -> None:
    for estimate in (found["across"]["all"]["exact"]["mean"], found["report"]["all"]["tested"]["iqm"]):
        assert estimate["over"] == "intersections" and "not over training seeds" in estimate["missing"]
    four = aggregate(pd.concat([all_rows(), run_rows(table(3), "ppo", 3)], ignore_index=True))
    assert four["all"]["exact"]["mean"]["over"] == "intersections and training seeds"


def test_the_benefit_over_uncommanded_is_paired_and_has_its_own_interval(found: dict[str, Any]) -> None:
    """It is not the difference of two means, and its interval is not that of the benefit over human driving."""
    block = found["summary"]["all"]
    rows = benefits(TABLES[0].query("policy == 'ppo'"), TABLES[0].query("policy == 'uncommanded'"))
    over = block["over_uncommanded"]["mean"]
    assert over["value"] == pytest.approx(rows["benefit_ungated"].mean())
    width = {name: block[name]["mean"]["high"] - block[name]["mean"]["low"] for name in ("ungated", "over_uncommanded")}
    assert width["over_uncommanded"] != pytest.approx(width["ungated"], rel=1e-3)
    alone = summarise(TABLES[0].query("policy != 'ppo'"))["policies"]["uncommanded"]["against"]["human"]["all"]
    assert "over_uncommanded" not in alone


def test_no_rows_give_no_numbers() -> None:
    nothing = estimates(all_rows().iloc[:0])["exact"]["mean"]
    assert (nothing["value"], nothing["low"], nothing["n"], nothing["missing"]) == (None, None, 0, "nothing to count")


def test_an_approach_that_one_training_seed_lacks_is_left_out() -> None:
    rows = all_rows()
    lacking = rows.drop(index=rows.index[0])
    mean = estimates(lacking)["exact"]["mean"]
    assert mean["n"] == 8
    kept = rows[~rows["context"].isin([rows["context"].iloc[0]])]
    assert mean == estimates(kept)["exact"]["mean"]


def test_plain_numbers_follow_from_the_rows() -> None:
    rows = run_rows(TABLES[0], "ppo", 0)
    block = plain_figures(rows)
    assert block["exact"]["mean"] == pytest.approx(rows["benefit_exact"].mean())
    assert block["tested"]["share_gated"] == pytest.approx(rows["gated_tested"].mean())
    assert block["throughput"]["share_kept"] == pytest.approx((rows["throughput_benefit"] >= 0).mean())
    assert block["region_exact"]["mean"] == pytest.approx(rows["benefit_region_exact"].mean())


def test_every_pair_of_entries_is_compared_on_what_both_have() -> None:
    one, other = all_rows(), all_rows()
    other["benefit_exact"] -= 0.5
    found = compare_entries({"one": one, "other": other.iloc[1:]})
    assert found["approaches"] == 8
    values = {(pair["x"], pair["y"]): pair["value"] for pair in found["improvement"]}
    assert values == {("one", "other"): 1.0, ("other", "one"): 0.0}
    profile = dict(zip(found["profiles"]["thresholds"], found["profiles"]["one"], strict=True))
    assert profile[-1.0] == 1.0 and profile[1.0] == 0.0
