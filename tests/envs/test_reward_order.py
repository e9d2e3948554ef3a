"""Each reward by its argmax, on contexts that nobody chose: how often it orders drivers as the headline score does."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource, procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig, RewardConfig, TwinEnv
from izoo.errors import IzooError
from tests.envs.worlds import defer

CONFIG = EnvConfig(horizon_s=625.0, reward=RewardConfig.fuel(), emit=("metrics", "team_reward"))
CONTEXTS = 20
MARGIN_PCT = 1.5
"""Drivers whose scores are closer than this are not ordered: a vehicle that just makes it past the horizon moves the
mean of some fifty by as much."""
PLAIN: dict[str, Any] = {"surrogate": "compiled", "threads": 1}
REWARDS = ("local", "team")
Drive = Callable[[TensorDictBase], TensorDictBase]


def single() -> Context:
    """A single-lane approach with some traffic, a third of it controlled."""
    plan = {"phase_count": 1, "green_s": 30.0, "red_s": 30.0, "offset_s": 2.0, "speed_limit_mps": 15.0}
    road = {"lane_count": 1, "inflow_vph_per_lane": 330.0, "lane_length_m": 300.0, "approach": "A"}
    return procedural_context(adoption=1 / 3, **plan, **road)


def braking(below_mps: float, from_m: float) -> Drive:
    """Brake to a speed farther than ``from_m`` before the stop line; nearer, leave it to SUMO."""

    def act(state: TensorDictBase) -> TensorDictBase:
        observation = state["agents", "observation"]
        speed, distance = observation[..., 0] * 15.0, -observation[..., 1] * 250.0
        state["agents", "action"] = ((below_mps - speed) / 0.5).clamp(-3.0, 2.6).unsqueeze(-1)
        state["agents", "defer"] = distance < from_m
        return state

    return act


def glide() -> Drive:
    from izoo.algos.scripted import make_driver

    return make_driver("glide", CONFIG)


def played(contexts: list[Context], act: Drive) -> dict[str, np.ndarray]:
    """CO2 per vehicle, crossings, and the sum of each reward over an episode of every context, ``[CONTEXTS]`` each."""
    env = TwinEnv(len(contexts), lambda number: (contexts[number % len(contexts)], 4 + number), config=CONFIG, **PLAIN)
    with contextlib.closing(env):
        state, local, team = env.reset(), torch.zeros(len(contexts)), torch.zeros(len(contexts))
        for _ in range(CONFIG.decisions):
            state = env.step_lean(act(state))
            local += state["agents", "reward"].sum((-1, -2))
            team += state["team_reward"].squeeze(-1)
    sums = {name: state["metrics", "approach", name].sum(-1) for name in ("emission_g", "crossed")}
    grams = sums["emission_g"] / sums["crossed"].clamp_min(1.0)
    found = {"grams": grams, "crossed": sums["crossed"], "local": local, "team": team}
    return {name: value.numpy() for name, value in found.items()}


def ordered(found: dict[str, dict[str, np.ndarray]], reward: str, names: tuple[str, ...]) -> tuple[int, int]:
    """How many pairs of drivers in a context a reward orders as the score does, and how many the score orders."""
    human = found["human"]
    score = {
        # One vehicle more or less at the horizon is no fall of throughput here.
        name: np.where(row["crossed"] >= human["crossed"] - 1.0, 100.0 * (1.0 - row["grams"] / human["grams"]), -100.0)
        for name, row in found.items()
    }
    right = whole = 0
    for one, other in itertools.permutations(names, 2):
        better = score[one] > score[other] + MARGIN_PCT
        whole += int(better.sum())
        right += int((better & (found[one][reward] > found[other][reward])).sum())
    return right, whole


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_order_of_drivers_is_nearly_that_of_the_score(seed: int) -> None:
    """On 20 procedural contexts as they were drawn, on the twin. It does not hold everywhere.

    Among what can be done with the same vehicles, both rewards had 82 and 83 of 85 pairs in order (seeds 0 and 1). With
    human driving among the drivers it was 147 of 152 with seed 0, and with seed 1 143 (local) and 147 (team) of 155:
    of 13 pairs in which human drivers beat the CVs nobody commands or glide there, 9 and 6 were in the wrong order.
    """
    generator = np.random.default_rng(seed)
    drawn = [ProceduralSource().sample(generator).replace(adoption=1 / 3) for _ in range(CONTEXTS)]
    drivers: dict[str, tuple[list[Context], Drive]] = {
        # With the parameters of human drivers, CVs that nobody commands drive as at adoption 0, and can be paid.
        "human": ([dataclasses.replace(context, cv_vehicle="human") for context in drawn], defer),
        "uncommanded": (drawn, defer),
        "glide": (drawn, glide()),
        "crawling": (drawn, braking(4.0, 0.0)),
        "blocking": (drawn, braking(0.0, 150.0)),
    }
    found = {driver: played(*options) for driver, options in drivers.items()}
    for reward in REWARDS:
        (right, whole), (all_right, all_whole) = (ordered(found, reward, k) for k in (tuple(found)[1:], tuple(found)))
        print(seed, reward, f"{right}/{whole}, with human {all_right}/{all_whole}")
        assert whole > 50 and right >= 0.93 * whole
        assert all_right >= 0.9 * all_whole
        # Who blocks is paid less than who does nothing, wherever that counts at all.
        assert (found["blocking"][reward] < found["uncommanded"][reward]).mean() >= 0.9


def test_sums_without_fuel_or_time_are_refused() -> None:
    with pytest.raises(IzooError, match=r"reward\.beta and reward\.delay are both 0"):
        RewardConfig(sums=True, beta=0.0)


def test_shares_do_not_overlap_and_nobody_is_forgotten() -> None:
    """At full adoption each vehicle has an owner, so what agents get on one approach adds up to the team's."""
    everyone = dataclasses.replace(single(), adoption=1.0)
    config = dataclasses.replace(CONFIG, horizon_s=225.0)
    with contextlib.closing(EcoDrivingEnv(everyone, config=config)) as env:
        state = env.reset(context=everyone, seed=4)
        units = env.backend.episode._rules  # type: ignore[attr-defined]
        scale = float(units.unit_g[0] / units.fleet_g_per_step)
        for _ in range(config.decisions):
            asked = state["agents", "mask"].clone()
            before = set(state["agents", "vehicle"][asked].tolist())
            state = env.step_lean(defer(state))
            if set(state["agents", "vehicle"][state["agents", "mask"]].tolist()) <= before:  # a newcomer is not paid
                total = torch.tensor(float(state["agents", "reward"].sum()) * scale)
                torch.testing.assert_close(total, state["team_reward"][0], rtol=1e-3, atol=1e-3)
