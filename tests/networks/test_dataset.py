"""The published dataset's folders, and folders broken in every way that a user may meet."""

import csv
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.cities.weather import weather
from izoo.contexts.spec import IntersectionSpec
from izoo.errors import IzooError
from izoo.networks.dataset.intersections import (
    find_intersections,
    load_dataset,
    load_intersection,
    natural_key,
    read_inflows,
)
from izoo.networks.road import read_road

TOLERANCES = {"num_lane": 0, "slope": 2e-3, "lane_length": 40.0, "speed_limit": 0.01, "raw_AADT_per_lane": 1e-6}
TOLERANCES |= {"signal_time_ratio": 1e-9, "phase_count": 0}
NET = """<net version="1.9">
    <edge id=":TL_0" function="internal"><lane id=":TL_0_0" index="0" speed="9" length="10" shape="0,5 0,-5"/></edge>
    <edge id="A2TL" from="A" to="TL">
        <lane id="A2TL_0" index="0" speed="13.41" length="100" shape="0,105,5 0,5,0"/>
        <lane id="A2TL_1" index="1" speed="13.41" length="100" shape="3,105,5 3,5,0"/>
    </edge>
    <edge id="TL2B" from="TL" to="B"><lane id="TL2B_0" index="0" speed="10" length="90" shape="5,0 95,0"/></edge>
    <edge id="TL2C" from="TL" to="C"><lane id="TL2C_0" index="0" speed="10" length="80" shape="0,-5 0,-85"/></edge>
    <tlLogic id="TL" type="static" programID="0" offset="4">
        <phase duration="30" state="GgrG"/><phase duration="3" state="yyry"/><phase duration="17" state="rrGs"/>
    </tlLogic>
    <junction id="A" type="traffic_light" x="0" y="105"/><junction id="B" type="dead_end" x="100" y="0"/>
    <junction id="C" type="dead_end" x="0" y="-90"/>
    <junction id="TL" type="traffic_light_right_on_red" x="0" y="0"/>
    <connection from="A2TL" to="TL2C" fromLane="0" toLane="0" via=":TL_0_0" tl="TL" linkIndex="0" dir="s"/>
    <connection from="A2TL" to="TL2C" fromLane="1" toLane="0" tl="TL" linkIndex="1" dir="s"/>
    <connection from="A2TL" to="TL2B" fromLane="1" toLane="0" tl="TL" linkIndex="2" dir="L"/>
    <connection from="A2TL" to="TL2B" fromLane="1" toLane="0" tl="TL" linkIndex="3" dir="t"/>
</net>"""


def write(folder: Path, net: str = NET, inflows: str = "1000\n\n\n") -> Path:
    folder.mkdir(parents=True)
    (folder / "net.net.xml").write_text(net)
    (folder / "inflows.txt").write_text(inflows)
    return folder


def test_reads_a_small_net_in_full(tmp_path: Path) -> None:
    spec = load_intersection(write(tmp_path / "salt-lake-city" / "7"))
    assert (spec.name, spec.city, spec.imputed) == ("salt_lake_city/7", "salt_lake_city", ()) and spec.right_on_red
    assert spec.leg_names == ("A", "B", "C") and spec.approach_names == ("A",)
    approach = spec.leg("A").approach
    assert approach is not None
    assert approach.lanes == ("s", "sl")
    assert approach.grade == pytest.approx(-0.05) and approach.length_m == 100.0 and approach.aadt_per_lane == 1000.0
    assert [leg.bearing_deg for leg in spec.legs] == [0.0, 90.0, 180.0]
    assert spec.signal_plan is not None
    assert spec.signal_plan.cycle_s == 50.0 and spec.signal_plan.offset_s == 4.0
    assert [phase.states for phase in spec.signal_plan.phases] == [
        (("A", "C", "g"), ("A", "B", "G")),
        (("A", "C", "y"), ("A", "B", "y")),
        (("A", "B", "G"),),
    ]


def test_a_net_without_heights_says_so(tmp_path: Path) -> None:
    flat = NET.replace("105,5 0,5,0", "105 0,5").replace("105,5 3,5,0", "105 3,5")
    spec = load_intersection(write(tmp_path / "1", flat))
    assert spec.imputed == ("grade",) and spec.leg("A").approach.grade == 0.0  # type: ignore[union-attr]


def test_every_published_folder_loads(published: Path) -> None:
    folders = find_intersections(published)
    assert len(folders) == 60
    assert [folder.name for folder in folders] == sorted((folder.name for folder in folders), key=natural_key)
    contexts = load_dataset(published, with_demand_only=False)
    assert len(contexts) == 222
    assert len({context.content_hash for context in contexts}) == 222
    whole = load_dataset(published, approaches="all", adoption=0.2)
    assert len(whole) == 60 and {context.adoption for context in whole} == {0.2}
    assert {(context.temperature_c, context.humidity_pct) for context in contexts} == {(20.0, 46.0)}


