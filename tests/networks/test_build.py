"""Nets built by ``netconvert`` and driven through by SUMO, and where they are kept."""

import dataclasses
import math

import numpy as np
import pytest
from defusedxml import ElementTree

from izoo.contexts.movements import turn_of
from izoo.contexts.procedural import procedural_intersection
from izoo.contexts.spec import Approach, GhostSpec, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net import netconvert
from izoo.networks.net.build import build_net, net_key
from izoo.networks.net.connections import signal_links
from izoo.networks.net.net_cache import cache_folder
from izoo.networks.road import read_road
from tests.networks.worlds import CROSS, drive_everywhere, intersection, saved_states

POCKETS = {"left_pockets": 1, "pocket_length_m": 50.0}
WORLDS = {
    "three legs": intersection((0.0, 90.0, 180.0), 2),
    "three equal legs": intersection((0.0, 120.0, 240.0), 2),
    "four legs, one lane": intersection(CROSS, 1),
    "four legs, six lanes": intersection(CROSS, 6),
    "more lanes than the exits have": intersection(CROSS, 4, 1),
    "fewer lanes than the exits have": intersection(CROSS, 1, 3),
    "left pocket": intersection(CROSS, 3, 2, **POCKETS),
    "pockets on both sides": intersection(CROSS, 4, 2, right_pockets=1, **POCKETS),
    "right on red": intersection(CROSS, 3, right_on_red=True),
    "five legs": intersection((0.0, 72.0, 144.0, 216.0, 288.0), 3),
    "six legs": intersection((0.0, 60.0, 120.0, 180.0, 240.0, 300.0), 2),
    "irregular legs": intersection((10.0, 60.0, 170.0, 215.0, 290.0), 3),
    "no outer gates": intersection(CROSS, 2, ghosts=GhostSpec(outer_gates=False)),
    "steep": intersection(CROSS, 2, grade=0.2),
    "procedural": procedural_intersection(3, 2, offset_s=2.0, grade=-0.03),
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("world", WORLDS)
def test_nets_are_what_their_specs_say_and_every_movement_drives_through(world, cache, tmp_path):
    spec = WORLDS[world]
    net = build_net(spec, cache)
    road = read_road(net)
    expected = np.full(road.movement_turn.shape, -1)
    for link in signal_links(spec):
        turn = turn_of(spec.leg(link.from_leg).bearing_deg, spec.leg(link.to_leg).bearing_deg)
        expected[road.approaches.index(link.from_leg), road.exits.index(link.to_leg)] = "rsl".index(turn)
    np.testing.assert_array_equal(road.movement_turn, expected)
    sides = [spec.leg(name).approach for name in road.approaches]
    for found, name in ((road.lane_count, "lane_count"), (road.main_lane_count, "main_lane_count")):
        assert found.tolist() == [getattr(side, name) for side in sides]
    assert road.speed_limit_mps == pytest.approx([side.speed_limit_mps for side in sides])
    assert road.grade == pytest.approx([side.grade for side in sides], abs=1e-5)
    exits = [road.lane_ids.index(f"TL2{name}_0") for name in road.exits]
    assert road.lane_siblings[exits].tolist() == [spec.leg(name).exit_lanes for name in road.exits]
    lengths = np.array([side.length_m for side in sides])
    if spec.source == "procedural":  # node to node
        assert ((lengths - 40.0 < road.lane_length_m) & (road.lane_length_m < lengths)).all()
    else:
        assert road.lane_length_m == pytest.approx(lengths, abs=0.01)
        assert road.lane_length[exits] == pytest.approx([spec.leg(name).exit_length_m for name in road.exits], abs=0.01)
    drive = drive_everywhere(net, road, tmp_path)
    assert drive.warnings == [] and drive.arrived == drive.sent > 0


def test_sources_have_the_length_that_the_ghosts_give(cache):
    ghosts = GhostSpec(straight_source_length_m=246.0)
    for source, slack_m in (("osm", 0.01), ("procedural", 30.0)):
        net = build_net(intersection(ghosts=ghosts, source=source), cache)
        lanes = {lane.get("id"): float(lane.get("length")) for lane in ElementTree.parse(net).iter("lane")}
        assert lanes["AB2A_0"] == pytest.approx(246.0, abs=slack_m)
        assert lanes["AA2A_0"] == pytest.approx(300.0, abs=slack_m)


@pytest.mark.parametrize("grade", [0.05, -0.12])
def test_vehicles_see_the_grade(grade, cache, tmp_path):
    spec = intersection(CROSS, 3, 2, grade=grade, **POCKETS)
    net = build_net(spec, cache)
    drive_everywhere(
        net, read_road(net), tmp_path, "--fcd-output", "fcd.xml", "--fcd-output.attributes", "lane,pos,slope"
    )
    seen: dict[str, set[float]] = {}
    for vehicle in ElementTree.parse(tmp_path / "fcd.xml").iter("vehicle"):
        edge = vehicle.get("lane").rsplit("_", 1)[0]
        # A vehicle whose rear is still on the lane before lies on both slopes.
        if float(vehicle.get("pos")) > 10.0:
            seen.setdefault(edge, set()).add(math.tan(math.radians(float(vehicle.get("slope")))))
    for edge, expected in (("A2TL", grade), ("A2TL_intern", grade), ("TL2A", -grade), ("AB2A", 0.0), ("AA2A", 0.0)):
        # SUMO prints slopes in hundredths of a degree.
        assert sorted(seen[edge]) == pytest.approx([expected] * len(seen[edge]), abs=1e-4), edge


def test_signals_show_the_plan_and_the_offsets(cache, tmp_path):
    north_south = tuple((a, b, "G") for a, b in (("A", "C"), ("C", "A")))
    rest = tuple((a, b, "g") for a in "BD" for b in "ABCD" if a != b)
    turns = tuple((a, b, "g") for a, b in (("A", "D"), ("A", "B"), ("C", "B"), ("C", "D")))
    plan = SignalPlan((SignalPhase(20.0, north_south + turns), SignalPhase(30.0, rest)), offset_s=7.0)
    ghosts = GhostSpec(through_green_s=10.0, cross_green_s=20.0, yellow_s=5.0, offset_s=3.0)
    spec = intersection(CROSS, 1, plan=plan, ghosts=ghosts)
    shown = saved_states(build_net(spec, cache), tmp_path, ("TL", "A", "AB"), 90)
    links = signal_links(spec)
    for time_s, state in shown["TL"].items():
        phase = plan.phases[0 if (time_s - 7.0) % 50.0 < 20.0 else 1]
        colours = {(a, b): colour for a, b, colour in phase.states}
        assert state == "".join(colours.get((link.from_leg, link.to_leg), "r") for link in links), time_s
    for time_s, state in shown["A"].items():
        at = (time_s - 3.0) % 40.0
        assert state == ("Gr" if at < 10 else "yr" if at < 15 else "rG" if at < 35 else "ry"), time_s
    for time_s, state in shown["AB"].items():
        assert state == ("G" if time_s < 82 else "y" if time_s < 85 else "r"), time_s


def test_lanes_that_merge_yield_to_the_leftmost(cache, tmp_path):
    spec = intersection(CROSS, 3, 1)
    net = build_net(spec, cache)
    states = saved_states(net, tmp_path, ("TL",), 20)["TL"]
    straight = [index for index, link in enumerate(signal_links(spec)) if link.from_leg == "A" and link.turn == "s"]
    assert [states[0.0][index] for index in straight] == ["g", "G"]


def test_one_way_legs_build_and_drive(cache, tmp_path):
    side = Approach(("rs", "sl"), 200.0, 15.0, 0.0, 3000.0)
    legs = (
        Leg("A", 0.0, None, 2, 200.0, 15.0),
        Leg("B", 90.0, dataclasses.replace(side, lanes=("r", "s")), 0, 0.0, 15.0),
        Leg("C", 180.0, dataclasses.replace(side, lanes=("s", "sl")), 1, 200.0, 15.0),
        Leg("D", 270.0, None, 3, 150.0, 12.0),
    )
    spec = IntersectionSpec("test/one-way", "osm", legs)
    net = build_net(spec, cache)
    road = read_road(net)
    assert (road.approaches, road.exits) == (("B", "C"), ("A", "C", "D"))
    drive = drive_everywhere(net, road, tmp_path)
    assert drive.warnings == []
    assert drive.arrived == drive.sent > 0


def test_only_what_shapes_the_net_is_part_of_its_key():
    given = procedural_intersection()
    assert net_key(given) == net_key(dataclasses.replace(given, name="another"))
    assert net_key(given) == net_key(procedural_intersection(inflow_vph_per_lane=400.0))
    assert net_key(given) != net_key(procedural_intersection(green_s=30.0))
    assert net_key(intersection(aadt=1000.0)) != net_key(intersection(aadt=2000.0))


def test_messages_of_netconvert_reach_the_user(cache, monkeypatch):
    monkeypatch.setitem(netconvert._OPTIONS, "no-such-option", "1")
    with pytest.raises(IzooError, match="no-such-option"):
        build_net(procedural_intersection(lane_length_m=333.0), cache)


def test_nothing_is_written_outside_the_cache(tmp_path, monkeypatch):
    home, here = tmp_path / "home", tmp_path / "here"
    home.mkdir()
    here.mkdir()
    for name in ("HOME", "XDG_CACHE_HOME", "TMPDIR"):
        monkeypatch.setenv(name, str(home))
    monkeypatch.chdir(here)
    build_net(procedural_intersection(), tmp_path / "cache")
    assert list(home.iterdir()) == list(here.iterdir()) == []
    assert [path.suffixes for path in (tmp_path / "cache" / "nets").iterdir()] == [[".net", ".xml"]]


def test_a_folder_that_cannot_be_made_is_explained(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(IzooError, match=r"cannot write to the cache folder .* IZOO_CACHE_DIR"):
        cache_folder(tmp_path / "file")
