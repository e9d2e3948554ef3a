"""Pictures are written for every kind of intersection, and their colours and numbers are right."""

from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.spec import Approach, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.networks.dataset.intersections import load_intersection
from izoo.networks.draw.intersection import (
    draw_features,
    draw_intersection,
    layout_of,
    played_features,
)
from izoo.networks.net.connections import signal_links
from izoo.networks.road import read_road
from tests.networks.test_dataset import pocket_net, write

PLAN = SignalPlan(
    (
        SignalPhase(40.0, (("A", "C", "G"), ("C", "A", "g"), ("C", "B", "g"))),
        SignalPhase(20.0, (("B", "C", "G"), ("B", "A", "G"), ("A", "B", "g"))),
    )
)


def spec(plan: SignalPlan | None = PLAN) -> IntersectionSpec:
    """Three legs; the western exit is missing, A has a left pocket, and C leads both ways."""
    both = Approach(("s", "l"), 200.0, 15.0, 0.02, 8000.0, left_pockets=1, pocket_length_m=40.0)
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


def test_draws_what_is_built(tmp_path: Path) -> None:
    one = draw_intersection(spec(), tmp_path / "new" / "one.png", {"A": "Main Street"})
    two = draw_intersection(spec(None), tmp_path / "two.png")
    assert min(size_of(one)) > 800 and one.read_bytes() != two.read_bytes()


@pytest.mark.parametrize("name", ["19", "115"])
def test_draws_nets_of_the_dataset_with_every_movement(tmp_path: Path, published: Path, name: str) -> None:
    found = load_intersection(published / name)
    assert min(size_of(draw_intersection(found, tmp_path / "net.png"))) > 800
    layout = layout_of(read_road(published / name / "net.net.xml"), found)
    movements = {(movement.origin, movement.exit) for movement in layout.movements}
    assert movements == {(link.from_leg, link.to_leg) for link in signal_links(found)} & movements != set()
    assert all(np.isfinite(lane.points).all() for lane in layout.lanes)
    at_stop = sum(bool(lane.turns) for lane in layout.lanes)
    assert at_stop == sum(leg.approach.lane_count for leg in found.legs if leg.approach)


def test_a_net_without_lanes_inside_its_junction_is_drawn_too(tmp_path: Path) -> None:
    folder = write(tmp_path / "1", pocket_net(1, "rsl", 1), "100\n0\n0\n0\n")
    layout = layout_of(read_road(folder / "net.net.xml"), load_intersection(folder))
    assert [(each.origin, each.exit) for each in layout.movements] == [("A", "D"), ("A", "C"), ("A", "B")]


def test_played_features() -> None:
    table = played_features([spec()])
    assert table["lane_count"].tolist() == [2, 1, 1] and table["legs"].tolist() == [3] * 3
    assert table["signal_time_ratio"].tolist() == pytest.approx([1.0, 1 / 3, 2 / 3])
    assert table["phase_count"].tolist() == [2, 1, 1]
    assert table["inflow_peak_vph"].tolist() == pytest.approx([672.0, 900.0, 0.0])


def test_draws_the_features_of_a_set(tmp_path: Path) -> None:
    assert min(size_of(draw_features([spec(), spec(None)], tmp_path / "a.png", "Town"))) > 600
    with pytest.raises(IzooError, match="no intersection to draw"):
        draw_features([], tmp_path / "c.png")
    with pytest.raises(IzooError, match=r"must end in \.png"):
        draw_features([spec()], tmp_path / "c.pdf")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
