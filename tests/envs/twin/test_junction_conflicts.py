"""Where ways cross, merge and diverge: against the distances of vehicles to their junction foes in SUMO."""

import itertools
from pathlib import Path

import pytest
from defusedxml import ElementTree

from izoo.contexts.source import ContextList
from izoo.envs.sumo.session import SumoSession, import_libsumo, sumo_arguments
from izoo.envs.twin.junction.foes import id_sorts_before
from izoo.envs.twin.net.conflicts import NOWHERE
from izoo.envs.twin.net.reader import TwinWorld, read_twin_world
from izoo.networks.road import read_road
from tests.envs.twin.crossroads import build_crossroads

Pair = tuple[str, str]
Place = tuple[float, float, float, bool, bool]
"""From the stop line to the conflict, its length, the foe's way to it (m); whether the first and the second yield."""


def distances_of_sumo(net: Path, folder: Path) -> dict[Pair, Place]:
    """Put two vehicles before the junction for every pair of connections and ask SUMO for their conflicts."""
    libsumo, session = import_libsumo(), SumoSession()
    root = ElementTree.parse(net).getroot()
    length = {lane.get("id"): float(lane.get("length")) for lane in root.iter("lane")}
    links = [c for c in root.iter("connection") if c.get("tl") == "TL"]
    found: dict[Pair, Place] = {}
    for pair in itertools.combinations(links, 2):
        starts = [f"{c.get('from')}_{c.get('fromLane')}" for c in pair]
        if starts[0] == starts[1]:
            continue
        lines = ["<routes>"]
        for k, (c, start) in enumerate(zip(pair, starts, strict=True)):
            lines.append(
                f'<vehicle id="{k}" depart="0" departLane="{c.get("fromLane")}" departSpeed="5" '
                f'departPos="{length[start] - 25}"><route edges="{c.get("from")} {c.get("to")}"/></vehicle>'
            )
        routes = folder / "pair.rou.xml"
        routes.write_text("".join([*lines, "</routes>"]))
        session.load(sumo_arguments(net, routes, 1, 0.5))
        for _ in range(2):
            session.advance()
        names = libsumo.vehicle.getIDList()
        if len(names) == 2 and [libsumo.vehicle.getLaneID(name) for name in "01"] == starts:
            to_line = [length[start] - libsumo.vehicle.getLanePosition(str(k)) for k, start in enumerate(starts)]
            for k in (0, 1):
                for _, ego, foe, end, _, lane, other, *yields in libsumo.vehicle.getJunctionFoes(str(k), 200):
                    found[lane, other] = (ego - to_line[k], end - ego, foe - to_line[1 - k], *yields)
    session.close()
    return found


def distances_of_twin(world: TwinWorld) -> dict[Pair, Place]:
    """Return the same from the twin's tables."""
    net = world.net
    found: dict[Pair, Place] = {}
    for link in range(len(net.links)):
        first, count = net.links[["first_conflict", "conflicts"]][link]
        for conflict in net.conflicts[first : first + count]:
            own, foe = int(net.links["from_lane"][link]), int(conflict["lane"])
            entries = zip((own, foe), (net.links["entry"][link], conflict["entry"]), strict=True)
            vias = [(lane, net.links["via_lane"][entry]) for lane, entry in entries]
            before = [float(net.lanes["length"][via]) if via != lane else 0.0 for lane, via in vias]
            if conflict["to_end"] == 0.0 and conflict["foe_to_end"] == NOWHERE:
                continue  # No place: a vehicle before its waiting point that will merge.
            found[world.lane_ids[own], world.lane_ids[foe]] = (
                before[0] + float(net.lanes["length"][own] - conflict["to_end"]),
                float(conflict["size"]),
                before[1] + float(net.lanes["length"][foe] - conflict["foe_to_end"]),
                bool(conflict["yields"]),
                bool(conflict["foe_yields"]),
            )
    return found


def assert_same_conflicts(net: Path, folder: Path, least: int) -> None:
    theirs = distances_of_sumo(net, folder)
    ours = distances_of_twin(read_twin_world(read_road(net), net))
    common = theirs.keys() & ours.keys()
    assert len(common) >= least
    for pair in common:
        if ours[pair][2] < -NOWHERE / 2:
            assert theirs[pair][2] < -NOWHERE / 2, pair
            continue
        begin, size, foe_begin = theirs[pair][:3]
        crossing = ours[pair][1] > 0.0  # the twin does not need the size of other conflicts
        expected = begin, size if crossing else 0.0, foe_begin
        assert ours[pair][:3] == pytest.approx(expected, abs=2e-3), pair
        assert ours[pair][3:] == theirs[pair][3:], pair


@pytest.mark.parametrize("lanes", [1, 2])
def test_conflicts_of_crossroads_equal_sumos(lanes: int, tmp_path: Path) -> None:
    net = build_crossroads(tmp_path, [(1000.0, "G" * (12 if lanes == 1 else 16))], lanes=lanes)
    assert_same_conflicts(net, tmp_path, 20)


@pytest.mark.slow
def test_conflicts_of_measured_intersections_equal_sumos(dataset: ContextList, tmp_path: Path) -> None:
    paths = sorted({str(context.intersection.net_path) for context in dataset})
    for path in paths[1:4]:
        assert_same_conflicts(Path(path), tmp_path, 4)


def test_ids_are_compared_as_text() -> None:
    numbers = [0, 1, 2, 9, 10, 11, 19, 44, 98, 99, 100, 104, 161, 440, 999, 1000, 1044, 9999, 10000]
    for one, other in itertools.permutations(numbers, 2):
        assert bool(id_sorts_before(one, other)) == (str(one) < str(other)), (one, other)
