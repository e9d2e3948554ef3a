"""Sums by movement add up to those of their approach, and queues are the vehicles that stand, in both simulators."""

from __future__ import annotations

import contextlib

import pytest
import torch

from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.mdp.metric_sums import MOVEMENTS, OF_COHORT, STOPPED_MPS
from tests.envs.worlds import crossing, defer

CONFIG = EnvConfig(horizon_s=140.0, warmup_s=20.0, drain_s=300.0, num_vehicles=128, emit=("metrics", "vehicles"))


@pytest.mark.parametrize("simulator", ["twin", "sumo"])
def test_movements_add_up_to_their_approach_and_queues_are_what_stands(simulator: str) -> None:
    shown = torch.zeros(CONFIG.num_approaches, 3)
    most = torch.zeros(CONFIG.num_approaches, 3)
    with contextlib.closing(EcoDrivingEnv(crossing(), config=CONFIG, simulator=simulator)) as env:
        state = env.reset(seed=5)
        while not state["done"].item():
            state = env.step_lean(defer(state))
            if state["metrics", "episode", "steps"].item() > CONFIG.control_steps:
                continue
            vehicles = state["vehicles"]
            stands = vehicles["present"] & (vehicles["location"] == 0) & (vehicles["speed_mps"] < STOPPED_MPS)
            shown.zero_()
            shown.index_put_(
                (vehicles["approach"][stands].long(), vehicles["movement"][stands].long()),
                torch.ones(int(stands.sum())),
                accumulate=True,
            )
            most = torch.maximum(most, shown)
        sums = state["metrics", "approach"]
    for name in OF_COHORT:
        parts = torch.stack([sums[f"{movement}_{name}"] for movement in MOVEMENTS])
        assert (parts > 0).sum() > 4, name
        torch.testing.assert_close(parts.sum(0), sums[name], rtol=1e-5, atol=1e-3)
    for name, expected in (("queue", shown), ("queue_max", most)):
        torch.testing.assert_close(torch.stack([sums[f"{movement}_{name}"] for movement in MOVEMENTS], -1), expected)
    assert most.max() >= 2 and shown.sum() > 0
