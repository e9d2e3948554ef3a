"""What drivers do, counted from scenes that are made by hand.

A's left turn is green from 7 s for 30 s, yielding, and from 40 s for 6 s with priority; B's right is ``s``.
"""

import math

import numpy as np
import pytest

from izoo.benchmarks.fidelity.driving_statistics import COUNTS, DrivingStatistics, rates
from izoo.contexts.procedural import procedural_context
from izoo.envs.mdp.snapshot import Scene
from izoo.networks.road import RoadNet

Row = tuple[str, float, float]
"""Lane, position (m) and speed (m/s)."""
TO_C, TO_B, FROM_B_TO_A = (0, 2), (0, 1), (1, 0)
"""Movements: straight on and to the left from A, and to the right from B."""


def scene(road: RoadNet, time_s: float, movements: dict[int, tuple[int, int]], rows: dict[int, Row]) -> Scene:
    columns = {
        "vehicle_number": list(rows),
        "region_lane": [road.lane_ids.index(lane) for lane, _, _ in rows.values()],
        "lane_position_m": [position for _, position, _ in rows.values()],
        "speed_mps": [speed for _, _, speed in rows.values()],
        "approach": [movements[vehicle][0] for vehicle in rows],
        "exit": [movements[vehicle][1] for vehicle in rows],
    }
    vehicles = {name: np.array(column) for name, column in columns.items()}
    return Scene(procedural_context(), road, time_s, vehicles, np.zeros((2, 3)), np.zeros((2, 1)))


def counted(
    road: RoadNet, movements: dict[int, tuple[int, int]], *moments: tuple[float, dict[int, Row]]
) -> DrivingStatistics:
    driving = DrivingStatistics()
    for time_s, rows in moments:
        driving.add(scene(road, time_s, movements, rows))
    return driving


def of(driving: DrivingStatistics) -> dict[str, float]:
    """Return the counts that are not 0."""
    return {name: count for name, count in driving.counts().items() if count}


@pytest.mark.parametrize(
    ("movement", "lane", "inside", "time_s", "expected"),
    [
        (TO_B, "A2TL_intern_2", ":TL_2_0", 10.0, "passed_left_permissive"),
        (TO_B, "A2TL_intern_2", ":TL_2_0", 42.0, "passed_left_priority"),
        (TO_B, "A2TL_intern_2", ":TL_2_0", 38.0, "passed_left_yellow"),
        (TO_C, "A2TL_intern_0", ":TL_0_0", 36.0, "passed_straight_priority"),
        (TO_C, "A2TL_intern_0", ":TL_0_0", 36.5, "passed_straight_priority"),
        (TO_C, "A2TL_intern_0", ":TL_0_0", 37.0, "passed_straight_yellow"),
        (FROM_B_TO_A, "B2TL_0", ":TL_4_0", 10.0, "passed_right_red"),
        (FROM_B_TO_A, "B2TL_0", ":TL_4_0", 50.0, "passed_right_priority"),
    ],
)
def test_vehicles_that_pass_on_each_signal(
    road: RoadNet, movement: tuple[int, int], lane: str, inside: str, time_s: float, expected: str
) -> None:
    before, after = {5: (lane, 90.0, 8.0)}, {5: (inside, 2.0, 8.0)}
    assert of(counted(road, {5: movement}, (time_s, before), (time_s + 0.5, after))) == {expected: 1}


def test_changes_of_lane_by_reason_and_place(road: RoadNet) -> None:
    movements = {1: TO_B, 2: TO_C, 3: TO_C}
    before = {1: ("A2TL_intern_1", 5.0, 9.0), 2: ("A2TL_intern_1", 20.0, 9.0), 3: ("TL2C_0", 9.0, 9.0)}
    after = {1: ("A2TL_intern_2", 9.0, 9.0), 2: ("A2TL_intern_0", 24.0, 9.0), 3: ("TL2C_1", 13.0, 9.0)}
    found = of(counted(road, movements, (10.0, before), (10.5, after)))
    assert found == {"changes_needed_approach": 1, "changes_right_approach": 1, "changes_left_exit": 1}


def test_going_on_to_the_next_edge_changes_nothing(road: RoadNet) -> None:
    before, after = {1: ("A2TL_0", 99.0, 9.0), 2: ("A2TL_0", 50.0, 9.0)}, {1: ("A2TL_intern_0", 2.0, 9.0)}
    found = of(counted(road, {1: TO_C, 2: TO_C, 3: TO_C}, (10.0, before), (10.5, after | {3: ("A2TL_0", 0.5, 9.0)})))
    assert found == {}


def leaving(at_s: dict[int, float], time_s: float) -> dict[int, Row]:
    """Return six vehicles that stand in a queue until each is over the line."""
    return {
        vehicle: (":TL_0_0", 1.0, 5.0) if time_s >= left else ("A2TL_intern_0", 50.0 - 7.5 * vehicle, 0.0)
        for vehicle, left in at_s.items()
    }


def test_how_a_queue_leaves(road: RoadNet) -> None:
    """Straight on is green from 72 s."""
    at_s = dict(enumerate([73.0, 75.5, 77.5, 79.0, 81.0, 83.5]))
    moments = [(time_s, leaving(at_s, time_s)) for time_s in np.arange(70.0, 90.0, 0.5).tolist()]
    found = of(counted(road, dict.fromkeys(at_s, TO_C), *moments))
    assert found == {"passed_straight_priority": 6, "queues": 1, "start_up_s": 1.0, "headways": 2, "headway_s": 4.5}
    said = rates(dict.fromkeys(COUNTS, 0.0) | found)
    assert said["saturation_flow_vph"] == 1600.0 and said["start_up_lag_s"] == 1.0 and said["passed"] == 6
    assert math.isnan(rates(dict.fromkeys(COUNTS, 0.0))["start_up_lag_s"])


def test_later_vehicles_are_not_of_the_queue(road: RoadNet) -> None:
    at_s = {0: 73.0, 1: 75.5, 2: 120.0}  # the third waits for the next green
    moments = [(time_s, leaving(at_s, time_s)) for time_s in np.arange(70.0, 125.0, 0.5).tolist()]
    passing = {7: ("A2TL_intern_0", 3.0, 9.0)}
    moments = [(time_s, rows | (passing if 74.0 < time_s < 76.0 else {})) for time_s, rows in moments]
    found = of(counted(road, dict.fromkeys([*at_s, 7], TO_C), *moments))
    assert found["queues"] == 1 and found["start_up_s"] == 1.0 and "headways" not in found


def test_a_green_that_yields_begins_no_queue(road: RoadNet) -> None:
    standing, gone = {1: ("A2TL_intern_2", 50.0, 0.0)}, {1: (":TL_2_0", 1.0, 3.0)}
    moments = [(71.0, standing), (71.5, standing), (72.0, standing), (72.5, standing), (73.0, gone)]
    assert of(counted(road, {1: TO_B}, *moments)) == {"passed_left_permissive": 1}
