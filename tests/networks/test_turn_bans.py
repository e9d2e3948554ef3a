"""Turn restrictions: from and to ways inside a junction, several of them, and those that are not meant for cars."""

from pathlib import Path

import pytest

from tests.networks.test_osm import METRE, Map, approach, build

pytest.importorskip("osmium", reason="reading OpenStreetMap needs the extra izoo[osm]")

WEST, EAST, NORTH, SOUTH, MIDDLE = 22, 20, 26, 24, 25
"""Arriving carriageways of the main street, the side street on both sides, and between the carriageways."""
TO_WEST, TO_EAST = 21, 23


def dual_carriageway(lon: float = 0.0, lat: float = 0.0) -> Map:
    """A main street with two carriageways 16 m apart, crossed by a side street; legs A north, B east, C south, D west.

    Args:
        lon, lat: where it lies, in degrees.
    """
    plan = Map()
    places = [(0, 8), (0, -8), (200, 8), (-200, 8), (200, -8), (-200, -8), (0, 200), (0, -200)]
    for number, (x, y) in enumerate(places, start=1):
        signal = {"highway": "traffic_signals"} if number < 3 else {}
        plan.node(number, x + lon / METRE, y + lat / METRE, **signal)
    for number, nodes in ((EAST, [3, 1]), (TO_WEST, [1, 4]), (WEST, [6, 2]), (TO_EAST, [2, 5])):
        plan.way(number, nodes, oneway="yes", lanes="2", name="Main")
    for number, nodes in ((SOUTH, [8, 2]), (MIDDLE, [2, 1]), (NORTH, [1, 7])):
        plan.way(number, nodes, lanes="2", name="Side")
    return plan


def rule(plan: Map, kind: str, start: list[int], via: str, end: list[int], **tags: str) -> None:
    """Add a restriction; ``via`` is a type and an id such as ``node 2``."""
    members = [("way", way, "from") for way in start] + [("way", way, "to") for way in end]
    members.append((*via.split(), "via"))  # type: ignore[arg-type]
    inner = "".join(f'<member type="{type_}" ref="{ref}" role="{role}"/>' for type_, ref, role in members)
    key, _, value = kind.rpartition("=")
    named = {"type": "restriction", key or "restriction": value, **tags}
    inner += "".join(f'<tag k="{name}" v="{text}"/>' for name, text in named.items())
    plan.relations.append(f'<relation id="{900 + len(plan.relations)}">{inner}</relation>')


def turns(plan: Map, tmp_path: Path) -> dict[str, str]:
    spec, _ = build(plan, tmp_path)
    return {leg: "".join(t for t in "rsl" if any(t in lane for lane in approach(spec, leg).lanes)) for leg in "ABCD"}


ALL = dict.fromkeys("ABCD", "rsl")


@pytest.mark.parametrize(
    ("rules", "banned"),
    [
        ([], {}),
        # To a way inside the junction, from one, and past one.
        ([("no_left_turn", [WEST], "node 2", [MIDDLE])], {"D": "rs"}),
        ([("no_left_turn", [MIDDLE], "node 1", [TO_WEST])], {"C": "rs"}),
        ([("no_left_turn", [MIDDLE], "node 2", [TO_EAST])], {"A": "rs"}),
        ([("no_right_turn", [EAST], "node 1", [NORTH])], {"B": "sl"}),
        ([("no_straight_on", [SOUTH], "node 2", [MIDDLE])], {"C": "r"}),
        ([("no_straight_on", [MIDDLE], "node 1", [NORTH])], {"C": "rl", "D": "rs"}),
        ([("no_left_turn", [WEST], f"way {MIDDLE}", [NORTH])], {"D": "rs"}),
        ([("no_u_turn", [WEST], f"way {MIDDLE}", [TO_WEST])], {}),
        # Orders, one and several.
        ([("only_straight_on", [WEST], "node 2", [TO_EAST])], {"D": "s"}),
        (
            [
                ("only_straight_on", [WEST], "node 2", [TO_EAST]),
                ("only_right_turn", [WEST], "node 2", [SOUTH]),
            ],
            {"D": "rs"},
        ),
        ([("only_straight_on", [MIDDLE], "node 1", [NORTH])], {"C": "rs"}),
        # Several ways.
        ([("no_exit", [WEST], "node 2", [MIDDLE, TO_EAST])], {"D": "r"}),
        ([("no_entry", [EAST, MIDDLE], "node 1", [NORTH])], {"B": "sl", "C": "rl", "D": "rs"}),
        # Whom they are for.
        ([("restriction:motorcar=no_left_turn", [WEST], "node 2", [MIDDLE])], {"D": "rs"}),
        ([("restriction:motor_vehicle=no_left_turn", [WEST], "node 2", [MIDDLE])], {"D": "rs"}),
        ([("restriction:hgv=no_left_turn", [WEST], "node 2", [MIDDLE])], {}),
        ([("restriction:conditional=no_left_turn @ (Mo-Fr 7-9)", [WEST], "node 2", [MIDDLE])], {}),
    ],
)
def test_movements_are_followed_through_the_junction(
    tmp_path: Path, rules: list[tuple[str, list[int], str, list[int]]], banned: dict[str, str]
) -> None:
    plan = dual_carriageway()
    for each in rules:
        rule(plan, *each)
    assert turns(plan, tmp_path) == {**ALL, **banned}


@pytest.mark.parametrize(("except_", "expected"), [("motorcar", "rsl"), ("psv;motorcar", "rsl"), ("psv;bicycle", "rs")])
def test_restrictions_from_which_cars_are_exempt(tmp_path: Path, except_: str, expected: str) -> None:
    plan = dual_carriageway()
    rule(plan, "no_left_turn", [WEST], "node 2", [MIDDLE], **{"except": except_})
    assert turns(plan, tmp_path)["D"] == expected


def test_a_way_that_goes_on_behind_the_junction_is_told_by_the_word(tmp_path: Path) -> None:
    plan = dual_carriageway()
    plan.ways = plan.ways[:4]
    plan.way(SOUTH, [8, 2, 1, 7], lanes="2", name="Side")
    rule(plan, "no_left_turn", [WEST], "node 2", [SOUTH])
    rule(plan, "no_right_turn", [SOUTH], "node 1", [TO_WEST])
    assert turns(plan, tmp_path) == {"A": "sl", "B": "rsl", "C": "rsl", "D": "rs"}


def test_turns_on_red_are_forbidden_where_an_approach_forbids_them(tmp_path: Path) -> None:
    plan = dual_carriageway(-100.0, 40.0)  # in North America
    assert build(plan, tmp_path)[0].right_on_red
    rule(plan, "no_right_turn_on_red", [WEST], "node 2", [SOUTH])
    spec, _ = build(plan, tmp_path)
    assert not spec.right_on_red and "r" in "".join(approach(spec, "D").lanes)
