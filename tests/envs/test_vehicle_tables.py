"""The tables behind a frame, with vehicles placed by hand: motion, lanes, grades, leaders."""

import numpy as np
import pytest

from izoo.networks.road import APPROACHING
from izoo.networks.turning import LEFT
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


def test_lane_columns(scene: Scene) -> None:
    v = scene.vehicles
    me = scene.put("A2TL_intern_2", 30.0, way="AB")
    scene.read()
    assert (v["lane"][me], v["movement"][me], v["location"][me]) == (2, LEFT, APPROACHING)
    assert (v["lane_position_m"][me], v["stop_line_distance_m"][me]) == (30.0, -70.0)


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


@pytest.mark.parametrize(
    ("lane", "position", "way", "grade"),
    [
        ("A2TL_0", 5.0, "AC", 1.0),
        ("A2TL_0", 200.0, "AC", 1.0),
        ("A2TL_0", 2.0, "AC", 0.5),  # half of it still on the level junction before the region
        (":S_0_0", 0.5, "AC", 3.5 / 4.0),
        ("A2TL_intern_0", 1.0, "AC", 0.5),  # two metres on the ramp, one on the split, one on the level
        ("A2TL_intern_0", 49.9, "AC", 0.0),
        ("A2TL_intern_0", 51.98, "AC", -2.0),
        ("A2TL_intern_0", 100.0, "AC", -4.0),
        (":TL_0_0", 1.0, "AC", -3.0),
        (":TL_0_0", 10.0, "AC", 0.0),
        ("TL2C_0", 1.0, "AC", 0.0),
        ("TL2C_0", 1.0, "BC", 0.0),
    ],
)
def test_grade_is_the_mean_under_the_vehicle(scene: Scene, lane: str, position: float, way: str, grade: float) -> None:
    """From back to front along its way, as SUMO takes it; the vehicle is 4 m long."""
    v = scene.vehicles
    me = scene.put(lane, position, way=way, length=4.0)
    scene.read()
    assert v["grade_pct"][me] == pytest.approx(grade, abs=5e-3)


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
