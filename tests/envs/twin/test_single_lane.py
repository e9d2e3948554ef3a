"""On one lane every vehicle is where SUMO has it, in every step: one and two vehicles, and whole episodes."""

import dataclasses
from typing import Any

import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, first_departure, play_sumo, play_twin, waves
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import ContextList
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from tests.envs.twin.crossroads import assert_same

pytestmark = pytest.mark.slow
HORIZON_S = 300.0


def single_lane(seed: int, **features: Any) -> Case:
    values = {"lane_count": 1, "phase_count": 1, "inflow_vph_per_lane": 400.0, "approach": "A", "adoption": 0.5}
    return Case.of(procedural_context(**(values | features)), seed, HORIZON_S)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("step_ms", [500, 1000])
def test_one_and_two_vehicles(count: int, seed: int, step_ms: int) -> None:
    case = dataclasses.replace(single_lane(seed).first(count), step_ms=step_ms)
    steps = int(1000 * HORIZON_S) // step_ms
    assert (assert_same(case, steps, 1e-6).lane >= 0).sum() > 50


LIGHT = {"inflow_vph_per_lane": 250.0}
SHORT = {"inflow_vph_per_lane": 700.0, "lane_length_m": 150.0, "offset_s": 3.0}
LEFTS = {"inflow_vph_per_lane": 600.0, "phase_count": 2, "lane_length_m": 500.0, "green_s": 20.0}
FAST = {"inflow_vph_per_lane": 500.0, "approach": "B", "speed_limit_mps": 20.0}
CROSSING = {"phase_count": 2, "inflow_vph_per_lane": 350.0, "approach": "all"}
BETWEEN_STEPS = {"green_s": 24.385, "red_s": 21.517, "offset_s": 2.938}
"""Signals that change between two steps."""


@pytest.mark.parametrize("features", [LIGHT, SHORT, LEFTS, FAST, CROSSING, BETWEEN_STEPS])
@pytest.mark.parametrize("commands", [None, waves])
def test_whole_episodes(features: dict[str, Any], commands: Any) -> None:
    assert (assert_same(single_lane(7, **features), int(2 * HORIZON_S), commands=commands).lane >= 0).sum() > 50


def test_commands_make_a_difference() -> None:
    """So the comparison can fail."""
    case, steps = single_lane(7), int(2 * HORIZON_S)
    assert first_departure(case, play_sumo(case, steps), play_twin(case, steps, waves)) is not None


@pytest.mark.parametrize("commands", [None, waves])
def test_measured_single_lane_approaches(dataset: ContextList, commands: Any) -> None:
    compared = 0
    for context in dataset:
        road = read_road(build_net(context.intersection))
        p = road.approaches.index(context.approach)
        if road.lane_count[p] == 1 and road.main_lane_count[p] == 1:
            assert_same(Case.of(context, 7, 600.0), 1200, commands=commands)
            compared += 1
    assert compared > 50
