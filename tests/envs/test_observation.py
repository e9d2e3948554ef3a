"""Observations number by number, with vehicles placed by hand."""

import dataclasses

import numpy as np
import pytest

from izoo.contexts.context import Context
from izoo.contexts.features import OBSERVED
from izoo.contexts.spec import Approach, IntersectionSpec, Leg
from izoo.envs.config import NEIGHBOURS
from izoo.envs.mdp.observation import FAR_M, NEIGHBOUR_FEATURES, observed_table
from izoo.networks.road import INSIDE, LEAVING, RoadNet
from tests.envs.placed import LEFT_BLINKER, RIGHT_BLINKER, Scene

ABSENT = {"speed": 0.0, "distance": 4.0, "blinker_left": 0.0, "blinker_right": 0.0, "present": 0.0}


def neighbour(seen: dict[str, float], which: str) -> dict[str, float]:
    return {what: seen[f"{which}_{what}"] for what in NEIGHBOUR_FEATURES}


def assert_sees(seen: dict[str, float], which: str, gap_m: float, speed: float) -> None:
    got = neighbour(seen, which)
    assert got["present"] == got["lane_exists"] == 1.0
    assert got["distance"] == pytest.approx(gap_m / 250.0, abs=1e-6)
    assert got["speed"] == pytest.approx(speed / 15.0)


def test_ego_approaching(scene: Scene) -> None:
    seen = scene.see(scene.put("A2TL_1", 40.0, speed=12.0))
    assert seen["speed"] == pytest.approx(12.0 / 15.0)
    assert seen["stop_line_distance"] == pytest.approx(-(301.0 - 40.0) / 250.0)
    assert (seen["location_approaching"], seen["location_inside"], seen["location_leaving"]) == (1.0, 0.0, 0.0)
    assert (seen["intention_right"], seen["intention_straight"], seen["intention_left"]) == (0.0, 1.0, 0.0)
    assert seen["lane"] == 1.0
    pocket = scene.see(scene.put("A2TL_intern_1", 60.0))
    assert pocket["stop_line_distance"] == pytest.approx(-40.0 / 250.0) and pocket["lane"] == 0.5
    single = scene.see(scene.put("B2TL_0", 20.0, way="BA"))
    assert single["intention_right"] == 1.0 and single["lane"] == 0.0
    assert single["stop_line_distance"] == pytest.approx(-130.0 / 250.0)


def test_ego_inside_has_distance_zero(scene: Scene) -> None:
    me = scene.put(":TL_9_0", 3.0, way="AB")
    seen = scene.see(me)
    assert seen["stop_line_distance"] == 0.0 and seen["location_inside"] == 1.0 and seen["intention_left"] == 1.0
    assert scene.vehicles["path_position_m"][me] == pytest.approx(8.0 + 3.0)
    assert scene.vehicles["location"][me] == INSIDE


def test_ego_leaving_counts_from_the_exit(scene: Scene) -> None:
    """The distance after the line is the position on the exit; the path position goes on through the junction."""
    me = scene.put(":TL_9_0", 11.0, way="AB")
    scene.read()
    scene.move(me, "TL2B_0", 4.0, 10.0)
    seen = scene.see(me)
    assert seen["stop_line_distance"] == pytest.approx(4.0 / 250.0) and seen["location_leaving"] == 1.0
    assert scene.vehicles["path_position_m"][me] == pytest.approx(20.0 + 4.0)
    assert scene.vehicles["location"][me] == LEAVING


def test_path_position_is_continuous(scene: Scene) -> None:
    me = scene.put("A2TL_1", 199.5, speed=1.0)
    ways = [("A2TL_1", 200.0), (":S_0_1", 0.5), ("A2TL_intern_1", 0.0), ("A2TL_intern_1", 100.0), (":TL_0_1", 0.0)]
    ways += [(":TL_0_1", 20.0), ("TL2C_1", 0.0)]
    path = []
    for lane, position in ways:
        scene.move(me, lane, position, 1.0)
        scene.read()
        path.append(scene.vehicles["path_position_m"][me])
    assert path == pytest.approx([-101.0, -100.5, -100.0, 0.0, 0.0, 20.0, 20.0])


def test_empty_slots_are_zero(scene: Scene) -> None:
    me = scene.put("A2TL_1", 40.0)
    out = scene.look(-1, me, -1, features=np.ones((2, 3, 2)))
    assert not out[[0, 2]].any() and out[1].any()


