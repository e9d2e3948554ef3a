"""Files of an evaluation, and volume over capacity by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from pandas.testing import assert_frame_equal

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.errors import IzooError
from izoo.evaluation.saturation import volume_over_capacity
from izoo.evaluation.table import COLUMNS, identity, make_table, read_csv, read_journal, write_csv
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road


def context_with(**features: object) -> Context:
    return ProceduralSource(features).sample(np.random.default_rng(0))


def ratio(context: Context) -> float:
    road = read_road(build_net(context.intersection))
    return volume_over_capacity(context, road, road.approaches.index("A"))


def test_volume_over_capacity_of_one_lane_straight_on() -> None:
    """300 veh/h on a lane that has 25 s of green in a cycle of 25 + 30 + 6 s, at 1,800 veh/h of green."""
    context = context_with(lane_count=1, phase_count=1, green_s=25, red_s=30, inflow_vph_per_lane=300)
    assert ratio(context) == pytest.approx(300 / (1800 * 25 / 61), rel=1e-6)
    assert ratio(context.replace(hour="off-peak")) == pytest.approx(300 * 0.055 / 0.084 / (1800 * 25 / 61), rel=1e-6)


def test_two_lanes_carry_twice_as_much() -> None:
    features = {"phase_count": 1, "green_s": 25, "red_s": 30, "inflow_vph_per_lane": 300}
    assert ratio(context_with(lane_count=2, **features)) == pytest.approx(
        ratio(context_with(lane_count=1, **features)), rel=1e-6
    )


def test_approaches_without_demand_have_none() -> None:
    context = context_with(lane_count=1, phase_count=1, inflow_vph_per_lane=300)
    road = read_road(build_net(context.intersection))
    assert volume_over_capacity(context, road, road.approaches.index("B")) == 0.0


def rows(contexts: list[Context]) -> list[dict[str, object]]:
    numbers = np.random.default_rng(0).random((len(contexts), len(COLUMNS)))
    table = [dict(zip(COLUMNS, line, strict=True)) for line in numbers.tolist()]
    return [{**row, **identity("x", c, 2**62 + k, "A")} for k, (row, c) in enumerate(zip(table, contexts, strict=True))]


def test_names_that_mean_nothing_elsewhere_are_names_here(contexts: list[Context], tmp_path: Path) -> None:
    table = make_table([{**row, "policy": "null", "intersection": "NA"} for row in rows(contexts[:1])])
    write_csv(table, tmp_path / "t.csv")
    assert_frame_equal(read_csv(tmp_path / "t.csv"), table, check_exact=True)


def test_tables_read_back_exactly(contexts: list[Context], tmp_path: Path) -> None:
    table = make_table(rows(contexts))
    table.loc[0, "volume_over_capacity"] = math.inf
    write_csv(table, tmp_path / "t.csv")
    assert_frame_equal(read_csv(tmp_path / "t.csv"), table, check_exact=True)
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_unreadable_tables_are_refused(contexts: list[Context], tmp_path: Path) -> None:
    with pytest.raises(IzooError, match="cannot read"):
        read_csv(tmp_path / "absent.csv")
    make_table(rows(contexts)).drop(columns="crossed").to_csv(tmp_path / "old.csv", index=False)
    with pytest.raises(IzooError, match=r"lacks the column\(s\) crossed"):
        read_csv(tmp_path / "old.csv")
    write_csv(make_table(rows(contexts)), tmp_path / "whole.csv")
    (tmp_path / "cut.csv").write_bytes((tmp_path / "whole.csv").read_bytes()[:-20])
    with pytest.raises(IzooError, match="cut short"):
        read_csv(tmp_path / "cut.csv")


def test_a_damaged_journal_is_refused(contexts: list[Context], tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = rows(contexts)
    path.write_text(f"{json.dumps(whole[:1])}\nnonsense\n{json.dumps(whole[1:])}\n")
    with pytest.raises(IzooError, match="damaged"):
        read_journal(path)
    path.write_text(f"{json.dumps(whole[:1])}\n{json.dumps(whole[1:])[:30]}")
    assert read_journal(path) == whole[:1]
