"""Levels of service are those of the manual, and movements and intersections are summed up vehicle by vehicle."""

import math

import pandas as pd
import pytest

from izoo.metrics.level_of_service import by_intersection, by_movement, level_of_service
from tests.metrics.tables import episode_row


def test_levels_are_those_of_the_highway_capacity_manual() -> None:
    ends = {10.0: "A", 10.1: "B", 20.0: "B", 35.0: "C", 35.1: "D", 55.0: "D", 80.0: "E", 80.1: "F", math.nan: ""}
    assert {delay: level_of_service(delay) for delay in ends} == ends


def test_movements_and_intersections_weigh_every_vehicle_alike() -> None:
    def row(seed: int, **sums: float) -> dict[str, object]:
        return episode_row(context="town/7", policy="human", seed=seed, **sums)

    first = {"left_cohort": 4.0, "left_cohort_region_delay_s": 200.0, "left_queue_max": 3.0, "left_queue": 2.0}
    second = {"left_cohort": 2.0, "left_cohort_region_delay_s": 160.0, "left_cohort_blocked_s": 12.0}
    straight = {"straight_cohort": 10.0, "straight_cohort_region_delay_s": 50.0}
    table = pd.DataFrame([row(1, **first, **straight), row(2, **second, **straight)])
    found = by_movement(table, "human")
    assert [tuple(key[1:]) for key in found.index] == [("A", "straight"), ("A", "left")]
    left = found.xs("left", level="movement").iloc[0]
    assert (left["vehicles"], left["delay_s"], left["blocked_s"]) == pytest.approx((3.0, 60.0, 2.0))
    assert (left["level"], left["queue_max"], left["queue"]) == ("E", 1.5, 1.0)
    whole = by_intersection(found).iloc[0]
    assert (whole["vehicles"], whole["delay_s"]) == pytest.approx((13.0, (180.0 + 50.0) / 13.0))
    assert whole["level"] == "B"


def test_rows_without_sums_by_movement_have_none() -> None:
    table = pd.DataFrame([episode_row(policy="human", left_cohort=math.nan)])
    assert by_movement(table, "human").empty and by_intersection(by_movement(table, "human")).empty
