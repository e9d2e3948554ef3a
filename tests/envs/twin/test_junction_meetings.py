"""Vehicles that meet at a signal drive on the twin as in SUMO, for many departure times."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, play_sumo, play_twin
from tests.envs.twin.crossroads import assert_same, build_crossroads, lane_names, meeting

pytestmark = pytest.mark.slow
STEPS = 120
PERMISSIVE = [(1000.0, "GGgrrrGGgrrr")]
RIGHT_ON_RED = [(1000.0, "srrGGgsrrGGg")]
CHANGING = [
    (11.0, "GGgrrrGGgrrr"),
    (3.0, "yyyrrryyyrrr"),
    (30.0, "srrGGgsrrGGg"),
    (3.0, "srryyysrryyy"),
    (30.0, "GGgsrrGGgsrr"),
]
ALL_AT_ONCE = [(1000.0, "GGgGGgGGgGGg")]
ONE_RIGHT_ON_RED = [(1000.0, "GGGrrrrrrsrr")]
LEFT_AND_RIGHT_ON_RED = [(1000.0, "rrgrrrsrrrrr")]
LEG_AFTER_LEG = [(9.0, "GGGrrrrrrrrr"), (7.0, "rrrGGGrrrrrr"), (2.0, "rrryyyrrrrrr"), (18.0, "rrrrrrGGGGGG")]
BRIEF = [(11.0, "GGgsrrGGgsrr"), (8.0, "srrGGgsrrGGg"), (3.0, "srryyysrryyy"), (14.0, "GGgsrrGGgsrr")]

MEETINGS: list[tuple[list[tuple[float, str]], list[tuple[float, str]], str, tuple[float, float]]] = [
    (PERMISSIVE, [(0.0, "AB")], "CA", (-4.0, 6.0)),
    (PERMISSIVE, [(0.0, "AB")], "CB", (-4.0, 6.0)),
    (PERMISSIVE, [(0.0, "AB")], "CD", (-4.0, 6.0)),
    (PERMISSIVE, [(0.0, "AB")], "AC", (1.5, 5.0)),
    (PERMISSIVE, [(0.0, "AD")], "AC", (1.5, 5.0)),
    (PERMISSIVE, [(0.0, "AC")], "AB", (1.5, 5.0)),
    (RIGHT_ON_RED, [], "AD", (0.0, 1.0)),
    (RIGHT_ON_RED, [(0.0, "AD")], "BD", (-6.0, 8.0)),
    (RIGHT_ON_RED, [(0.0, "AD")], "DA", (-6.0, 8.0)),
    (RIGHT_ON_RED, [(0.0, "AD"), (2.0, "BD")], "AD", (-6.0, 8.0)),
    (CHANGING, [], "AC", (0.0, 16.0)),
    (CHANGING, [], "AB", (0.0, 16.0)),
    (CHANGING, [], "AD", (0.0, 16.0)),
    (CHANGING, [(6.0, "DB")], "AD", (0.0, 16.0)),
    (CHANGING, [(3.0, "AC"), (5.0, "CA")], "AD", (0.0, 12.0)),
]
"""Signal, vehicles ``(departure, way)``, the way of one more, and the range of its departures (s)."""


@pytest.fixture(scope="module")
def nets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("crossroads")
    plans = {str(plan): plan for plan in (PERMISSIVE, RIGHT_ON_RED, CHANGING, ALL_AT_ONCE, ONE_RIGHT_ON_RED)}
    return {key: build_crossroads(folder / str(k), plan) for k, (key, plan) in enumerate(plans.items())}


def meet(net: Path, others: list[tuple[float, str]], way: str, depart_s: float, **driver: Any) -> Case:
    """Return the case in which one more vehicle departs at ``depart_s``, with all departure times positive."""
    first = min([depart_s, *(depart for depart, _ in others)])
    vehicles = [{"depart": depart - first, "way": other} for depart, other in others]
    return meeting(net, [*vehicles, {"depart": depart_s - first, "way": way, **driver}])


@pytest.mark.parametrize("number", range(len(MEETINGS)))
def test_vehicles_that_meet_drive_as_in_sumo(nets: dict[str, Path], number: int) -> None:
    plan, others, way, (begin, end) = MEETINGS[number]
    for depart_s in np.arange(begin, end + 0.1, 1.0).tolist():
        assert_same(meet(nets[str(plan)], others, way, depart_s), STEPS)


@pytest.mark.parametrize(
    "driver",
    [
        {"tau_s": 1.6, "min_gap_m": 2.8, "accel_mps2": 1.2, "decel_mps2": 2.1},
        {"length_m": 12.0, "min_gap_m": 1.4, "accel_mps2": 0.9, "decel_mps2": 1.6},
        {"tau_s": 0.7, "min_gap_m": 1.0, "accel_mps2": 3.1, "decel_mps2": 5.2},
    ],
)
def test_drivers_of_all_kinds_turn_as_in_sumo(nets: dict[str, Path], driver: dict[str, float]) -> None:
    for plan, other, way in ((PERMISSIVE, "CA", "AB"), (RIGHT_ON_RED, "BD", "AD")):
        for depart_s in np.arange(-4.0, 4.1, 1.0).tolist():
            assert_same(meet(nets[str(plan)], [(0.0, other)], way, depart_s, **driver), STEPS)


@pytest.mark.parametrize("second_s", [5.0, 5.2, 5.4])
def test_right_on_red_yields_to_a_vehicle_that_enters_in_the_same_step(nets: dict[str, Path], second_s: float) -> None:
    assert_same(meet(nets[str(ONE_RIGHT_ON_RED)], [(0.0, "AC"), (second_s, "AC")], "DC", 0.5), 110)


@pytest.mark.parametrize(
    ("first_s", "second_s"), [(1.0, 14.0), (1.0, 17.0), (1.0, 30.0), (2.0, 20.0), (2.0, 26.0), (3.0, 23.0)]
)
def test_waiting_left_turn_yields_to_distant_oncoming_vehicle(tmp_path: Path, first_s: float, second_s: float) -> None:
    """It assumes constant speed of the other, which will stop before its right on red."""
    net = build_crossroads(tmp_path, LEFT_AND_RIGHT_ON_RED, length_m=400.0)
    assert_same(meet(net, [(first_s, "CB"), (first_s + second_s, "CB")], "AB", 0.0), STEPS)


def test_left_turn_yields_to_a_whole_oncoming_platoon(nets: dict[str, Path]) -> None:
    """So the comparisons above do compare vehicles that yield."""
    case = meet(nets[str(PERMISSIVE)], [(1.5 * k, "CA") for k in range(8)], "AB", 0.0)
    turner = int(np.flatnonzero(case.traffic.approach == 0)[0])
    for trace in (play_sumo(case, 160), play_twin(case, 160)):
        names = lane_names(case, trace)
        through = [int(np.flatnonzero(names[:, v] == "TL2A_0")[0]) for v in range(9) if v != turner]
        assert np.flatnonzero(names[:, turner] == "TL2B_0")[0] > max(through) - 2
        assert np.nanmin(trace.speed_mps[:, turner]) < 0.1


@pytest.mark.parametrize(
    ("plan", "driver"),
    [
        (LEG_AFTER_LEG, {"depart": 0.8, "length_m": 6.0, "tau_s": 1.48, "accel_mps2": 2.11, "decel_mps2": 3.27}),
        (BRIEF, {"depart": 1.5, "length_m": 6.0, "tau_s": 0.86, "accel_mps2": 1.21, "decel_mps2": 2.23}),
    ],
)
def test_left_turn_on_yellow_does_not_slow_down_for_the_waiting_point(
    tmp_path: Path, plan: list[tuple[float, str]], driver: dict[str, float]
) -> None:
    case = meeting(build_crossroads(tmp_path, plan), [{"way": "BC", **driver}])
    sumo = assert_same(case, STEPS)
    inside = [name.startswith(":TL_5") for name in lane_names(case, sumo)[:, 0]]
    assert any(inside) and np.nanmin(sumo.speed_mps[inside, 0]) > 4.0


@pytest.mark.parametrize(
    ("turning", "accel_mps2"),
    [
        ({"accel_mps2": 1.73, "decel_mps2": 2.37}, 2.98),
        ({"length_m": 7.1, "accel_mps2": 2.2, "decel_mps2": 2.4}, 1.98),
    ],
)
def test_vehicle_changes_lanes_inside_a_junction_once_the_turning_vehicle_has_diverged(
    tmp_path: Path, turning: dict[str, float], accel_mps2: float
) -> None:
    net = build_crossroads(tmp_path, [(25.0, "r" * 16), (60.0, "r" * 12 + "GGGg")], lanes=2)
    through = {"depart": 3.1, "way": "DB", "lane": 1, "tau_s": 0.96, "accel_mps2": accel_mps2, "decel_mps2": 2.64}
    case = meeting(net, [{"depart": 3.7, "way": "DC", "lane": 0, "tau_s": 1.1, **turning}, through])
    sumo = assert_same(case, STEPS)
    assert {":TL_13_0", ":TL_13_1"} <= set(lane_names(case, sumo)[:, 0])


def test_follower_of_a_turning_vehicle_changes_lanes_to_pass_it(tmp_path: Path) -> None:
    """While the turning vehicle is in the junction, until its rear has diverged."""
    turning = {"depart": 1.3, "way": "DC", "length_m": 6.0, "tau_s": 1.71, "accel_mps2": 1.9, "decel_mps2": 2.8}
    passing = {"depart": 4.6, "way": "DB", "length_m": 7.1, "tau_s": 0.81, "accel_mps2": 1.41, "decel_mps2": 3.98}
    case = meeting(build_crossroads(tmp_path, [(60.0, "r" * 12 + "GGGg")], lanes=2), [turning, passing])
    names = lane_names(case, assert_same(case, STEPS))
    change = np.flatnonzero((names[:-1, 1] == "D2TL_0") & (names[1:, 1] == "D2TL_1"))
    assert len(change) == 1 and names[change[0] + 1, 0] == ":TL_12_0"
