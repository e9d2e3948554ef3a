"""The block of aggregates: the same figures, whoever asks for them."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from izoo.evaluation.across import aggregate, run_rows
from izoo.evaluation.aggregates import FIGURES, aggregates, over_intersections, over_train_seeds, plain
from izoo.evaluation.summary import summarise
from izoo.evaluation.table import COLUMNS
from izoo.reporting.material import Entry, Evaluated
from izoo.reporting.scored import score
from tests.metrics.tables import seeds_table


def table(train_seed: int) -> pd.DataFrame:
    """Nine approaches on five intersections, two of them saturated; throughput falls here and there."""
    mine, world = np.random.default_rng(100 + train_seed), np.random.default_rng(9)
    parts = []
    for k in range(9):
        intersection = f"c/{'zyxwv'[k % 5]}"
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
BEFORE = {
    "summary/all/exact/mean": (0.075736515, 0.0433035634, 0.118771616),
    "summary/all/exact/ratio_of_sums": (0.0773930455, 0.0448450799, 0.114887253),
    "summary/unsaturated/tested/iqm": (0.115997103, 0.0837955802, 0.141228547),
    "summary/all/throughput/ratio_of_sums": (0.0136612022, 0.0, 0.0273972603),
    "across/all/over_train_seeds/exact/iqm": (0.0734214609, 0.0487004492, 0.0938418803),
    "across/all/over_intersections/tested/mean": (0.10586996, 0.0742863909, 0.131748029),
    "across/unsaturated/over_train_seeds/exact/share_gated": (0.238095238, 0.0952380952, 0.380952381),
    "report/all/exact/mean": (0.0768572167, 0.0540623092, 0.101467756),
    "report/unsaturated/throughput/share_kept": (0.761904762, 0.666666667, 0.916666667),
    "report/all/tested/ratio_of_sums": (0.103165312, 0.0774459639, 0.132160141),
}
"""Value and interval as three computations gave them before they became one."""


def all_rows() -> pd.DataFrame:
    return pd.concat([run_rows(rows, "ppo", k) for k, rows in enumerate(TABLES)], ignore_index=True)


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    """What an evaluation, a benchmark and a report say."""
    entry = Entry("ppo", "ppo", "test", tuple(Evaluated(k, Path(), rows) for k, rows in enumerate(TABLES)))
    summary = summarise(TABLES[0])["policies"]["ppo"]["against"]["human"]
    return {"summary": summary, "across": aggregate(all_rows()), "report": score(entry).summary}


@pytest.mark.parametrize("path", BEFORE)
def test_figures_and_intervals_are_those_of_before(found: dict[str, Any], path: str) -> None:
    for name in path.split("/"):
        found = found[name]
    assert (found["value"], found["low"], found["high"]) == pytest.approx(BEFORE[path], rel=1e-8, abs=1e-12)


def test_all_three_agree_where_they_say_the_same(found: dict[str, Any]) -> None:
    runs = found["across"]["all"]["per_seed"]
    for part, figures in FIGURES.items():
        for name in figures:
            assert runs[0][part][name] == pytest.approx(found["summary"]["all"][part][name]["value"])
    report = found["report"]["all"]["exact"]["mean"]
    assert found["across"]["all"]["over_train_seeds"]["exact"]["mean"]["value"] == pytest.approx(report["value"])
    interval = found["across"]["all"]["over_train_seeds"]["exact"]["mean"]
    assert report["over_seeds"] == pytest.approx([interval["low"], interval["high"]], abs=0.01)


def test_no_rows_give_no_numbers() -> None:
    nothing = all_rows().iloc[:0]
    for estimate in (over_intersections(nothing, 0, 10), over_train_seeds(1, 0, 10)):
        assert aggregates(nothing, estimate)["exact"]["mean"] == {
            **dict.fromkeys(("value", "low", "high")),
            **{"n": 0, "groups": 0, "confidence": 0.95},
        }


def test_plain_numbers_follow_from_the_rows() -> None:
    rows = run_rows(TABLES[0], "ppo", 0)
    block = aggregates(rows, plain)
    assert block["exact"]["mean"] == pytest.approx(rows["benefit_exact"].mean())
    assert block["tested"]["share_gated"] == pytest.approx(rows["gated_tested"].mean())
    assert block["throughput"]["share_kept"] == pytest.approx((rows["throughput_benefit"] >= 0).mean())
