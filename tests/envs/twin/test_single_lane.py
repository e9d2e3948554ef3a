"""On one lane every vehicle is where SUMO has it, in every step: one and two vehicles, and whole episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, Trace, first_departure, play_sumo, play_twin, waves
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import ContextList
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road

pytestmark = pytest.mark.slow
HORIZON_S = 300.0


def single_lane(seed: int, **features: Any) -> Case:
    values = {"lane_count": 1, "phase_count": 1, "inflow_vph_per_lane": 400.0, "approach": "A", "adoption": 0.5}
    return Case.of(procedural_context(**(values | features)), seed, HORIZON_S)


def assert_same(case: Case, sumo: Trace, twin: Trace, tolerance: float) -> None:
    departure = first_departure(case, sumo, twin, tolerance)
    assert departure is None, str(departure)
    assert (sumo.lane >= 0).sum() > 50, "too few vehicles to tell"


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("step_ms", [500, 1000])
def test_one_and_two_vehicles(count: int, seed: int, step_ms: int) -> None:
    case = dataclasses.replace(single_lane(seed).first(count), step_ms=step_ms)
    steps = int(1000 * HORIZON_S) // step_ms
    assert_same(case, play_sumo(case, steps), play_twin(case, steps), 1e-6)


LIGHT = {"inflow_vph_per_lane": 250.0}
SHORT = {"inflow_vph_per_lane": 700.0, "lane_length_m": 150.0, "offset_s": 3.0}
LEFTS = {"inflow_vph_per_lane": 600.0, "phase_count": 2, "lane_length_m": 500.0, "green_s": 20.0}
FAST = {"inflow_vph_per_lane": 500.0, "approach": "B", "speed_limit_mps": 20.0}
BETWEEN_STEPS = {"green_s": 24.385, "red_s": 21.517, "offset_s": 2.938}
"""Signals that change between two steps."""


@pytest.mark.parametrize(
    ("features", "commands"),
    [
        *((features, None) for features in (LIGHT, SHORT, LEFTS, FAST, BETWEEN_STEPS)),
        (LIGHT, waves),
        (SHORT, waves),
        (LEFTS, waves),
        (FAST, waves),
        (BETWEEN_STEPS, waves),
    ],
)
def test_whole_episodes(features: dict[str, Any], commands: Any) -> None:
    case, steps = single_lane(7, **features), int(2 * HORIZON_S)
    assert_same(case, play_sumo(case, steps, commands), play_twin(case, steps, commands), 1e-3)


def test_commands_make_a_difference() -> None:
    """The comparison can fail: with commands the same vehicles are elsewhere."""
    case, steps = single_lane(7), int(2 * HORIZON_S)
    assert first_departure(case, play_sumo(case, steps), play_twin(case, steps, waves)) is not None


@pytest.mark.parametrize("commands", [None, waves])
def test_measured_single_lane_approaches(dataset: ContextList, commands: Any) -> None:
    held = []
    for context in dataset:
        road = read_road(build_net(context.intersection))
        p = road.approaches.index(context.approach)
        if road.lane_count[p] == 1 and road.main_lane_count[p] == 1:
            case, steps = Case.of(context, 7, 600.0), 1200
            held.append(
                first_departure(case, play_sumo(case, steps, commands), play_twin(case, steps, commands)) is None
            )
    assert len(held) > 50 and all(held)
