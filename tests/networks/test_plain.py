"""Plain XML and lane connections, without running anything."""

import pytest
from defusedxml import ElementTree

from izoo.contexts.spec import Approach, GhostSpec, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.connections import signal_links
from izoo.networks.net.plain import plain_net
from izoo.networks.signals.search import search_plan
from tests.networks.worlds import CROSS, intersection, with_approaches


def write(spec: IntersectionSpec, plan: SignalPlan | None = None):
    return plain_net(spec, plan or search_plan(spec))


def paths(spec: IntersectionSpec, leg: str) -> list[tuple[int, str, int]]:
    return [(link.from_lane, link.to_leg, link.to_lane) for link in signal_links(spec) if link.from_leg == leg]


def test_turns_lead_to_the_legs_at_their_side():
    spec = with_approaches(intersection(CROSS, 3), "A", lanes=("r", "s", "l"))
    assert paths(spec, "A") == [(0, "D", 0), (1, "C", 0), (2, "B", 2)]


def test_surplus_lanes_merge_and_lefts_keep_left():
    spec = with_approaches(intersection(CROSS, 2, 2), "A", lanes=("s", "s", "s", "l", "l"))
    assert paths(spec, "A") == [(0, "C", 0), (1, "C", 1), (2, "C", 1), (3, "B", 0), (4, "B", 1)]
    spec = with_approaches(intersection(CROSS, 2, 4), "A", lanes=("rs", "sl"))
    assert paths(spec, "A") == [(0, "D", 0), (0, "C", 0), (1, "C", 1), (1, "B", 3)]


@pytest.mark.parametrize("lane_count", [1, 2, 3, 5])
def test_several_exits_in_one_turn_are_all_reached_without_crossing(lane_count):
    # Legs B and C both lie to the left of A, D and E to its right.
    spec = with_approaches(intersection((0.0, 72.0, 110.0, 250.0, 288.0), 2), "A", lanes=("r",) * lane_count)
    reached = paths(spec, "A")
    assert {leg for _, leg, _ in reached} == {"D", "E"}
    assert {lane for lane, _, _ in reached} == set(range(lane_count))
    # E is the sharper turn, so its lanes lie to the right of those that lead to D.
    assert max(lane for lane, leg, _ in reached if leg == "E") <= min(lane for lane, leg, _ in reached if leg == "D")


FOUR = {"lanes": ("r", "s", "s", "l"), "right_pockets": 1, "left_pockets": 1}
TOO_LONG = with_approaches(intersection(CROSS, 2), "A", **FOUR, pocket_length_m=295.0)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (with_approaches(intersection((0.0, 90.0, 180.0), 2), "A", lanes=("rs", "s")), "A may go right, but no leg"),
        (TOO_LONG, r"approach A of 300 m has turn pockets of 295 m"),
        (intersection(CROSS, 1, ghosts=GhostSpec(cross_green_s=0.0)), "ghost"),
        (intersection(CROSS, 1, ghosts=GhostSpec(straight_source_length_m=2.0)), "ghost"),
    ],
)
def test_what_cannot_be_built_is_refused(spec, message):
    with pytest.raises(IzooError, match=message):
        write(spec)


def test_pocket_approaches_are_split():
    plain = write(with_approaches(intersection(CROSS, 2), "A", **FOUR, pocket_length_m=40.0))
    edges = {edge.get("id"): edge.attrib for edge in ElementTree.fromstring(plain.edges)}
    assert (edges["A2TL"]["from"], edges["A2TL"]["to"], edges["A2TL"]["numLanes"]) == ("A", "A_intern", "2")
    assert (edges["A2TL_intern"]["from"], edges["A2TL_intern"]["to"]) == ("A_intern", "TL")
    assert edges["A2TL_intern"]["numLanes"] == "4"
    assert float(edges["A2TL"]["length"]) == 300.0 - 40.0 - 8.0
    joints = {
        (int(c.get("fromLane")), int(c.get("toLane")))
        for c in ElementTree.fromstring(plain.connections)
        if c.get("from") == "A2TL"
    }
    assert joints == {(0, 0), (0, 1), (1, 2), (1, 3)}


def test_names_follow_the_dataset():
    plain = write(intersection(CROSS, 2))
    edges = {edge.get("id") for edge in ElementTree.fromstring(plain.edges)}
    assert {"A2TL", "TL2A", "AB2A", "AA2A", "A2AB", "A2AA", "D2TL", "DB2D"} <= edges
    gateless = write(intersection(CROSS, 2, ghosts=GhostSpec(outer_gates=False)))
    assert not {edge.get("id") for edge in ElementTree.fromstring(gateless.edges)} & {"A2AB", "A2AA"}


def test_legs_lie_at_their_bearings():
    nodes = {
        node.get("id"): (float(node.get("x")), float(node.get("y")))
        for node in ElementTree.fromstring(write(intersection(CROSS, 1)).nodes)
    }
    assert nodes["TL"] == (0.0, 0.0)
    assert nodes["A"][1] > 300.0
    assert nodes["B"][0] > 300.0
    # Who turns right into the approach of A, which heads south, comes from the west.
    assert nodes["AA"][0] < -300.0
    assert nodes["AB"][1] > 600.0


def programs(plain) -> dict[str, list[tuple[float, str]]]:
    return {
        logic.get("id"): [(float(phase.get("duration")), phase.get("state")) for phase in logic]
        for logic in ElementTree.fromstring(plain.signals).findall("tlLogic")
    }


def test_plans_are_spelled_out_by_link():
    every = tuple((a, b) for a in "ABCD" for b in "ABCD" if a != b)
    plan = SignalPlan(
        (
            SignalPhase(12.5, tuple((a, b, "G" if a == "A" else "g") for a, b in every)),
            SignalPhase(3.0, (("A", "C", "y"), ("B", "A", "s"))),
        )
    )
    plain = write(intersection(CROSS, 1), plan)
    names = [(link.from_leg, link.to_leg) for link in plain.links]
    assert len(names) == 12
    (green, first), (yellow, second) = programs(plain)["TL"]
    assert (green, yellow) == (12.5, 3.0)
    assert first == "".join("G" if start == "A" else "g" for start, _ in names)
    assert second == "".join({("A", "C"): "y", ("B", "A"): "s"}.get(name, "r") for name in names)


def test_exits_without_an_approach_have_no_ghost_signal():
    side = Approach(("s",), 100.0, 15.0, 0.0, 100.0)
    legs = (Leg("A", 0.0, side, 0, 0.0, 15.0), Leg("B", 180.0, None, 1, 80.0, 15.0))
    plain = write(IntersectionSpec("test/way", "osm", legs))
    assert set(programs(plain)) == {"TL", "A", "AA", "AB"}
    assert {edge.get("id") for edge in ElementTree.fromstring(plain.edges)} >= {"A2TL", "TL2B"}