@pytest.mark.parametrize(
    ("way", "lane", "time_s", "expected"),
    [
        ("AC", "A2TL_0", 17.0, ([1, 0, 0], 20.0, 55.0, 120.0)),
        ("AB", "A2TL_1", 17.0, ([1, 0, 0], 20.0, 23.0, 55.0)),
        ("AC", "A2TL_0", 38.0, ([0, 1, 0], 2.0, 99.0, 164.0)),
        ("BA", "B2TL_0", 8.0, ([0, 0, 1], 41.0, 106.0, 171.0)),  # right on red counts as red
    ],
)
def test_signal_of_the_own_movement(
    scene: Scene, way: str, lane: str, time_s: float, expected: tuple[list[int], float, float, float]
) -> None:
    seen = scene.see(scene.put(lane, 10.0, way=way), time_s=time_s)
    assert [seen["signal_green"], seen["signal_yellow"], seen["signal_red"]] == expected[0]
    clock = [seen["signal_time_left"], seen["signal_second_green"], seen["signal_third_green"]]
    assert clock == pytest.approx([value / 100.0 for value in expected[1:]])


def test_leader_and_follower_on_the_own_lane(scene: Scene) -> None:
    me = scene.put("A2TL_0", 100.0, length=5.0)
    scene.put("A2TL_0", 150.0, speed=3.0, length=12.0)
    scene.put("A2TL_0", 180.0, speed=6.0)
    scene.put("A2TL_0", 70.0, speed=9.0)
    scene.put("A2TL_0", 40.0, speed=12.0)
    seen = scene.see(me)
    assert_sees(seen, "leader", 150.0 - 12.0 - 100.0, 3.0)
    assert_sees(seen, "follower", 100.0 - 5.0 - 70.0, 9.0)


def test_leader_through_and_inside_the_junction(scene: Scene) -> None:
    me = scene.put("A2TL_intern_2", 90.0, way="AB")
    scene.put("TL2B_0", 30.0, speed=7.0, way="AB", length=6.0)
    assert_sees(scene.see(me), "leader", 10.0 + 8.0 + 12.0 + 30.0 - 6.0, 7.0)
    scene.put(":TL_9_0", 2.0, speed=2.0, way="AB")
    assert_sees(scene.see(me), "leader", 10.0 + 8.0 + 2.0 - 5.0, 2.0)
    other = scene.put("A2TL_intern_0", 95.0, way="AC")
    scene.put("TL2C_0", 8.0, speed=4.0, way="BC")  # from another approach
    assert_sees(scene.see(other), "leader", 5.0 + 20.0 + 8.0 - 5.0, 4.0)


def test_leader_through_the_split_depends_on_the_way(scene: Scene) -> None:
    straight = scene.put("A2TL_1", 190.0, way="AC")
    left = scene.put("A2TL_1", 150.0, way="AB")
    scene.put("A2TL_intern_1", 20.0, speed=1.0, way="AC")
    scene.put("A2TL_intern_2", 40.0, speed=2.0, way="AB")
    assert_sees(scene.see(straight), "leader", 10.0 + 1.0 + 20.0 - 5.0, 1.0)
    assert_sees(scene.see(left), "leader", 190.0 - 5.0 - 150.0, 10.0)
    scene.move(straight, "A2TL_0", 190.0, 10.0)
    assert_sees(scene.see(left), "leader", 50.0 + 1.0 + 40.0 - 5.0, 2.0)


@pytest.mark.parametrize("case", [("A2TL_intern_1", "AC", ":TL_5_0", 5.0), ("A2TL_intern_0", "AB", "TL2C_0", 25.0)])
def test_vehicles_on_other_ways_and_exits_do_not_lead(scene: Scene, case: tuple[str, str, str, float]) -> None:
    """Even if the rear of one that came from B reaches as far back as that of a vehicle from the own lane."""
    lane, way, other, length = case
    me = scene.put(lane, 95.0, way=way)
    scene.put(other, 2.0, way="BC", length=length)
    assert neighbour(scene.see(me), "leader") == ABSENT | {"lane_exists": 1.0}


def test_a_turning_vehicle_leads_until_its_rear_has_left_the_lane(scene: Scene) -> None:
    me = scene.put("A2TL_1", 190.0, way="AC")
    turning = scene.put("A2TL_intern_2", 3.0, speed=2.0, way="AB")  # 1 m lies between both lanes
    assert_sees(scene.see(me), "leader", 10.0 + 1.0 + 3.0 - 5.0, 2.0)
    ahead = scene.put("A2TL_intern_1", 3.5, speed=6.0, way="AC")
    assert_sees(scene.see(me), "leader", 10.0 + 1.0 + 3.0 - 5.0, 2.0)
    scene.move(turning, "A2TL_intern_2", 4.5, 2.0)
    assert_sees(scene.see(me), "leader", 10.0 + 1.0 + 3.5 - 5.0, 6.0)
    scene.move(ahead, "A2TL_intern_1", 50.0, 6.0)
    assert_sees(scene.see(me), "leader", 10.0 + 1.0 + 50.0 - 5.0, 6.0)


