"""The ``fuel`` rewards order drivers as an evaluation's measure does."""

import contextlib
import dataclasses
import itertools

import numpy as np
import pytest
import torch

from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.errors import IzooError
from tests.envs.outcomes import Drive, Outcome, crawling, driving, glide, lane, outcome, stopping, uncommanded
from tests.envs.worlds import defer

CONFIG = EnvConfig(horizon_s=625.0, drain_s=600.0, reward=RewardConfig.fuel(), emit=("metrics", "team_reward"))
CONTEXTS = 12
REWARDS = ("local", "team")


def drivers(seed: int) -> dict[str, Outcome]:
    """Play five drivers on random procedural contexts."""
    generator = np.random.default_rng(seed)
    drawn = [ProceduralSource().sample(generator).replace(adoption=1 / 3) for _ in range(CONTEXTS)]
    # Uncommanded CVs with the parameters of human drivers drive as at adoption 0, and have rewards.
    human = [dataclasses.replace(context, cv_vehicle="human") for context in drawn]
    acts: dict[str, Drive] = {
        "uncommanded": uncommanded,
        "glide": glide(),
        "crawling": driving(crawling),
        "blocking": driving(stopping, -1e9),
    }
    return {"human": outcome(human, uncommanded, CONFIG), **{n: outcome(drawn, a, CONFIG) for n, a in acts.items()}}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_rewards_order_drivers_as_the_measure_does(seed: int) -> None:
    """The measure is CO2 and half a gram per second of delay, per vehicle of the cohort, relative to uncommanded CVs.

    Summed over the contexts both rewards have its order. In single contexts the team's reward has it as well; the CVs'
    own rewards leave out the vehicles ahead of the first CV.
    """
    found = drivers(seed)
    free = found["uncommanded"].cost
    measured = sorted(found, key=lambda name: (found[name].cost / free).mean())
    assert measured[2:] == ["human", "crawling", "blocking"]
    for reward in REWARDS:
        assert sorted(found, key=lambda name: -getattr(found[name], reward).sum()) == measured, reward
        right = [
            (found[one].cost < found[other].cost) == (getattr(found[one], reward) > getattr(found[other], reward))
            for one, other in itertools.combinations(found, 2)
        ]
        assert np.mean(right) > {"local": 0.85, "team": 0.95}[reward]


def test_sums_without_fuel_or_time_are_refused() -> None:
    with pytest.raises(IzooError, match=r"reward\.beta and reward\.delay are both 0"):
        RewardConfig(sums=True, beta=0.0)


def test_own_rewards_add_up_to_the_teams() -> None:
    """At full adoption each vehicle is credited to exactly one agent."""
    everyone = dataclasses.replace(lane(inflow_vph_per_lane=330.0, lane_length_m=300.0), adoption=1.0)
    config = dataclasses.replace(CONFIG, horizon_s=225.0)
    with contextlib.closing(EcoDrivingEnv(everyone, config=config)) as env:
        state = env.reset(context=everyone, seed=4)
        world = env.backend.simulation().episode._world  # type: ignore[attr-defined]
        scale = float(world.unit_g[0] / float(world.rules["fleet_g_per_step"]))
        for _ in range(config.decisions):
            asked = state["agents", "mask"].clone()
            before = set(state["agents", "vehicle"][asked].tolist())
            state = env.step_lean(defer(state))
            if set(state["agents", "vehicle"][state["agents", "mask"]].tolist()) <= before:  # a new agent has no reward
                total = torch.tensor(float(state["agents", "reward"].sum()) * scale)
                torch.testing.assert_close(total, state["team_reward"][0], rtol=1e-3, atol=1e-3)
