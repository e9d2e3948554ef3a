"""Drivers who must change lanes beside a queue that stands: who waits for whom, against SUMO."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.benchmarks.fidelity.single_vehicle import first_departure, play_sumo, play_twin
from tests.envs.twin.crossroads import build_crossroads, meeting

pytestmark = pytest.mark.slow
RED_FOR_A = [(110.0, "r" * 4 + "G" * 12), (40.0, "G" * 4 + "r" * 12)]


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_crossroads(tmp_path_factory.mktemp("queue"), RED_FOR_A, lanes=2, length_m=160.0)


@pytest.mark.parametrize(("queue", "first_s"), [(20, 72.3), (26, 70.0), (26, 72.3), (30, 70.0), (30, 72.3)])
def test_passing_a_queue(net: Path, queue: int, first_s: float) -> None:
    """Who must come over to a queue that stands goes past, a step in two, those who have stood for five seconds."""
    vehicles = [{"depart": 2.2 * k, "way": "AD", "lane": 0, "max_accel": 2.0} for k in range(queue)]
    vehicles += [{"depart": first_s + 4.5 * k, "way": "AD", "lane": 1} for k in range(4)]
    case = meeting(net, vehicles)
    sumo = play_sumo(case, 280)
    departure = first_departure(case, sumo, play_twin(case, 280))
    assert departure is None, str(departure)
    stands, goes = sumo.speed_mps[140:] == 0.0, sumo.speed_mps[140:] > 0.05
    assert (stands[:-2] & goes[1:-1] & stands[2:]).sum() >= (20 if queue > 20 else 0), "nobody goes a step in two"


@pytest.mark.parametrize("queue", [16, 30])
def test_falling_back_goes_on(net: Path, queue: int) -> None:
    """A follower that was asked to be slower by 10 km/h is that much slower: no more is asked of it."""
    vehicles = [{"depart": 2.2 * k, "way": "AC", "lane": 0, "max_accel": 2.0} for k in range(queue)]
    vehicles += [{"depart": 21.3 + 7.0 * k, "way": "AD", "lane": 1} for k in range(4)]
    case = meeting(net, vehicles)
    departure = first_departure(case, play_sumo(case, 220), play_twin(case, 220))
    assert departure is None, str(departure)


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    red_but_for_right_turns = [(200.0, "G" + "r" * 15)]
    return build_crossroads(tmp_path_factory.mktemp("turning"), red_but_for_right_turns, lanes=2, length_m=200.0)


@pytest.mark.parametrize("first_s", [11.4, 12.1, 12.8, 13.5])
def test_beside_a_faster_follower(turning: Path, first_s: float) -> None:
    """Who cannot make a follower drop back in time slows down for it; one who need not wait slows down comfortably."""
    decel_mps2 = 1.7434
    vehicles = [{"depart": 10.0, "way": "AD", "lane": 1, "decel_mps2": decel_mps2, "accel_mps2": 0.75, "length_m": 6.0}]
    vehicles += [{"depart": first_s + 2.5 * k, "way": "AD", "lane": 0, "decel_mps2": decel_mps2} for k in range(2)]
    case = meeting(turning, vehicles)
    departure = first_departure(case, play_sumo(case, 120), play_twin(case, 120))
    assert departure is None, str(departure)
