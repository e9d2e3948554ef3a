"""Vehicles that meet at a signal do on the twin what they do in SUMO, whenever one of them departs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, first_departure, play_sumo, play_twin
from tests.envs.twin.crossroads import build_crossroads, meeting

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
    """Return the case in which one more vehicle departs at ``depart_s``, everybody late enough to be positive."""
    first = min([depart_s, *(depart for depart, _ in others)])
    vehicles = [{"depart": depart - first, "way": other} for depart, other in others]
    return meeting(net, [*vehicles, {"depart": depart_s - first, "way": way, **driver}])


@pytest.mark.parametrize("number", range(len(MEETINGS)))
def test_vehicles_that_meet_do_what_they_do_in_sumo(nets: dict[str, Path], number: int) -> None:
    plan, others, way, (begin, end) = MEETINGS[number]
    for depart_s in np.arange(begin, end + 0.1, 1.0).tolist():
        case = meet(nets[str(plan)], others, way, depart_s)
        departure = first_departure(case, play_sumo(case, STEPS), play_twin(case, STEPS))
        assert departure is None, f"{way} at {depart_s} s against {others}: {departure}"


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
            case = meet(nets[str(plan)], [(0.0, other)], way, depart_s, **driver)
            departure = first_departure(case, play_sumo(case, STEPS), play_twin(case, STEPS))
            assert departure is None, f"{way} at {depart_s} s, {driver}: {departure}"


@pytest.mark.parametrize("second_s", [5.0, 5.2, 5.4])
def test_who_enters_the_junction_is_waited_for_to_the_end_of_the_step(nets: dict[str, Path], second_s: float) -> None:
    case = meet(nets[str(ONE_RIGHT_ON_RED)], [(0.0, "AC"), (second_s, "AC")], "DC", 0.5)
    departure = first_departure(case, play_sumo(case, 110), play_twin(case, 110))
    assert departure is None, str(departure)


@pytest.mark.parametrize(
    ("first_s", "second_s"), [(1.0, 14.0), (1.0, 17.0), (1.0, 30.0), (2.0, 20.0), (2.0, 26.0), (3.0, 23.0)]
)
def test_who_has_waited_waits_for_who_comes_from_afar(tmp_path: Path, first_s: float, second_s: float) -> None:
    """He takes the other, who will stop before his right on red, to come at an even speed."""
    net = build_crossroads(tmp_path, LEFT_AND_RIGHT_ON_RED, length_m=400.0)
    case = meet(net, [(first_s, "CB"), (first_s + second_s, "CB")], "AB", 0.0)
    departure = first_departure(case, play_sumo(case, STEPS), play_twin(case, STEPS))
    assert departure is None, str(departure)


def test_a_left_turn_waits_for_every_oncoming_vehicle(nets: dict[str, Path]) -> None:
    """The comparison above would also hold if nobody ever had to wait: here one does, for all of a platoon."""
    platoon = [(1.5 * k, "CA") for k in range(8)]
    case = meet(nets[str(PERMISSIVE)], platoon, "AB", 0.0)
    turner = int(np.flatnonzero(case.traffic.approach == 0)[0])
    for trace in (play_sumo(case, 160), play_twin(case, 160)):
        names = np.array([*case.world.lane_ids, ""])
        through = [int(np.flatnonzero(names[trace.lane[:, v]] == "TL2A_0")[0]) for v in range(9) if v != turner]
        assert np.flatnonzero(names[trace.lane[:, turner]] == "TL2B_0")[0] > max(through) - 2
        assert np.nanmin(trace.speed_mps[:, turner]) < 0.1


@pytest.mark.parametrize(
    ("plan", "way", "driver"),
    [
        (LEG_AFTER_LEG, "BC", {"depart": 0.8, "length_m": 6.0, "tau_s": 1.48, "accel_mps2": 2.11, "decel_mps2": 3.27}),
        (BRIEF, "BC", {"depart": 1.5, "length_m": 6.0, "tau_s": 0.86, "accel_mps2": 1.21, "decel_mps2": 2.23}),
    ],
)
def test_who_comes_by_a_yellow_does_not_slow_down_for_the_waiting_point(
    tmp_path: Path, plan: list[tuple[float, str]], way: str, driver: dict[str, float]
) -> None:
    case = meeting(build_crossroads(tmp_path, plan), [{"way": way, **driver}])
    sumo = play_sumo(case, STEPS)
    departure = first_departure(case, sumo, play_twin(case, STEPS))
    assert departure is None, str(departure)
    # He is in the junction while his signal is yellow, and drives through it.
    inside = [name.startswith(":TL_5") for name in np.array([*case.world.lane_ids, ""])[sumo.lane[:, 0]]]
    assert any(inside) and np.nanmin(sumo.speed_mps[inside, 0]) > 4.0


@pytest.mark.parametrize(
    ("turning", "through"),
    [
        (
            {"depart": 3.7, "way": "DC", "lane": 0, "tau_s": 1.1, "accel_mps2": 1.73, "decel_mps2": 2.37},
            {"depart": 3.1, "way": "DB", "lane": 1, "tau_s": 0.96, "accel_mps2": 2.98, "decel_mps2": 2.64},
        ),
        (
            {
                "depart": 3.7,
                "way": "DC",
                "lane": 0,
                "length_m": 7.1,
                "tau_s": 1.1,
                "accel_mps2": 2.2,
                "decel_mps2": 2.4,
            },
            {"depart": 3.1, "way": "DB", "lane": 1, "tau_s": 0.96, "accel_mps2": 1.98, "decel_mps2": 2.64},
        ),
    ],
)
def test_nobody_changes_inside_to_a_way_that_parts_from_one_beside_it(
    tmp_path: Path, turning: dict[str, float], through: dict[str, float]
) -> None:
    """The way to the left of the one who turns right is free, but its begin is not until he has turned."""
    net = build_crossroads(tmp_path, [(25.0, "r" * 16), (60.0, "r" * 12 + "GGGg")], lanes=2)
    case = meeting(net, [turning, through])
    sumo = play_sumo(case, STEPS)
    departure = first_departure(case, sumo, play_twin(case, STEPS))
    assert departure is None, str(departure)
    names = np.array([*case.world.lane_ids, ""])
    # He who goes through, the first to depart, changes to the right inside the junction.
    assert {":TL_13_0", ":TL_13_1"} <= set(names[sumo.lane[:, 0]])


def test_who_turns_is_in_the_way_until_his_rear_has_parted(tmp_path: Path) -> None:
    """The one behind him drives straight on, and changes lanes to pass him while he is in the junction."""
    turning = {
        "depart": 1.3,
        "way": "DC",
        "lane": 0,
        "length_m": 6.0,
        "tau_s": 1.71,
        "accel_mps2": 1.9,
        "decel_mps2": 2.8,
    }
    passing = {"depart": 4.6, "way": "DB", "lane": 0, "length_m": 7.1, "tau_s": 0.81, "accel_mps2": 1.41}
    net = build_crossroads(tmp_path, [(60.0, "r" * 12 + "GGGg")], lanes=2)
    case = meeting(net, [{**turning, "decel_mps2": 2.8}, {**passing, "decel_mps2": 3.98}])
    sumo = play_sumo(case, STEPS)
    departure = first_departure(case, sumo, play_twin(case, STEPS))
    assert departure is None, str(departure)
    names = np.array([*case.world.lane_ids, ""])
    change = np.flatnonzero((names[sumo.lane[:-1, 1]] == "D2TL_0") & (names[sumo.lane[1:, 1]] == "D2TL_1"))
    assert len(change) == 1 and names[sumo.lane[change[0] + 1, 0]] == ":TL_12_0"
