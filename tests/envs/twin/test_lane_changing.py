"""On several lanes every vehicle is where SUMO has it, in every step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, first_departure, play_sumo, play_twin
from izoo.contexts.procedural import procedural_context
from izoo.envs.twin.runtime.layout import LANE_EDGE, LANE_INSIDE

pytestmark = pytest.mark.slow
HORIZON_S = 300.0


def several_lanes(**features: Any) -> Case:
    return Case.of(procedural_context(adoption=0.5, **features), 7, HORIZON_S)


ONE_APPROACH = {
    "lane_count": 3,
    "inflow_vph_per_lane": 400.0,
    "lane_length_m": 150.0,
    "phase_count": 2,
    "offset_s": 2.0,
}
FAST = {"lane_count": 2, "inflow_vph_per_lane": 500.0, "speed_limit_mps": 20.0, "green_s": 40.0, "offset_s": 15.0}
JAM = {
    "lane_count": 2,
    "inflow_vph_per_lane": 700.0,
    "lane_length_m": 400.0,
    "speed_limit_mps": 13.0,
    "phase_count": 2,
    "offset_s": 9.0,
}
THREE = {
    "lane_count": 3,
    "inflow_vph_per_lane": 400.0,
    "lane_length_m": 150.0,
    "speed_limit_mps": 20.0,
    "phase_count": 2,
    "green_s": 40.0,
    "offset_s": 17.0,
}


@pytest.mark.parametrize(
    "features", [ONE_APPROACH, *({**features, "approach": "all"} for features in (FAST, JAM, THREE))]
)
def test_whole_episodes(features: dict[str, Any]) -> None:
    case, steps = several_lanes(**features), int(2 * HORIZON_S)
    sumo = play_sumo(case, steps)
    departure = first_departure(case, sumo, play_twin(case, steps))
    assert departure is None, str(departure)
    assert changes(case, sumo.lane) > 20, "too few changes of lane to tell"


def changes(case: Case, lane: np.ndarray) -> int:
    """Count the changes between lanes of an edge in ``lane`` ``[T, N]``."""
    net = case.world.net
    before, after = lane[:-1], lane[1:]
    same_edge = net.lane_ints[before, LANE_EDGE] == net.lane_ints[after, LANE_EDGE]
    outside = net.lane_ints[after, LANE_INSIDE] == 0
    return int(((before >= 0) & (after >= 0) & (before != after) & same_edge & outside).sum())
