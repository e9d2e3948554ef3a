"""Pictures are written for every kind of intersection, and their colours and numbers are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.spec import Approach, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.networks.dataset.intersections import load_intersection
from izoo.networks.draw.intersection import (
    NEVER_GREEN,
    NO_PLAN,
    draw_features,
    draw_intersection,
    feature_table,
    group_colours,
)
from izoo.networks.draw.plan_view import layout_of_road, layout_of_spec
from izoo.networks.road import read_road
from tests.networks.test_dataset import published  # noqa: F401

PLAN = SignalPlan(
    (
        SignalPhase(40.0, (("A", "C", "G"), ("C", "A", "g"), ("A", "B", "s"))),
        SignalPhase(20.0, (("B", "C", "G"), ("B", "A", "G"))),
    )
)


def spec(plan: SignalPlan | None = PLAN) -> IntersectionSpec:
    """Three legs; the western exit is missing, A has a left pocket, and C leads both ways."""
    both = Approach(("rs", "l"), 200.0, 15.0, 0.02, 8000.0, left_pockets=1, pocket_length_m=40.0)
    legs = (
        Leg("A", 0.0, both, 1, 200.0, 15.0),
        Leg("B", 90.0, Approach(("rl",), 150.0, 13.0, -0.01, 20000.0), 1, 150.0, 13.0),
        Leg("C", 180.0, Approach(("rs",), 120.0, 15.0, 0.0, 0.0), 2, 120.0, 15.0),
    )
    return IntersectionSpec("town/1", "osm", legs, plan, imputed=("grade of A",))


def size_of(path: Path) -> tuple[int, int]:
    """Width and height from the header of a PNG."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def test_draws_descriptions_with_and_without_a_plan(tmp_path: Path) -> None:
    one = draw_intersection(spec(), tmp_path / "new" / "one.png", streets={"A": "Main Street"})
    two = draw_intersection(spec(None), tmp_path / "two.png")
    assert min(size_of(one)) > 800 and one.read_bytes() != two.read_bytes()


def test_draws_every_net_of_the_dataset_sample(tmp_path: Path, published: Path) -> None:  # noqa: F811
    for name in ("19", "115"):
        folder = published / name
        path = draw_intersection(load_intersection(folder), tmp_path / f"{name}.png")
        assert min(size_of(path)) > 800


def test_net_and_description_lay_out_the_same_movements(published: Path) -> None:  # noqa: F811
    for name in ("31", "85"):
        found = load_intersection(published / name)
        road = layout_of_road(read_road(published / name / "net.net.xml"), found)
        plain = layout_of_spec(found)
        there = {(movement.origin, movement.exit) for movement in road.movements}
        assert there <= {(movement.origin, movement.exit) for movement in plain.movements}
        for layout in (road, plain):
            assert all(np.isfinite(lane.points).all() for lane in layout.lanes)
            at_stop = sum(bool(lane.turns) for lane in layout.lanes)
            assert at_stop == sum(leg.approach.lane_count for leg in found.legs if leg.approach)


def test_movements_that_are_green_together_share_a_colour() -> None:
    pairs = [("A", "C"), ("C", "A"), ("B", "C"), ("A", "B")]
    colours = group_colours(PLAN, pairs)
    assert colours["A", "C"] == colours["C", "A"] != colours["B", "C"]
    assert colours["A", "B"] == NEVER_GREEN
    assert set(group_colours(None, pairs).values()) == {NO_PLAN}


def test_feature_table() -> None:
    table = feature_table([spec()])
    assert table["lane_count"].tolist() == [2.0, 1.0, 1.0] and table["legs"].tolist() == [3.0] * 3
    assert (
        table["signal_time_ratio"] == pytest.approx([2 / 3, 1 / 3, 2 / 3])
        and table["phase_count"].tolist() == [1.0] * 3
    )
    assert table["inflow_peak_vph"] == pytest.approx([672.0, 900.0, 0.0])
    assert np.isnan(feature_table([spec(None)])["signal_time_ratio"]).all()


def test_draws_the_features_of_a_set(tmp_path: Path) -> None:
    assert min(size_of(draw_features([spec(), spec(None)], tmp_path / "a.png", "Town"))) > 600
    assert min(size_of(draw_features([spec(None)], tmp_path / "b.png"))) > 600
    with pytest.raises(IzooError, match="no intersection to draw"):
        draw_features([], tmp_path / "c.png")
    with pytest.raises(IzooError, match=r"must end in \.png"):
        draw_features([spec()], tmp_path / "c.pdf")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
