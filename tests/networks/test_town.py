"""What a town's folder holds beyond its streets: signal plans that were given, and edits; and towns that drive left."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from izoo.cli.contexts import CONTEXTS
from izoo.contexts.context import Context
from izoo.contexts.spec import IntersectionSpec
from izoo.errors import IzooError
from izoo.networks.dataset.intersections import load_specs
from izoo.networks.net.build import build_net, net_key
from izoo.networks.osm.extract import build_from_osm
from izoo.networks.osm.streets import left_hand_region
from izoo.networks.road import read_road
from izoo.networks.signals.delay import peak_movements
from izoo.results.store import context_from_dict
from izoo.traffic.sampling import sample_traffic
from tests.conftest import Refused
from tests.networks.test_osm import Map, approach, crossing
from tests.networks.test_osm import build as osm_build

pytest.importorskip("osmium", reason="reading OpenStreetMap needs the extra izoo[osm]")

THROUGH = [[start, end, "G"] for start, end in ("AC", "CA", "AD", "CB")]
LEFTS = [["A", "B", "g"], ["C", "D", "g"]]
CROSS = [[start, end, "G"] for start, end in ("BD", "DB", "BA", "DC")] + [["B", "C", "g"], ["D", "A", "g"]]
PLAN = {
    "offset_s": 12,
    "phases": [
        {"duration_s": 33, "states": THROUGH + LEFTS},
        {"duration_s": 4, "states": [[start, end, "y"] for start, end, _ in THROUGH + LEFTS]},
        {"duration_s": 20.5, "states": CROSS},
        {"duration_s": 4, "states": [[start, end, "y"] for start, end, _ in CROSS]},
    ],
}


def build(tmp_path: Path, plan: Map | None = None, **options: Any) -> IntersectionSpec:
    return osm_build(plan or crossing(), tmp_path, **options)[0]


def edit(file: Path, plan: Any) -> None:
    record = json.loads(file.read_text())
    record["spec"]["signal_plan"] = plan
    file.write_text(json.dumps(record))


def signals_file(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "plans.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("way", ["in the town's file", "in a file of plans"])
def test_a_given_signal_plan_is_played(tmp_path: Path, way: str) -> None:
    if way == "in the town's file":
        assert "signal plan" in build(tmp_path).imputed
        edit(tmp_path / "town" / "1.json", PLAN)
        (spec,) = load_specs(tmp_path / "town")
    else:
        spec = build(tmp_path, signals=signals_file(tmp_path, {"1": PLAN}))
    assert spec.signal_plan is not None and "signal plan" not in spec.imputed
    assert (spec.signal_plan.cycle_s, spec.signal_plan.offset_s) == (61.5, 12.0)
    clock = read_road(build_net(spec)).clock
    assert (clock.cycle_s, clock.offset_s) == (61.5, 12.0)
    assert clock.phase_begin_s.tolist() == [0.0, 33.0, 37.0, 57.5]
    assert [clock.green_s[p, (p + 2) % 4] for p in range(4)] == [33.0, 20.5, 33.0, 20.5]


def changed(**fields: Any) -> dict[str, Any]:
    return {**PLAN, "phases": [{**PLAN["phases"][0], **fields}, *PLAN["phases"][1:]]}  # type: ignore[index, misc]


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (changed(duration_s=0), "phase 0 of its plan lasts 0.0 s"),
        (changed(duration_s="33"), "a signal plan has the form .*'33' is not a number"),
        (changed(states=[["A", "C"]]), "a signal plan has the form"),
        (changed(states=[["A", "C", "green"]]), "phase 0 shows 'green'; choose one of: G, g, y, s, r"),
        (changed(states=[*THROUGH, *LEFTS, ["A", "A", "G"]]), "names the movement A to A, which no lane serves"),
        (changed(states=[*THROUGH, ["C", "D", "g"]]), "the movement A to B is never green"),
        (changed(states=[*THROUGH, *LEFTS, ["B", "D", "G"]]), "shows G to A to C and to B to D, which cross; show g"),
        ({"phases": []}, "has no phases"),
        ([], "a signal plan has the form"),
        ({**PLAN, "cycle_s": 60}, "this one has 'cycle_s' as well"),
    ],
)
def test_plans_that_cannot_be_shown(tmp_path: Path, plan: Any, message: str) -> None:
    build(tmp_path)
    edit(tmp_path / "town" / "1.json", plan)
    with pytest.raises(IzooError, match=rf"1\.json: .*{message}"):
        load_specs(tmp_path / "town")
    with pytest.raises(IzooError, match=rf"plans\.json, 1: .*{message}"):
        build_from_osm(tmp_path / "map.osm", target=tmp_path / "other", signals=signals_file(tmp_path, {"1": plan}))
    assert not (tmp_path / "other").exists()


def test_files_of_plans_that_do_not_fit(tmp_path: Path) -> None:
    for text, message in (
        (json.dumps({"7": PLAN}), "a signal plan for '7', which is not an intersection .* choose among 1"),
        (json.dumps([PLAN]), "no plans by inters"),
        ("{", "are not JSON"),
    ):
        (tmp_path / "plans.json").write_text(text)
        with pytest.raises(IzooError, match=message):
            build(tmp_path, signals=tmp_path / "plans.json")
    with pytest.raises(IzooError, match="cannot read the signal plans"):
        build(tmp_path, signals=tmp_path / "none.json")


def test_a_build_never_replaces_what_was_edited(tmp_path: Path, refused: Refused) -> None:
    build(tmp_path)
    build(tmp_path)
    file = tmp_path / "town" / "1.json"
    edit(file, PLAN)
    before = file.read_bytes()
    words = ["build", "--osm", str(tmp_path / "map.osm"), str(tmp_path / "town")]
    refused(CONTEXTS.main, words, "1.json has been edited since it was built")
    assert file.read_bytes() == before
    file.unlink()
    build(tmp_path)
    assert load_specs(tmp_path / "town")[0].signal_plan is None


COUNTS = "intersection,from,to,vph\n1,D,A,30\n1,D,B,300\n1,D,C,70\n1,A,C,40\n"


def counts_file(tmp_path: Path, text: str = COUNTS) -> Path:
    path = tmp_path / "counts.csv"
    path.write_text(text)
    return path


def test_turning_counts_are_played(tmp_path: Path) -> None:
    """As many vehicles come, and turn as often, as were counted; other approaches keep what they had."""
    before = build(tmp_path)
    spec = build(tmp_path, counts=counts_file(tmp_path))
    west, north = approach(spec, "D"), approach(spec, "A")
    assert west.aadt_per_lane * 0.084 * west.main_lane_count == pytest.approx(400.0)
    assert dict(west.exit_counts) == {"A": 30.0, "B": 300.0, "C": 70.0}
    assert dict(north.exit_counts) == {"C": 40.0}
    assert approach(spec, "B") == approach(before, "B")
    assert not {"AADT of D", "AADT of A"} & set(spec.imputed) and "AADT of B" in spec.imputed
    road = read_road(build_net(spec))
    traffic = sample_traffic(Context(spec), road, 1, 36_000.0)
    of_west = traffic.exit[traffic.approach == road.approaches.index("D")]
    shares = {road.exits[q]: float((of_west == q).mean()) for q in set(of_west.tolist())}
    assert shares == pytest.approx({"A": 0.075, "B": 0.75, "C": 0.175}, abs=0.015)
    assert len(of_west) == pytest.approx(4000, rel=0.05)
    of_north = traffic.exit[traffic.approach == road.approaches.index("A")]
    assert set(of_north.tolist()) == {road.exits.index("C")}
    flows = {(movement.start, movement.end): movement.flow_vph for movement in peak_movements(spec)}
    assert (flows["D", "B"], flows["D", "A"], flows["A", "D"]) == pytest.approx((300.0, 30.0, 0.0))


def test_counts_may_be_edited(tmp_path: Path) -> None:
    plain = Context(build(tmp_path))
    file = tmp_path / "town" / "1.json"
    record = json.loads(file.read_text())
    assert not record["spec"]["legs"][0]["approach"]["exit_counts"]
    record["spec"]["legs"][0]["approach"]["exit_counts"] = [["A", 2]]
    file.write_text(json.dumps(record))
    with pytest.raises(IzooError, match=r"1\.json: no lane serves A to A; choose among A to B"):
        load_specs(tmp_path / "town")
    record["spec"]["legs"][0]["approach"]["exit_counts"] = [["C", 2], ["B", 1]]
    file.write_text(json.dumps(record))
    edited = Context(load_specs(tmp_path / "town")[0])
    side = approach(edited.intersection, "A")
    assert side.exit_counts == (("C", 2.0), ("B", 1.0))
    assert edited.content_hash != plain.content_hash
    assert net_key(edited.intersection) != net_key(plain.intersection), "another plan is best"
    again = context_from_dict(json.loads(json.dumps(dataclasses.asdict(edited))))
    assert again == edited and again.content_hash == edited.content_hash


def test_a_build_shows_what_comes_per_hour(tmp_path: Path) -> None:
    build(tmp_path)
    counts = counts_file(tmp_path, COUNTS + "1,B,D,2500\n")
    report = build_from_osm(tmp_path / "map.osm", target=tmp_path / "town", counts=counts)
    assert "D Main Street (400 veh/h)" in str(report) and "A Side Street (40 veh/h)" in str(report)
    assert "B Main Street (1800 veh/h, cut to 900 per lane)" in str(report)


def test_counts_that_cannot_be_used(tmp_path: Path) -> None:
    header = "intersection,from,to,vph\n"
    for text, message in (
        (f"{header}1,D,D,5", "counts.csv, 1: no lane serves D to D; choose among A to B, A to C"),
        (f"{header}9,D,A,5", "has turning counts for '9', which is not an intersection of the extract; choose among 1"),
        (f"{header}1,D,A,many", "line 2: 'many' is not a usable count"),
        (f"{header}1,D,A,-1", "line 2: '-1' is not a usable count"),
        (f"{header}1,D,A,5\n1,D,A,6", "line 3: 1 has two counts from D to A"),
        ("street,count\n", "needs a header with the columns intersection, from, to, vph"),
    ):
        with pytest.raises(IzooError, match=message):
            build(tmp_path, counts=counts_file(tmp_path, text))
    with pytest.raises(IzooError, match="cannot read the counts"):
        build(tmp_path, counts=tmp_path / "none.csv")
    assert not (tmp_path / "town").exists()


def one_sided(mirror: bool) -> Map:
    """A crossing on which left and right differ in everything; mirrored, as it is drawn where traffic drives left."""
    side = -1 if mirror else 1
    words = {"left": "right", "right": "left"} if mirror else {}

    def by_lane(*lanes: str) -> str:
        listed = ["".join(words.get(word, word) for word in lane.split()) for lane in lanes]
        return "|".join(reversed(listed) if mirror else listed)

    plan = Map()
    plan.node(1, 0, 0, highway="traffic_signals")
    for number, (x, y) in enumerate([(40, 250), (300, 30), (0, -200), (-400, 0)], start=2):
        plan.node(number, side * x, y)
    plan.node(6, side * -60, 0)
    turns = by_lane("left", "through", "through ; right")
    plan.way(10, [5, 6], oneway="yes", lanes="2", name="Main Street", maxspeed="50")
    plan.way(15, [6, 1], oneway="yes", lanes="3", name="Main Street", turn__lanes=turns, maxspeed="50")
    arriving = by_lane("left", "", "")
    plan.way(11, [1, 3], lanes="5", lanes__backward="3", name="East Street", turn__lanes__backward=arriving)
    plan.way(12, [2, 1], lanes="3", name="Up Street")
    plan.way(13, [1, 4], "residential", name="Down Street")
    plan.restriction(f"no_{words.get('right', 'right')}_turn", 13, 11)
    return plan


def test_left_hand_traffic_is_mirrored(tmp_path: Path) -> None:
    """Lanes, turns, pockets, bans and bearings are those of the mirror image, on which traffic drives on the right."""
    (tmp_path / "right").mkdir(), (tmp_path / "left").mkdir()
    right = build(tmp_path / "right", one_sided(mirror=False))
    left = build(tmp_path / "left", one_sided(mirror=True), drives_on="left")
    assert approach(right, "D").lanes == ("rs", "s", "l") and approach(right, "D").left_pockets == 1
    assert approach(right, "C").lanes == ("s",), "right is forbidden, and no street leads away on the left"
    assert [leg.name for leg in left.legs] == [leg.name for leg in right.legs]
    for one, two in zip(left.legs, right.legs, strict=True):
        assert one.bearing_deg == pytest.approx(two.bearing_deg, abs=1e-6)
        assert (one.approach is None) == (two.approach is None) and one.exit_lanes == two.exit_lanes
        if one.approach and two.approach:
            assert {**vars(one.approach), "length_m": 0} == {**vars(two.approach), "length_m": 0}
    assert left.imputed == right.imputed
    record = json.loads((tmp_path / "left" / "town" / "cmdp.json").read_text())
    assert record["mirrored"] == "as given"


def test_london_and_sydney_are_mirrored(faults: Path, tmp_path: Path) -> None:
    report = build_from_osm(faults / "osm" / "london.osm", target=tmp_path / "town")
    assert report.read.mirrored == "Great Britain and Ireland"
    assert "traffic drives on the left there (Great Britain and Ireland): all intersections are mirrored" in str(report)
    (spec,) = load_specs(tmp_path / "town")
    streets = {name: leg for leg, name in next(iter(report.streets.values())).items()}
    assert streets == {"North": "A", "West": "B", "South": "C", "East": "D"}
    # Tagged left|through|through;right: seen in the mirror, the lane on the right turns right.
    assert approach(spec, "B").lanes == ("r", "s", "sl") and not spec.right_on_red
    london = (faults / "osm" / "london.osm").read_text()
    (tmp_path / "sydney.osm").write_text(london.replace('lat="51.', 'lat="-33.').replace('lon="-0.1', 'lon="151.1'))
    assert build_from_osm(tmp_path / "sydney.osm", target=tmp_path / "sydney").read.mirrored == "Australia"
    report = build_from_osm(faults / "osm" / "london.osm", target=tmp_path / "as_it_is", drives_on="right")
    assert report.read.mirrored == "" and "mirrored" not in str(report)


LEFT = [(-0.1, 51.5), (-6.3, 53.3), (1.31, 51.13), (139.7, 35.7), (114.17, 22.3), (77.2, 28.6), (100.5, 13.75)]
LEFT += [(103.85, 1.29), (106.85, -6.2), (151.2, -33.9), (174.8, -36.9), (36.8, -1.3), (18.4, -33.9), (-76.8, 18.0)]
LEFT += [(-58.2, 6.8)]
RIGHT = [(1.86, 50.95), (2.35, 48.86), (129.05, 35.15), (114.06, 22.55), (92.9, 20.14), (102.61, 17.97), (121.0, 14.6)]
RIGHT += [(166.45, -22.3), (30.06, -1.95), (13.2, -8.8), (27.48, -11.66), (-80.2, 25.8), (-52.3, 4.9), (-122.3, 47.6)]


def test_where_traffic_drives_on_the_left() -> None:
    assert [place for place in LEFT if left_hand_region(*place) is None] == []
    assert [place for place in RIGHT if left_hand_region(*place) is not None] == []