def test_features_agree_with_the_published_summary(published: Path) -> None:
    """Lanes, limits and demand are those of the summary; the rest differs for reasons that lie in the summary.

    Its lengths are node to node, its slopes those before netconvert smoothed the heights, eight of its approaches have
    0 where ``inflows.txt`` has 10 veh/day, and its green ratios are those of other links wherever pockets or missing
    movements shift the link numbers.
    """
    specs = {folder.name: load_intersection(folder) for folder in find_intersections(published)}
    with (published / "summary.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["num_lane"] != "0"]
    ours = [_features(specs[row["intersection_id"]], row["lane"]) for row in rows]
    gaps = {
        name: np.array([abs(mine - float(row[name])) for mine, row in zip(column, rows, strict=True)])
        for name, column in zip(TOLERANCES, zip(*ours, strict=True), strict=True)
    }
    assert len(rows) == 222
    assert [int((gaps[name] > tolerance).sum()) for name, tolerance in TOLERANCES.items()] == [0, 32, 0, 0, 8, 54, 52]
    assert gaps["slope"].max() < 0.015 and gaps["raw_AADT_per_lane"].max() == 10.0


def test_description_agrees_with_the_arrays_of_the_simulator(published: Path) -> None:
    for folder in find_intersections(published)[::3]:
        spec, road = load_intersection(folder), read_road(folder / "net.net.xml")
        approaches = [leg.approach for leg in spec.legs if leg.approach is not None]
        assert spec.approach_names == road.approaches and spec.net_sha256 == road.sha256
        assert [approach.lane_count for approach in approaches] == road.lane_count.tolist()
        assert [approach.main_lane_count for approach in approaches] == road.main_lane_count.tolist()
        assert [approach.length_m for approach in approaches] == pytest.approx(road.lane_length_m.tolist())
        assert [leg.name for leg in spec.legs if leg.exit_lanes] == list(road.exits)
        assert spec.signal_plan is not None
        for (p, origin), (q, to) in itertools.product(enumerate(road.approaches), enumerate(road.exits)):
            green = [{(origin, to, "G"), (origin, to, "g")} & set(phase.states) for phase in spec.signal_plan.phases]
            shown_s = sum(phase.duration_s for phase, on in zip(spec.signal_plan.phases, green, strict=True) if on)
            assert shown_s == pytest.approx(road.clock.green_s[p, q])


def _features(spec: IntersectionSpec, letter: str) -> tuple[float, ...]:
    """The columns of :data:`TOLERANCES`."""
    approach, plan = spec.leg(letter).approach, spec.signal_plan
    assert approach is not None and plan is not None
    green = [any(f == letter and c in "Gg" for f, _, c in phase.states) for phase in plan.phases]
    ratio = float(np.dot(green, [phase.duration_s for phase in plan.phases])) / plan.cycle_s
    numbers = approach.lane_count, approach.grade, approach.length_m, approach.speed_limit_mps, approach.aadt_per_lane
    return (*numbers, ratio, sum(green))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda net: net.replace('junction id="TL"', 'junction id="X"'), "junction TL"),
        (lambda net: net.replace('tlLogic id="TL"', 'tlLogic id="X"'), "signal program"),
        (lambda net: net.replace('id="A2TL"', 'id="A2X"'), "no junction TL with incoming edges"),
        (lambda net: net.replace('id="TL2', 'id="X2'), "and outgoing ones"),
        (lambda net: net[:-40], "not well-formed XML"),
        (lambda net: "", "not well-formed XML"),
        (lambda net: f'<?xml version="1.0" encoding="foo"?>{net}', "not well-formed XML"),
        (lambda net: net.replace("<net ", "<road ").replace("</net>", "</road>"), "not a SUMO net"),
        (lambda net: '<!DOCTYPE net [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>' + net, "not well-formed XML"),
        (lambda net: net.replace('speed="13.41"', 'speed="fast"'), "not a complete SUMO net"),
        (lambda net: net.replace('speed="13.41"', 'speed="nan"'), "speed limit"),
        (lambda net: net.replace('duration="3"', 'duration="0"'), "positive duration"),
        (lambda net: net.replace('state="yyry"', 'state="yy"'), "fewer states"),
        (lambda net: net.replace('linkIndex="', 'linkIndx="'), "not a complete SUMO net"),
        (lambda net: net.replace('shape="0,105,5 0,5,0"', ""), "not a complete SUMO net"),
    ],
)
def test_broken_nets_are_named(tmp_path: Path, change: Callable[[str], str], words: str) -> None:
    folder = write(tmp_path / "town" / "3", change(NET))
    with pytest.raises(IzooError, match=words) as caught:
        load_dataset(folder.parent)
    assert str(folder / "net.net.xml") in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1000\n2\n", "2 lines for the 3 legs A, B, C"),
        ("", "0 lines for the 3 legs"),
        ("many\n1\n1\n", "line 1: 'many'"),
        ("-5\n1\n1\n", "line 1: '-5'"),
        ("nan\n1\n1\n", "line 1: 'nan'"),
        ("1e9\n1\n1\n", "AADT per lane"),
    ],
)
def test_broken_inflows_are_named(tmp_path: Path, text: str, words: str) -> None:
    folder = write(tmp_path / "town" / "3", inflows=text)
    with pytest.raises(IzooError, match=words) as caught:
        load_intersection(folder)
    assert str(folder) in str(caught.value)


