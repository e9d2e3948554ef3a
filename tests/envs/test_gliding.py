"""The speed at which a vehicle comes to the stop line when it can pass it, against times worked out by hand."""

from typing import Any

import numpy as np
import pytest

from izoo.envs.mdp import commands
from izoo.envs.mdp.columns import Vehicle
from izoo.envs.mdp.signals import Clock, Shown, Timing
from izoo.networks.clock import GREEN, NEVER_S, RED, YELLOW

LIMIT_MPS, GREEN_S, CYCLE_S = 10.0, 20.0, 50.0
STANDING = {"has_leader": 1, "leader_gap_m": 50.0}


def gliding_mps(colour: int, change_s: float, second_s: float, distance_m: float = 100.0, **leader: Any) -> float:
    vehicle, signal = (np.zeros(shape, of).view(np.recarray) for shape, of in ((1, Vehicle), ((1, 1), Shown)))
    for name, value in {"stop_line_distance_m": -distance_m, "speed_mps": LIMIT_MPS, **leader}.items():
        vehicle[name] = value
    green_s = CYCLE_S if change_s == NEVER_S else GREEN_S
    shown = (change_s, second_s, min(second_s + CYCLE_S, NEVER_S), colour, 0)
    for name, value in zip(Shown.names or (), shown, strict=True):
        signal[name] = value
    timing = np.array((CYCLE_S, 0.0), Timing).view(np.recarray)
    clock = Clock(timing, np.zeros(1), np.array([green_s]), np.zeros((1, 1), Shown))
    return commands._gliding_mps.py_func(vehicle[0], signal, clock, LIMIT_MPS)


@pytest.mark.parametrize(
    ("seen", "leader", "arrival_s"),
    [
        ((RED, 20.0, 70.0), {}, 22.0),  # 2 s after the beginning of green
        ((RED, 9.0, 59.0), {}, None),  # early by 1 s
        ((GREEN, 15.0, 45.0), {}, None),  # it passes in 10 s
        ((GREEN, 5.0, 35.0), {}, 37.0),  # too far for this green
        ((GREEN, NEVER_S, NEVER_S), {}, None),
        ((YELLOW, 3.0, 83.0), {}, 35.0),  # the next green is a cycle before the second
        # Half of the way is a queue of 7.7 vehicles, which need 18.4 s; the first green lets 7.5 of them pass.
        ((RED, 20.0, 70.0), STANDING, 72.4),
        ((RED, 20.0, 70.0), {**STANDING, "leader_speed_mps": 8.0}, 26.0),  # it moves: a tenth of the way may fill
        ((RED, 20.0, 70.0), {**STANDING, "leader_gap_m": 14.0}, None),  # it follows
    ],
)
def test_vehicles_arrive_when_they_can_pass(
    seen: tuple[int, float, float], leader: dict[str, Any], arrival_s: float | None
) -> None:
    wanted = LIMIT_MPS if arrival_s is None else 100.0 / arrival_s
    assert gliding_mps(*seen, **leader) == pytest.approx(wanted, rel=1e-3)


def test_near_the_line_they_are_left_alone() -> None:
    assert gliding_mps(RED, 20.0, 70.0, distance_m=19.0) == LIMIT_MPS


def test_a_queue_at_a_permanent_green_has_started_already() -> None:
    """It needs 2.6 s, the vehicle 2.5 s; a lag of 2 s would make it glide."""
    leader = {"has_leader": 1, "leader_gap_m": 20.0, "leader_speed_mps": 8.0}
    assert gliding_mps(GREEN, NEVER_S, NEVER_S, distance_m=25.0, **leader) == LIMIT_MPS
