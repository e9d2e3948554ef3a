"""Reading a net into arrays: a hand-written one number by number, and the lanes that real ones must all have."""

import os
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.source import ContextList
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet, read_road
from izoo.networks.turning import LEFT, RIGHT, STRAIGHT
from tests.networks.handmade import HANDMADE_NET, write_handmade

A_LANES = ("A2TL_0", "A2TL_1", ":S_0_0", ":S_0_1", ":S_0_2", "A2TL_intern_0", "A2TL_intern_1", "A2TL_intern_2")


def lane(road: RoadNet, name: str) -> int:
    return road.lane_ids.index(name)


def lanes(road: RoadNet, values: np.ndarray) -> list[str | None]:
    return [None if value < 0 else road.lane_ids[value] for value in values]


def test_legs_and_movements(road: RoadNet) -> None:
    assert road.approaches == ("A", "B") and road.exits == ("A", "B", "C")
    assert road.incoming_edges == (("A2TL", "A2TL_intern"), ("B2TL",))
    assert road.outgoing_edge == ("TL2A", "TL2B", "TL2C")
    assert road.sources == ({"AB": "AB2A", "AA": "AA2A"}, {"AB": "BB2B"})
    assert road.source_lanes == ({"AB": (0, 1), "AA": (0,)}, {"AB": (0,)})
    assert road.movement_turn.tolist() == [[-1, LEFT, STRAIGHT], [RIGHT, -1, LEFT]]
    assert road.movement_links.tolist() == [[0, 1, 2], [1, 0, 1]]
    assert road.main_lane_count.tolist() == [2, 1] and road.lane_count.tolist() == [3, 1]
    assert road.lane_length_m.tolist() == [301.0, 150.0]
    assert road.speed_limit_mps.tolist() == [15.0, 12.0]
    assert road.grade == pytest.approx([0.01, 0.0])


def test_every_lane_of_the_region_and_no_other(road: RoadNet) -> None:
    inside = (":TL_0_0", ":TL_0_1", ":TL_2_0", ":TL_9_0", ":TL_4_0", ":TL_5_0")
    leaving = ("TL2A_0", "TL2B_0", "TL2C_0", "TL2C_1")
    where = dict(zip(road.lane_ids, road.lane_location.tolist(), strict=True))
    expected = dict.fromkeys((*A_LANES, "B2TL_0"), APPROACHING) | dict.fromkeys(inside, INSIDE)
    assert where == expected | dict.fromkeys(leaving, LEAVING)


def test_path_offsets(road: RoadNet) -> None:
    before = {"A2TL_0": -301.0, "A2TL_1": -301.0, ":S_0_2": -101.0, "A2TL_intern_2": -100.0, "B2TL_0": -150.0}
    expected = {name: (offset_m, 0.0) for name, offset_m in before.items()} | {"TL2C_1": (0.0, 0.0)}
    expected |= {":TL_0_1": (0.0, 20.0), ":TL_2_0": (0.0, 20.0), ":TL_9_0": (8.0, 20.0), ":TL_5_0": (0.0, 14.0)}
    for name, numbers in expected.items():
        found = road.lane_offset_m[lane(road, name)], road.inside_length_m[lane(road, name)]
        assert found == pytest.approx(numbers), name


def test_what_comes_after_and_before(road: RoadNet) -> None:
    after = {
        "A2TL_0": [None, None, ":S_0_0"],
        "A2TL_1": [None, ":S_0_2", ":S_0_1"],
        ":S_0_1": [None, None, "A2TL_intern_1"],
        ":S_0_2": [None, "A2TL_intern_2", None],
        "A2TL_intern_1": [None, None, ":TL_0_1"],
        "A2TL_intern_2": [None, ":TL_2_0", None],
        ":TL_2_0": [None, ":TL_9_0", None],
        "B2TL_0": [":TL_4_0", None, ":TL_5_0"],
        "TL2B_0": [None, None, None],
    }
    before = {
        "A2TL_1": [None, None],
        ":S_0_2": ["A2TL_1", None],
        "A2TL_intern_0": [":S_0_0", None],
        ":TL_9_0": [":TL_2_0", None],
        "TL2B_0": [":TL_9_0", None],
        "TL2C_0": [":TL_0_0", ":TL_5_0"],
        "TL2C_1": [":TL_0_1", None],
    }
    for table, expected in ((road.next_lane, after), (road.prev_lane, before)):
        assert {name: lanes(road, table[lane(road, name)]) for name in expected} == expected


def test_lanes_beside_each_other(road: RoadNet) -> None:
    middle = lane(road, "A2TL_intern_1")
    assert lanes(road, [road.lane_right[middle], road.lane_left[middle]]) == ["A2TL_intern_0", "A2TL_intern_2"]
    assert road.lane_right[lane(road, "A2TL_0")] == road.lane_left[lane(road, "A2TL_1")] == -1
    assert road.lane_siblings[middle] == 3 and road.lane_index[middle] == 1


def test_grade_by_pieces(road: RoadNet) -> None:
    def pieces(name: str) -> list[tuple[float, float]]:
        first, last = road.segment_start[lane(road, name)], road.segment_start[lane(road, name) + 1]
        return [(road.segment_from_m[k], road.segment_grade_pct[k]) for k in range(first, last)]

    assert pieces("A2TL_1") == [(0.0, pytest.approx(1.0))]
    # The drawn lane is a little longer than its nominal 100 m, so the bend lies a little before 50 m.
    ((begin, level), (bend, falling)) = pieces("A2TL_intern_1")
    assert (begin, level) == (0.0, 0.0) and bend == pytest.approx(49.98, abs=0.01) and falling == pytest.approx(-4.0)
    assert pieces("TL2B_0") == [(0.0, 0.0)]


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = write_handmade(tmp_path)
    first = read_road(path)
    assert read_road(path) is first
    path.write_text(HANDMADE_NET.replace('speed="12"', 'speed="11"'))
    os.utime(path, ns=(1, 1))
    assert read_road(path).speed_limit_mps.tolist() == [15.0, 11.0]


def test_every_published_net_is_connected(dataset: ContextList) -> None:
    """From every approach lane some exit can be reached, and every path ends on an exit lane of the right leg."""
    for path in sorted({context.intersection.net_path for context in dataset}):
        road = read_road(path)
        for number, location in enumerate(road.lane_location):
            for q in range(len(road.exits)):
                here, steps = number, 0
                while road.next_lane[here, q] >= 0:
                    here, steps = int(road.next_lane[here, q]), steps + 1
                    assert steps < 12, f"{path}: the way from {road.lane_ids[number]} does not end"
                if steps:
                    assert road.lane_location[here] == LEAVING and road.lane_exit[here] == q
            if location == APPROACHING:
                assert road.lane_offset_m[number] < 0
                assert (road.next_lane[number] >= 0).any(), f"{path}: {road.lane_ids[number]} leads nowhere"
            elif location == INSIDE:
                assert 0 <= road.lane_offset_m[number] < road.inside_length_m[number]