def test_follower_comes_along_the_own_way_through_the_junction(scene: Scene) -> None:
    me = scene.put("TL2B_0", 9.0, way="AB", length=7.0)
    scene.put("A2TL_intern_2", 80.0, speed=5.0, way="AB")
    assert_sees(scene.see(me), "follower", 9.0 - 7.0 + 12.0 + 8.0 + 20.0, 5.0)
    other = scene.put("TL2C_0", 9.0, way="BC")
    scene.put("A2TL_intern_0", 99.0, way="AC")
    scene.put("B2TL_0", 149.0, speed=2.0, way="BC")
    assert_sees(scene.see(other), "follower", 9.0 - 5.0 + 14.0 + 1.0, 2.0)


def test_lanes_to_the_left_and_right(scene: Scene) -> None:
    me = scene.put("A2TL_intern_1", 50.0, length=5.0)
    scene.put("A2TL_intern_2", 65.0, speed=1.0, way="AB")
    scene.put("A2TL_intern_2", 30.0, speed=2.0, way="AB")
    scene.put("A2TL_intern_0", 80.0, speed=3.0)
    scene.put("A2TL_intern_0", 20.0, speed=4.0)
    seen = scene.see(me)
    assert_sees(seen, "left_leader", 65.0 - 5.0 - 50.0, 1.0)
    assert_sees(seen, "left_follower", 50.0 - 5.0 - 30.0, 2.0)
    assert_sees(seen, "right_leader", 80.0 - 5.0 - 50.0, 3.0)
    assert_sees(seen, "right_follower", 50.0 - 5.0 - 20.0, 4.0)
    assert neighbour(seen, "leader") == neighbour(seen, "follower") == ABSENT | {"lane_exists": 1.0}


def test_a_neighbour_alongside_leads_when_its_front_is_ahead(scene: Scene) -> None:
    me = scene.put("A2TL_0", 50.0, length=5.0)
    scene.put("A2TL_1", 52.0, speed=1.0, length=5.0)
    assert_sees(scene.see(me), "left_leader", -3.0, 1.0)
    scene.move(1, "A2TL_1", 48.0, 1.0)
    seen = scene.see(me)
    assert_sees(seen, "left_follower", 50.0 - 5.0 - 48.0, 1.0)
    assert seen["left_leader_present"] == 0.0


def test_neighbours_on_lanes_of_another_length(road: RoadNet) -> None:
    """Lanes of one edge end side by side: positions are compared from the end."""
    lengths = road.lane_length.copy()
    lengths[road.lane_ids.index("A2TL_1")] = 190.0
    scene = Scene(dataclasses.replace(road, lane_length=lengths))
    me = scene.put("A2TL_0", 100.0)  # 100 m before the end
    scene.put("A2TL_1", 110.0, speed=1.0)  # 80 m before the end
    scene.put("A2TL_1", 70.0, speed=2.0)  # 120 m before the end
    seen = scene.see(me)
    assert_sees(seen, "left_leader", 20.0 - 5.0, 1.0)
    assert_sees(seen, "left_follower", 20.0 - 5.0, 2.0)
    other = scene.see(1)
    assert_sees(other, "right_follower", 20.0 - 5.0, 10.0)


def test_neighbouring_lane_followed_through_the_junction(scene: Scene) -> None:
    me = scene.put("A2TL_intern_1", 95.0)
    scene.put("TL2C_0", 10.0, speed=8.0)
    scene.put("TL2C_1", 30.0, speed=9.0)
    seen = scene.see(me)
    assert_sees(seen, "right_leader", 5.0 + 20.0 + 10.0 - 5.0, 8.0)
    assert_sees(seen, "leader", 5.0 + 20.0 + 30.0 - 5.0, 9.0)


def test_no_lane_and_an_empty_lane_differ(scene: Scene) -> None:
    seen = scene.see(scene.put("A2TL_0", 50.0))
    for which in ("left_leader", "left_follower", "leader", "follower"):
        assert neighbour(seen, which) == ABSENT | {"lane_exists": 1.0}
    for which in ("right_leader", "right_follower"):
        assert neighbour(seen, which) == ABSENT | {"lane_exists": 0.0}
    assert ABSENT["distance"] == FAR_M / 250.0


