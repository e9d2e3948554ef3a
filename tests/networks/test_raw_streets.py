"""Signals that control no junction, and what else real extracts hold that is easily misread."""

import gzip
from pathlib import Path

import pytest

from izoo.errors import IzooError
from izoo.networks.osm.streets import read_streets
from tests.networks.test_osm import Map, approach, build, crossing

pytest.importorskip("osmium", reason="reading OpenStreetMap needs the extra izoo[osm]")


def side_street(**signal: str) -> Map:
    """The crossing, and 400 m to its west a side street without a signal; 20 m from it one on the main street."""
    plan = crossing(ways=False)
    plan.node(20, -380, 0, highway="traffic_signals", **signal), plan.node(21, -400, -100), plan.node(22, -600, 0)
    plan.way(10, [22, 5, 20, 1, 3], lanes="4", name="Main Street")
    plan.way(11, [2, 1, 4], "residential", name="Side Street")
    plan.way(12, [5, 21], "residential", name="Lane")
    return plan


@pytest.mark.parametrize(
    ("signal", "intersections"),
    [
        ({"traffic_signals": "pedestrian_crossing"}, 1),
        ({"crossing": "traffic_signals"}, 1),
        ({"crossing_ref": "pelican"}, 1),
        ({"traffic_signals": "signal"}, 2),
    ],
)
def test_a_crossing_for_pedestrians_makes_no_intersection(
    tmp_path: Path, signal: dict[str, str], intersections: int
) -> None:
    _, report = build(side_street(**signal), tmp_path)
    assert len(report.streets) == intersections and report.stray_signals == 3 - intersections


def test_stop_lines_that_are_crossings_too_make_one(tmp_path: Path) -> None:
    """Where streets are signalised at their stop lines, these have crossings."""
    plan = side_street(crossing="traffic_signals")
    plan.node(23, -400, -15, highway="traffic_signals", crossing="traffic_signals")
    plan.ways[-1] = plan.ways[-1].replace('<nd ref="5"/>', '<nd ref="5"/><nd ref="23"/>')
    _, report = build(plan, tmp_path)
    assert len(report.streets) == 2


@pytest.mark.parametrize("what", ["blinker", "emergency", "ramp_meter"])
def test_lights_without_a_cycle_make_no_intersection(tmp_path: Path, what: str) -> None:
    plan = side_street(traffic_signals=what)
    _, report = build(plan, tmp_path)
    assert len(report.streets) == 1 and (report.stray_signals, report.read.uncycled) == (1, 1)
    assert "1 signal nodes blink, meter a ramp or wait for emergencies: no cycle" in str(report)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("blinker", "0 signal nodes there, and 1 that blink"),
        ("emergency", "0 signal nodes there, and 1 that blink"),
        ("ped_near", "1 signal nodes there"),
    ],
)
def test_small_extracts_without_an_intersection(faults: Path, tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(IzooError, match=f"no usable intersection with traffic signals .{message}"):
        build(faults / "osm" / f"{name}.osm", tmp_path)


@pytest.mark.parametrize("suffix", [".osm", ".osm.gz"])
def test_what_an_editor_deleted_is_gone(faults: Path, tmp_path: Path, suffix: str) -> None:
    text = (faults / "osm" / "josm_deleted.osm").read_bytes()
    path = tmp_path / f"map{suffix}"
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    spec, _ = build(path, tmp_path)
    assert [round(leg.bearing_deg) for leg in spec.legs] == [0, 90, 270]


def test_two_nodes_in_one_place_do_not_end_a_street(faults: Path, tmp_path: Path) -> None:
    spec, _ = build(faults / "osm" / "samepos.osm", tmp_path)
    assert approach(spec, "D").length_m == pytest.approx(200.0, abs=1.0)
    plan = crossing()
    plan.node(30, 0, 0)
    plan.ways[0] = plan.ways[0].replace('<nd ref="1"/>', '<nd ref="30"/><nd ref="1"/>')
    streets = read_streets(plan.write(tmp_path / "map.osm"))
    assert 30 not in streets.lonlat and 1 in streets.signals and streets.ways[10].nodes == (5, 1, 3)


def test_reversible_streets_are_named(faults: Path, tmp_path: Path) -> None:
    _, report = build(faults / "osm" / "oneway_rev.osm", tmp_path)
    assert report.read.reversible == ("West",)
    assert "taken as two-way, whatever their direction by time: West" in str(report)


@pytest.mark.parametrize(
    ("name", "lanes", "exit_lanes"),
    [
        ("bus_lane", ("s", "l"), 0),
        ("bike_in_turn_lanes", ("r", "s", "l"), 0),
        ("lanes_fwd_turn_only", ("rs", "s", "l"), 2),
        ("dual_noleft_main", ("rs", "s"), 2),
        ("no_exit", ("r",), None),
        ("except_car", ("rsl",), None),
        ("restriction_motorcar", ("rs",), None),
        ("no_rtor", ("rsl",), None),
        ("split_turn", ("rs", "l", "l"), None),
    ],
)
def test_small_extracts(
    faults: Path, tmp_path: Path, name: str, lanes: tuple[str, ...], exit_lanes: int | None
) -> None:
    spec, _ = build(faults / "osm" / f"{name}.osm", tmp_path)
    assert approach(spec, "D").lanes == lanes
    if exit_lanes is not None:
        assert spec.leg("D").exit_lanes == exit_lanes and "lanes of D" not in spec.imputed
    assert spec.right_on_red == (name != "no_rtor")
