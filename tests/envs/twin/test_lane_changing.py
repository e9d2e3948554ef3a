"""Lane changing: on several lanes, and beside queues, every vehicle is where SUMO has it in every step."""

from pathlib import Path
from typing import Any

import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case
from izoo.contexts.procedural import procedural_context
from tests.envs.twin.crossroads import assert_same, build_crossroads, meeting

pytestmark = pytest.mark.slow
THREE = {"lane_count": 3, "inflow_vph_per_lane": 400.0, "lane_length_m": 150.0, "phase_count": 2}
FAST = {"lane_count": 2, "inflow_vph_per_lane": 500.0, "speed_limit_mps": 20.0, "green_s": 40.0, "offset_s": 15.0}
JAM = {"lane_count": 2, "inflow_vph_per_lane": 700.0, "lane_length_m": 400.0, "speed_limit_mps": 13.0, "phase_count": 2}
ALL = {"approach": "all"}


@pytest.mark.parametrize(
    "features",
    [
        {**THREE, "offset_s": 2.0},
        {**THREE, **ALL, "speed_limit_mps": 20.0, "green_s": 40.0, "offset_s": 17.0},
        {**FAST, **ALL},
        {**JAM, **ALL, "offset_s": 9.0},
    ],
)
def test_whole_episodes(features: dict[str, Any]) -> None:
    case = Case.of(procedural_context(adoption=0.5, **features), 7, 300.0)
    lane = assert_same(case, 600).lane
    before, after, net = lane[:-1], lane[1:], case.world.net
    same_edge = net.lanes["edge"][before] == net.lanes["edge"][after]
    outside = net.lanes["inside"][after] == 0
    changes = (before >= 0) & (after >= 0) & (before != after) & same_edge & outside
    assert changes.sum() > 20, "too few lane changes to tell"


@pytest.fixture(scope="module")
def red_for_a(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = [(110.0, "r" * 4 + "G" * 12), (40.0, "G" * 4 + "r" * 12)]
    return build_crossroads(tmp_path_factory.mktemp("queue"), plan, lanes=2, length_m=160.0)


@pytest.mark.parametrize(("queue", "first_s"), [(20, 72.3), (26, 70.0), (26, 72.3), (30, 70.0), (30, 72.3)])
def test_blocked_changer_passes_vehicles_that_have_stood_for_long(red_for_a: Path, queue: int, first_s: float) -> None:
    """It drives in one of two steps."""
    vehicles = [{"depart": 2.2 * k, "way": "AD", "lane": 0} for k in range(queue)]
    vehicles += [{"depart": first_s + 4.5 * k, "way": "AD", "lane": 1} for k in range(4)]
    speed = assert_same(meeting(red_for_a, vehicles), 280).speed_mps[140:]
    stop_and_go = (speed[:-2] == 0.0) & (speed[1:-1] > 0.05) & (speed[2:] == 0.0)
    assert stop_and_go.sum() >= (20 if queue > 20 else 0)


@pytest.mark.parametrize("queue", [16, 30])
def test_follower_that_fell_back_enough_is_not_slowed_further(red_for_a: Path, queue: int) -> None:
    vehicles = [{"depart": 2.2 * k, "way": "AC", "lane": 0} for k in range(queue)]
    vehicles += [{"depart": 21.3 + 7.0 * k, "way": "AD", "lane": 1} for k in range(4)]
    assert_same(meeting(red_for_a, vehicles), 220)


@pytest.mark.parametrize("first_s", [11.4, 12.1, 12.8, 13.5])
def test_changer_slows_down_for_a_faster_follower(tmp_path: Path, first_s: float) -> None:
    net = build_crossroads(tmp_path, [(200.0, "G" + "r" * 15)], lanes=2, length_m=200.0)
    driver = {"way": "AD", "decel_mps2": 1.7434}
    vehicles = [{"depart": 10.0, "lane": 1, "accel_mps2": 0.75, "length_m": 6.0, **driver}]
    vehicles += [{"depart": first_s + 2.5 * k, "lane": 0, **driver} for k in range(2)]
    assert_same(meeting(net, vehicles), 120)