def test_lines_of_outgoing_only_legs_are_ignored_but_keep_their_place(tmp_path: Path) -> None:
    path = tmp_path / "inflows.txt"
    path.write_text("none\n 20 \n30\n")
    assert read_inflows(path, ("A", "B", "C"), frozenset("BC")) == {"B": 20.0, "C": 30.0}
    assert read_inflows(path, ("A", "C"), frozenset("C")) == {"C": 30.0}, "a letter without a leg has a line as well"
    path.write_text("none\n30")
    assert read_inflows(path, ("A", "C"), frozenset("C")) == {"C": 30.0}


def test_missing_places_and_demand_are_named(tmp_path: Path) -> None:
    with pytest.raises(IzooError, match="does not exist"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(IzooError, match="does not exist"):
        load_intersection(tmp_path / "nowhere")
    with pytest.raises(IzooError, match="holds no intersection folders"):
        load_dataset(tmp_path)
    folder = write(tmp_path / "town" / "10")
    with pytest.raises(IzooError, match="not a folder"):
        load_dataset(folder / "net.net.xml")
    (tmp_path / "town" / "9").mkdir()
    with pytest.raises(IzooError, match=r"9 has no net\.net\.xml"):
        load_dataset(tmp_path / "town")
    with pytest.raises(IzooError, match="choose one of: one, all"):
        load_dataset(folder, approaches="every")
    (folder / "inflows.txt").unlink()
    with pytest.raises(IzooError, match=r"inflows\.txt"):
        load_dataset(folder)
    write(tmp_path / "still" / "1", inflows="0\n0\n0\n")
    with pytest.raises(IzooError, match="has demand"):
        load_dataset(tmp_path / "still")
    (context,) = load_dataset(tmp_path / "still", with_demand_only=False)
    assert context.demand_approaches == ()


def test_pockets_left_right_and_on_both_sides(tmp_path: Path) -> None:
    cases = {(1, "rsl"): (1, 1), (1, "sl"): (0, 1), (1, "rs"): (1, 0)}
    cases |= {(2, "ssl"): (0, 1), (2, "rss"): (1, 0), (2, "rssl"): (1, 1)}
    for (main, turns), expected in cases.items():
        folder = write(tmp_path / f"{main}{turns}", pocket_net(main, turns, expected[0]), "100\n0\n0\n0\n")
        approach = load_intersection(folder).leg("A").approach
        assert approach is not None
        assert (approach.right_pockets, approach.left_pockets) == expected
        assert approach.main_lane_count == main and approach.pocket_length_m == 40.0 and approach.length_m == 148.0


def pocket_net(main: int, turns: str, right: int) -> str:
    """A net whose approach A has ``main`` lanes that widen to one lane per letter of ``turns``."""
    target = {"r": "D", "s": "C", "l": "B"}
    lanes = "".join(f'<lane id="A2TL_{i}" speed="15" length="100" shape="{i},150 {i},50"/>' for i in range(main))
    exits = "".join(
        f'<edge id="TL2{leg}"><lane id="TL2{leg}_0" speed="15" length="50" shape="0,0 9,9"/></edge>' for leg in "BCD"
    )
    stop = inner = joints = links = ""
    for j, turn in enumerate(turns):
        start = min(max(j - right, 0), main - 1)
        stop += f'<lane id="A2TL_intern_{j}" speed="15" length="40" shape="{j},42 {j},2"/>'
        inner += f'<lane id=":A_i_0_{j}" speed="15" length="8" shape="0,50 0,42"/>'
        joints += f'<connection from="A2TL" to="A2TL_intern" fromLane="{start}" toLane="{j}" via=":A_i_0_{j}"/>'
        links += f'<connection from="A2TL_intern" to="TL2{target[turn]}" fromLane="{j}" toLane="0"'
        links += f' tl="TL" linkIndex="{j}" dir="{turn}"/>'
    return (
        f'<net><edge id=":A_i_0">{inner}</edge><edge id="A2TL">{lanes}</edge>'
        f'<edge id="A2TL_intern">{stop}</edge>{exits}'
        f'<tlLogic id="TL"><phase duration="30" state="{"G" * len(turns)}"/></tlLogic>'
        f'<junction id="TL" type="traffic_light" x="0" y="0"/>{joints}{links}</net>'
    )


def test_a_city_is_the_same_however_it_is_spelt_and_has_its_weather(tmp_path: Path) -> None:
    for name in ("los-angeles", "los_angeles"):
        write(tmp_path / name / "7")
    one, other = (load_dataset(tmp_path / name)[0] for name in ("los-angeles", "los_angeles"))
    assert one.name == other.name == "los_angeles/7/A" and one.content_hash == other.content_hash
    assert (one.temperature_c, one.humidity_pct) == weather("los_angeles", "summer")
    write(tmp_path / "atlanta" / "7")
    assert load_dataset(tmp_path / "atlanta")[0].temperature_c == 22.8
    assert load_intersection(write(tmp_path / "my-town" / "1")).city is None
