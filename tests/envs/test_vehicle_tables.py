"""The tables behind a frame, with vehicles placed by hand: motion, lanes, leaders."""

import numpy as np
import pytest

from tests.envs.placed import STEP_S, Scene


def test_speed_and_acceleration(scene: Scene) -> None:
    v = scene.vehicles
    me = scene.put("A2TL_0", 50.0, speed=10.0)
    v["accel_mps2"][me] = 1.5  # as the simulator writes it for a new vehicle
    v["fresh"][me] = 1
    scene.read()
    assert (v["accel_mps2"][me], v["prev_accel_mps2"][me]) == (1.5, 1.5)
    scene.move(me, "A2TL_0", 55.0, 9.0)
    scene.read()
    assert (v["accel_mps2"][me], v["prev_accel_mps2"][me]) == ((9.0 - 10.0) / STEP_S, 1.5)
    scene.move(me, "A2TL_0", 60.0, 9.0)
    scene.read()
    assert (v["accel_mps2"][me], v["prev_accel_mps2"][me]) == (0.0, -2.0)


@pytest.mark.parametrize(
    ("lane", "way", "wrong"),
    [
        ("A2TL_0", "AC", 0),
        ("A2TL_0", "AB", 1),
        ("A2TL_1", "AB", 0),
        ("A2TL_intern_1", "AB", 1),
        ("A2TL_intern_2", "AB", 0),
        ("A2TL_intern_2", "AC", 1),
        (":TL_2_0", "AB", 0),
        ("TL2B_0", "AB", 0),
    ],
)
def test_lanes_that_do_not_lead_to_the_exit_are_marked(scene: Scene, lane: str, way: str, wrong: int) -> None:
    v = scene.vehicles
    me = scene.put(lane, 1.0, way=way)
    scene.read()
    assert v["wrong_lane"][me] == wrong


def test_leader_columns_and_time_to_collision(scene: Scene) -> None:
    v = scene.vehicles
    fast = scene.put("A2TL_0", 100.0, speed=14.0)
    slow = scene.put("A2TL_0", 135.0, speed=4.0)
    scene.put("A2TL_1", 101.0, speed=0.0)
    scene.read()
    assert v["has_leader"][fast] == 1
    assert (v["leader_gap_m"][fast], v["leader_speed_mps"][fast]) == (30.0, 4.0)
    assert v["ttc_s"][fast] == pytest.approx(30.0 / 10.0)
    assert v["has_leader"][slow] == v["leader_gap_m"][slow] == v["leader_speed_mps"][slow] == 0.0
    assert v["ttc_s"][slow] == np.inf
    scene.move(fast, "A2TL_0", 100.0, 4.0)
    scene.read()
    assert v["ttc_s"][fast] == np.inf, "unless they close"
    scene.move(slow, "A2TL_0", 103.0, 0.0)
    scene.read()
    assert v["leader_gap_m"][fast] == -2.0 and v["ttc_s"][fast] == 0.0, "in contact"
