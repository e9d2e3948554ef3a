"""The table's columns, volume over capacity by hand, and contexts that are kept."""

import dataclasses
import gzip
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from izoo.contexts import catalogue
from izoo.contexts.context import Context
from izoo.contexts.procedural import EASY, ProceduralSource
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.results.schema import COLUMNS, KEY, make_table, volume_over_capacity
from izoo.results.store import CONTEXTS_FILE, add_contexts, context_from_dict, read_contexts


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


def test_two_lanes_carry_twice_as_much_and_no_demand_is_none() -> None:
    features = {"phase_count": 1, "green_s": 25, "red_s": 30, "inflow_vph_per_lane": 300}
    one, two = (context_with(lane_count=lanes, **features) for lanes in (1, 2))
    assert ratio(two) == pytest.approx(ratio(one), rel=1e-6)
    assert ratio(one.replace(approach="B")) == 0.0


def test_a_table_has_all_columns_in_order_and_its_rows_sorted(table: pd.DataFrame) -> None:
    again = make_table(table.sample(frac=1.0, random_state=0).to_dict("records"))
    pd.testing.assert_frame_equal(again, table, check_exact=True)
    assert list(table.columns) == list(COLUMNS) and not table.duplicated(list(KEY)).any()
    assert make_table([]).empty


def test_a_context_survives_json() -> None:
    for context in (EASY.sample(np.random.default_rng(0)), catalogue.get(7), catalogue.get(1_000_000)):
        again = context_from_dict(json.loads(json.dumps(dataclasses.asdict(context))))
        assert again == context
        assert again.content_hash == context.content_hash


def test_contexts_of_a_folder_add_up(tmp_path: Path) -> None:
    one, two = catalogue.get(0), catalogue.get(1)
    add_contexts(tmp_path, [one])
    add_contexts(tmp_path, [two, one])
    assert read_contexts(tmp_path) == {one.content_hash: one, two.content_hash: two}
    (tmp_path / CONTEXTS_FILE).write_bytes(gzip.compress(b" " * (1 << 29)))
    with pytest.raises(IzooError, match="cannot read"):
        read_contexts(tmp_path)
    (tmp_path / CONTEXTS_FILE).unlink()
    with pytest.raises(IzooError, match=r"there is no .*contexts\.json\.gz"):
        read_contexts(tmp_path)
