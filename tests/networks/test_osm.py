"""Intersections from OpenStreetMap: hand-made maps with known answers, broken files, and the real extracts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumo

from izoo.contexts.spec import Approach, IntersectionSpec
from izoo.errors import IzooError
from izoo.networks.dataset.intersections import load_dataset, load_specs
from izoo.networks.osm.extract import OsmReport, build_from_osm
from izoo.networks.osm.streets import read_streets

pytest.importorskip("osmium", reason="reading OpenStreetMap needs the extra izoo[osm]")

METRE = 1.0 / 111_194.93
"""One metre in degrees of latitude; the hand-made maps lie on the equator, where longitude is the same."""


class Map:
    """Writes a small extract from nodes in metres and ways with tags."""

    def __init__(self) -> None:
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.relations: list[str] = []

    def node(self, number: int, x: float, y: float, **tags: str) -> int:
        inner = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        self.nodes.append(f'<node id="{number}" lon="{x * METRE:.9f}" lat="{y * METRE:.9f}">{inner}</node>')
        return number

    def way(self, number: int, nodes: list[int], highway: str = "primary", **tags: str) -> None:
        refs = "".join(f'<nd ref="{node}"/>' for node in nodes)
        named = {"highway": highway, **{key.replace("__", ":"): value for key, value in tags.items()}}
        inner = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in named.items())
        self.ways.append(f'<way id="{number}">{refs}{inner}</way>')

    def restriction(self, kind: str, from_way: int, to_way: int) -> None:
        self.relations.append(
            f'<relation id="{len(self.relations) + 1}"><member type="way" ref="{from_way}" role="from"/>'
            f'<member type="way" ref="{to_way}" role="to"/><tag k="type" v="restriction"/>'
            f'<tag k="restriction" v="{kind}"/></relation>'
        )

    def write(self, path: Path) -> Path:
        body = "".join(self.nodes + self.ways + self.relations)
        path.write_text(f'<?xml version="1.0"?><osm version="0.6">{body}</osm>')
        return path


def crossing(*, signal: bool = True, ways: bool = True) -> Map:
    """Main Street (two lanes each way, 40 mph) crosses Side Street; signals 300 m east stop the main street."""
    plan = Map()
    plan.node(1, 0, 0, **({"highway": "traffic_signals"} if signal else {}))
    for number, (x, y) in enumerate([(0, 250), (300, 0), (0, -200), (-400, 0)], start=2):
        plan.node(number, x, y, **({"highway": "traffic_signals"} if number == 3 and signal else {}))
    if ways:
        plan.way(10, [5, 1, 3], lanes="4", maxspeed="40 mph", name="Main Street")
        plan.way(11, [2, 1, 4], "residential", maxspeed="40", name="Side Street")
    return plan


def build(plan: Map | Path, tmp_path: Path, **options: Any) -> tuple[IntersectionSpec, OsmReport]:
    """Build a map into ``town``; return its first intersection as well."""
    extract = plan.write(tmp_path / "map.osm") if isinstance(plan, Map) else plan
    report = build_from_osm(extract, target=tmp_path / "town", **options)
    return load_specs(tmp_path / "town")[0], report


def approach(spec: IntersectionSpec, leg: str) -> Approach:
    found = spec.leg(leg).approach
    assert found is not None
    return found


def test_a_plain_crossing_in_full(tmp_path: Path) -> None:
    spec, report = build(crossing(), tmp_path)
    assert spec.name == "town/1" and spec.source == "osm" and spec.signal_plan is None and spec.city is None
    assert [round(leg.bearing_deg) % 360 for leg in spec.legs] == [0, 90, 180, 270]
    assert report.streets == {"1": {"A": "Side Street", "B": "Main Street", "C": "Side Street", "D": "Main Street"}}
    east, north, west = approach(spec, "B"), approach(spec, "A"), approach(spec, "D")
    assert east.lanes == ("rs", "sl") and north.lanes == ("rsl",)
    assert [east.speed_limit_mps, north.speed_limit_mps] == pytest.approx([17.88, 11.11], abs=0.01)
    assert [east.length_m, west.length_m] == pytest.approx([300.0, 400.0], abs=0.5)
    assert [leg.exit_lanes for leg in spec.legs] == [1, 2, 1, 2]
    assert "length of B" not in spec.imputed and "length of D" in spec.imputed
    assert "lanes of A" in spec.imputed and "lanes of B" not in spec.imputed
    assert {f"{what} of {leg}" for what in ("AADT", "grade") for leg in "ABCD"} <= set(spec.imputed)
    assert len(spec.approach_names) == 4 and report.stray_signals == 1 and "built 1 intersection with" in str(report)
    assert spec.imputed[-1] == "signal plan" and "imputed signal plan: 1 of 1 intersection" in str(report)
    contexts = load_dataset(tmp_path / "town", adoption=0.5)
    assert [context.approach for context in contexts] == ["A", "B", "C", "D"]


def dual_carriageways(gap: float, signals: str) -> Map:
    """Two dual carriageways cross; signals are tagged on the ``nodes`` of the square or on the ``lines`` before it."""
    plan, h = Map(), gap / 2.0
    mark = {"highway": "traffic_signals"} if signals == "nodes" else {}
    for number, (x, y) in enumerate([(-h, h), (h, h), (h, -h), (-h, -h)], start=1):
        plan.node(number, x, y, **mark)
    far, line = 300.0, h + 12.0
    ends = [(-h, far), (h, far), (far, h), (far, -h), (h, -far), (-h, -far), (-far, -h), (-far, h)]
    stops = [(-h, line), None, (line, h), None, (h, -line), None, (-line, -h), None]
    for number, (end, stop) in enumerate(zip(ends, stops, strict=True), start=11):
        plan.node(number, *end)
        if stop is not None:
            plan.node(number + 10, *stop, **({"highway": "traffic_signals"} if signals == "lines" else {}))
    north_south = {"oneway": "yes", "lanes": "2", "name": "Avenue", "maxspeed": "50"}
    east_west = {"oneway": "yes", "lanes": "3", "name": "Boulevard", "maxspeed": "60 km/h"}
    plan.way(1, [11, 21, 1, 4, 16], **north_south)
    plan.way(2, [15, 25, 3, 2, 12], **north_south)
    plan.way(3, [13, 23, 2, 1, 18], **east_west)
    plan.way(4, [17, 27, 4, 3, 14], **east_west)
    return plan


@pytest.mark.parametrize("signals", ["nodes", "lines"])
@pytest.mark.parametrize("gap", [12.0, 30.0, 60.0])
def test_two_dual_carriageways_are_one_intersection(tmp_path: Path, gap: float, signals: str) -> None:
    spec, _ = build(dual_carriageways(gap, signals), tmp_path)
    assert spec.leg_names == ("A", "B", "C", "D") and spec.approach_names == spec.leg_names
    assert [round(leg.bearing_deg) % 360 for leg in spec.legs] == [0, 90, 180, 270]
    assert [approach(spec, leg).lane_count for leg in "ABCD"] == [2, 3, 2, 3]
    assert [leg.exit_lanes for leg in spec.legs] == [2, 3, 2, 3]
    assert approach(spec, "A").lanes == ("rs", "sl") and approach(spec, "B").lanes == ("rs", "s", "sl")
    assert approach(spec, "B").speed_limit_mps == pytest.approx(60 / 3.6)


def test_neighbours_stay_apart_and_bound_each_other(tmp_path: Path) -> None:
    plan = crossing()
    plan.node(6, 300, 150), plan.node(7, 300, -150)
    plan.way(12, [6, 3, 7], "tertiary", name="Third Street")
    report = build_from_osm(plan.write(tmp_path / "map.osm"), target=tmp_path / "town")
    one, two = load_specs(tmp_path / "town")
    assert (one.name, two.name) == ("town/1", "town/3") and report.stray_signals == 0
    assert two.leg_names == ("A", "B", "C")
    assert approach(one, "B").length_m == pytest.approx(300.0, abs=0.5)
    assert approach(two, "C").length_m == pytest.approx(300.0, abs=0.5)


def test_one_way_streets_and_restrictions(tmp_path: Path) -> None:
    plan = Map()
    plan.node(1, 0, 0, highway="traffic_signals")
    for number, (x, y) in enumerate([(0, 200), (200, 0), (0, -200), (-200, 0)], start=2):
        plan.node(number, x, y)
    plan.way(10, [5, 1], lanes="2", name="West")
    plan.way(11, [1, 3], lanes="2", name="East")
    plan.way(12, [2, 1, 4], "residential", oneway="-1", lanes="2", name="Up Street")
    plan.restriction("no_left_turn", 10, 12)
    plan.restriction("no_left_turn", 11, 12)
    spec, _ = build(plan, tmp_path)
    assert spec.approach_names == ("B", "C", "D") and spec.leg("C").exit_lanes == 0 and spec.leg("A").exit_lanes == 2
    assert approach(spec, "C").lanes == ("rs", "sl"), "the street runs from south to north"
    assert approach(spec, "B").lanes == ("rs",)
    assert approach(spec, "D").lanes == ("s",), "left is forbidden, and there is no exit on the right"


def test_turn_pockets_begin_where_the_lanes_do(tmp_path: Path) -> None:
    plan = crossing(ways=False)
    plan.node(8, -60, 0)
    plan.way(9, [5, 8], lanes="3", lanes__forward="2", lanes__backward="1", name="Main Street")
    turns = "left|left|through|right"
    plan.way(10, [8, 1], lanes="5", lanes__backward="1", turn__lanes__forward=turns, name="Main Street")
    plan.way(12, [1, 3], lanes="4", name="Main Street")
    plan.way(11, [2, 1, 4], "residential", name="Side Street")
    spec, _ = build(plan, tmp_path)
    west = approach(spec, "D")
    assert west.lanes == ("r", "s", "l", "l")
    assert (west.right_pockets, west.left_pockets, west.main_lane_count) == (0, 2, 2)
    assert west.pocket_length_m == pytest.approx(60.0, abs=0.2)


def test_a_parallel_turn_lane_belongs_to_its_street(tmp_path: Path) -> None:
    plan = crossing(ways=False)
    plan.node(8, -80, 0), plan.node(9, -20, -15), plan.node(12, 0, -25)
    plan.way(9, [5, 8], oneway="yes", lanes="2", name="Main Street")
    plan.way(10, [8, 1], oneway="yes", lanes="2", turn__lanes="left|through", name="Main Street")
    plan.way(13, [8, 9, 12], oneway="yes", lanes="1", turn__lanes="right", name="Main Street")
    plan.way(12, [1, 3], oneway="yes", lanes="2", name="Main Street")
    plan.way(11, [2, 1, 12, 4], "residential", name="Side Street")
    plan.nodes[-1] = plan.nodes[-1].replace("></node>", '><tag k="highway" v="traffic_signals"/></node>')
    spec, _ = build(plan, tmp_path)
    west = approach(spec, "D")
    assert len(spec.legs) == 4 and west.lanes == ("r", "s", "l")
    assert (west.right_pockets, west.main_lane_count) == (1, 2)


def test_a_direction_without_lanes_for_cars_is_closed(tmp_path: Path) -> None:
    plan = crossing(ways=False)
    plan.way(10, [5, 1], lanes="3", bus__lanes__backward="designated", lanes__backward="1", name="Main Street")
    plan.way(12, [1, 3], lanes="2", oneway="no", oneway__motor_vehicle="yes", name="Main Street")
    plan.way(11, [2, 1, 4], "residential", name="Side Street")
    spec, _ = build(plan, tmp_path)
    assert spec.leg("D").exit_lanes == 0 and approach(spec, "D").lane_count == 2
    assert spec.leg("B").approach is None and spec.leg("B").exit_lanes == 2


@pytest.mark.parametrize("value", ["bus", "psv", "emergency", "bus;taxi", "no", "private"])
def test_streets_without_cars_are_left_out(tmp_path: Path, value: str) -> None:
    plan = crossing(ways=False)
    plan.way(10, [5, 1, 3], lanes="4", name="Main Street")
    plan.way(11, [2, 1], "residential", name="Side Street", motor_vehicle=value, access="yes")
    plan.way(12, [1, 4], "residential", name="Side Street", access="destination;bus")
    spec, _ = build(plan, tmp_path)
    assert spec.leg_names == ("A", "B", "C") and [round(leg.bearing_deg) for leg in spec.legs] == [90, 180, 270]


def test_traffic_counts_by_way_and_by_name(tmp_path: Path) -> None:
    table = tmp_path / "aadt.csv"
    table.write_text("way,name,aadt\n10,,20000\n,side street,3000\n")
    spec, _ = build(crossing(), tmp_path, aadt=table)
    assert approach(spec, "B").aadt_per_lane == 5000.0, "20,000 in both directions, two lanes each"
    assert approach(spec, "A").aadt_per_lane == 1500.0
    assert not any(name.startswith("AADT") for name in spec.imputed)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("way,aadt\n77,100\n", r"names 1 ways .*\(77\)"),
        ("name,aadt\nElm Street,100\n", "Elm Street"),
        ("street,count\nx,1\n", "needs a header"),
        ("", "needs a header"),
        ("way,aadt\n10,many\n", "line 2: 'many'"),
        ("way,aadt\n10,-1\n", "line 2: '-1'"),
        ("way,aadt\nMain Street,5\n", "not the id of a way"),
        ("way,aadt\n-77,100\n", r"names 1 ways .*\(-77\)"),
        ("way,aadt\n,5\n", "is missing"),
        ("way,aadt\n10,5\n10,6\n", "two different values"),
    ],
)
def test_broken_traffic_tables(tmp_path: Path, text: str, words: str) -> None:
    table = tmp_path / "aadt.csv"
    table.write_text(text)
    with pytest.raises(IzooError, match=words):
        build(crossing(), tmp_path, aadt=table)
    assert not (tmp_path / "town").exists()


@pytest.mark.parametrize("after_sumo", [False, True])
def test_grade_from_an_elevation_raster(after_sumo: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rasterio = pytest.importorskip("rasterio", reason="elevation needs the extra izoo[osm]")
    for name in ("PROJ_DATA", "PROJ_LIB"):
        monkeypatch.delenv(name, raising=False)
    size, pixel = 100, 10.0
    east = (np.arange(size) + 0.5) * pixel - size * pixel / 2.0
    heights = np.tile(0.05 * east, (size, 1)).astype("float32")
    path = tmp_path / "dem.tif"
    corner = size * pixel / 2.0 * METRE
    place = rasterio.Affine(pixel * METRE, 0.0, -corner, 0.0, -pixel * METRE, corner)
    profile = {"driver": "GTiff", "height": size, "width": size, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(path, "w", transform=place, **profile) as file:
        file.write(heights, 1)
    if after_sumo:
        # What ``import sumo`` does, once per process.
        for name in ("PROJ_DATA", "PROJ_LIB"):
            monkeypatch.setenv(name, str(Path(sumo.SUMO_HOME, "data", "proj")))
    spec, _ = build(crossing(), tmp_path, elevation=path)
    grades = [approach(spec, leg).grade for leg in "DBA"]
    assert grades[:2] == pytest.approx([0.05, -0.05], abs=1e-3), "uphill coming from the west"
    assert grades[2] == pytest.approx(0.0, abs=1e-4)
    assert not any(name.startswith("grade") for name in spec.imputed)
    with pytest.raises(IzooError, match="does not exist"):
        build(crossing(), tmp_path, elevation=tmp_path / "none.tif")
    path.write_bytes(b"no raster")
    with pytest.raises(IzooError, match="cannot be read as an elevation raster"):
        build(crossing(), tmp_path, elevation=path)


def test_the_binary_format_gives_the_same(tmp_path: Path) -> None:
    import osmium

    plain = crossing().write(tmp_path / "map.osm")
    with osmium.SimpleWriter(str(tmp_path / "map.osm.pbf")) as writer:
        for item in osmium.FileProcessor(str(plain)):
            writer.add(item)
    assert read_streets(plain) == read_streets(tmp_path / "map.osm.pbf")


def test_ways_are_cut_where_nodes_are_missing_and_unpublished_ids_work(tmp_path: Path) -> None:
    plan = Map()
    for number, (x, y) in enumerate([(0, 0), (0, 90), (90, 0), (0, -90), (-90, 0)], start=1):
        plan.node(-number, x, y, **({"highway": "traffic_signals"} if number == 1 else {}))
    plan.way(-1, [-99, -5, -1, -3])
    plan.way(-2, [-2, -1, -4, -98])
    spec, _ = build(plan, tmp_path)
    assert spec.name == "town/-1" and len(spec.legs) == 4


STREET = """<osm version="0.6"><node id="1" lat="0" lon="0"/><node id="2" lat="0.001" lon="0"/>
<way id="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way></osm>"""


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("map.osm", "<osm version='0.6'><node id=", "cannot be read as OpenStreetMap data"),
        ("map.osm", "", "cannot be read as OpenStreetMap data"),
        ("map.osm", STREET.replace('lat="0.001"', 'lat="north"'), "cannot be read as OpenStreetMap data"),
        ("map.osm", "<net/>", "cannot be read as OpenStreetMap data"),
        ("map.osm", '<!DOCTYPE osm [<!ENTITY a "b">]><osm version="0.6"/>', "cannot be read as OpenStreetMap data"),
        ("map.osm.pbf", "not a pbf file at all", "cannot be read as OpenStreetMap data"),
        ("map.osm", "<osm version='0.6'></osm>", "no drivable streets"),
        ("map.txt", "hello", "must end in"),
    ],
)
def test_broken_extracts(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(IzooError, match=words):
        build_from_osm(tmp_path / name, target=tmp_path / "town")
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_extracts_without_intersections(tmp_path: Path) -> None:
    plan = Map()
    plan.node(1, 0, 0), plan.node(2, 100, 0, highway="traffic_signals"), plan.node(3, 200, 0)
    plan.way(1, [1, 2, 3])
    for made, said in (
        (crossing(signal=False), "no usable intersection with traffic signals"),
        (plan, "1 signal nodes"),
    ):
        with pytest.raises(IzooError, match=said):
            build(made, tmp_path)
    with pytest.raises(IzooError, match="does not exist"):
        build_from_osm(tmp_path / "none.osm", target=tmp_path / "town")
    assert not (tmp_path / "town").exists()


def test_a_build_is_replaced_unless_other_files_lie_there(tmp_path: Path) -> None:
    for _ in range(2):
        build(crossing(), tmp_path)
    record = json.loads((tmp_path / "town" / "1.json").read_text())
    assert "OpenStreetMap" in record["attribution"] and record["streets"]["B"] == "Main Street"
    (tmp_path / "town" / "notes.txt").write_text("mine")
    with pytest.raises(IzooError, match=r"holds other files \(notes\.txt\)"):
        build(crossing(), tmp_path)


EXTRACTS = {
    "quad_intersection": {"29449863": "Montlake Boulevard East", "7010447307": "Montlake Boulevard East"},
    "roosevelt_cycletrack": {
        "53079358": "Northeast 45th Street",
        "53162654": "Northeast 50th Street",
        "53162656": "Northeast 50th Street",
        "53222750": "Northeast 47th Street",
    },
    "tempe_split": {"41662590": "South Mill Avenue"},
    "west_oakland": {"53131081": "Wood Street"},
}


@pytest.mark.parametrize("name", EXTRACTS)
def test_real_extracts(data: Path, tmp_path: Path, name: str) -> None:
    report = build_from_osm(data / "osm" / f"{name}.osm", target=tmp_path / name)
    assert set(report.streets) == set(EXTRACTS[name]) and report.skipped == {}
    for key, street in EXTRACTS[name].items():
        assert street in report.streets[key].values()
    for spec in load_specs(tmp_path / name):
        assert 3 <= len(spec.legs) <= 4 and spec.right_on_red
        for leg in spec.legs:
            if leg.approach is not None:
                assert 50.0 <= leg.approach.length_m <= 680.0 and 1 <= leg.approach.lane_count <= 5
                assert 8.0 <= leg.approach.speed_limit_mps <= 27.0
    if name == "tempe_split":
        assert approach(spec, "A").lanes == ("r", "s", "s", "l", "l") and len(spec.approach_names) == 4