@pytest.mark.parametrize(("signals", "left", "right"), [(0, 0, 0), (RIGHT_BLINKER, 0, 1), (LEFT_BLINKER, 1, 0)])
def test_blinkers(scene: Scene, signals: int, left: int, right: int) -> None:
    me = scene.put("A2TL_1", 50.0)
    other = scene.put("A2TL_1", 90.0, signals=signals | 8)  # other bits, such as the brake light, do not matter
    seen = neighbour(scene.see(me), "leader")
    assert (seen["blinker_left"], seen["blinker_right"]) == (left, right)
    assert (scene.vehicles["blinker_left"][other], scene.vehicles["blinker_right"][other]) == (left, right)


def test_sensor_range_is_bumper_to_bumper(scene: Scene) -> None:
    me = scene.put("A2TL_0", 50.0, length=5.0)
    scene.put("A2TL_0", 95.0, length=5.0)  # 40 m ahead
    scene.put("A2TL_0", 5.0, length=5.0)  # 40 m behind
    for range_m, present in ((40.0, 1.0), (39.9, 0.0)):
        seen = scene.see(me, range_m=range_m)
        assert seen["leader_present"] == seen["follower_present"] == present
        assert seen["leader_distance"] == pytest.approx(40.0 / 250.0 if present else 4.0)
        assert seen["leader_lane_exists"] == 1.0


@pytest.mark.parametrize("chosen", [(), ("follower",), ("right_leader", "leader"), NEIGHBOURS[::-1]])
def test_chosen_neighbours(scene: Scene, chosen: tuple[str, ...]) -> None:
    """A selection shows the same numbers in the chosen order."""
    me = scene.put("A2TL_intern_1", 50.0)
    for k, lane in enumerate(("A2TL_intern_0", "A2TL_intern_1", "A2TL_intern_2")):
        scene.put(lane, 70.0 + k, speed=1.0 + k)
        scene.put(lane, 20.0 + k, speed=5.0 + k)
    whole, part = scene.see(me), scene.see(me, neighbours=chosen)
    assert len(part) == 15 + 6 * len(chosen)
    assert all(part[name] == whole[name] for name in part)


def test_context_features_come_last_and_by_movement(scene: Scene) -> None:
    features = np.arange(12.0).reshape(2, 3, 2)
    rows = scene.put("A2TL_1", 10.0, way="AB"), scene.put("B2TL_0", 10.0, way="BC")
    out = scene.look(*rows, features=features, neighbours=())
    assert out[:, -2:].tolist() == [[2.0, 3.0], [10.0, 11.0]]


def test_every_context_feature(road: RoadNet) -> None:
    approach = Approach(("s",), 100.0, 15.0, 0.0, 1000.0)
    spec = IntersectionSpec("hand/1", "procedural", tuple(Leg(n, 0.0, approach, 1, 100.0, 15.0) for n in "ABC"))
    context = Context(spec, adoption=0.5, engine="electric", temperature_c=30.0, humidity_pct=80.0)
    table = observed_table(context, road, OBSERVED)
    expected = {"adoption": 0.5, "temperature_c": 30.0 / 40.0, "humidity_pct": 80.0 / 100.0, "engine": 1.0}
    of_a = {"green_s": 0.36, "red_s": 0.29, "lane_count": 3 / 4, "lane_length_m": 301 / 250, "speed_limit_mps": 1.0}
    of_b = {"green_s": 0.2, "red_s": 0.45, "lane_count": 0.25, "lane_length_m": 150 / 250, "speed_limit_mps": 0.8}
    assert dict(zip(OBSERVED, table[0, 1].tolist(), strict=True)) == pytest.approx(expected | of_a)
    assert dict(zip(OBSERVED, table[1, 2].tolist(), strict=True)) == pytest.approx(expected | of_b)
    assert observed_table(context, road, ("humidity_pct",)).shape == (2, 3, 1)
    assert observed_table(context, road, ()).shape == (2, 3, 0)


def test_rows_may_be_in_any_order(scene: Scene) -> None:
    """Vehicles keep their rows while others come and go."""
    me = scene.put("A2TL_0", 100.0, row=7)
    scene.put("A2TL_0", 140.0, speed=2.0, row=3)
    scene.put("A2TL_0", 60.0, speed=1.0, row=11)
    seen = scene.see(me)
    assert_sees(seen, "leader", 35.0, 2.0)
    assert_sees(seen, "follower", 35.0, 1.0)
