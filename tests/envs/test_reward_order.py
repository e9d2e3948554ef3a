"""Each reward by its argmax: it orders drivers as the headline score does, and keeping others out does not pay."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.errors import IzooError
from tests.envs.worlds import defer

CONFIG = EnvConfig(horizon_s=625.0, reward=RewardConfig.fuel(), emit=("metrics", "team_reward"))
MARGIN_PCT = 1.5
"""Drivers whose scores are closer than this are not ordered: a vehicle that just makes it past the horizon moves the
mean of some fifty by as much."""
CONTEXTS = {
    "single": {"lane_count": 1, "inflow_vph_per_lane": 330.0, "lane_length_m": 300.0, "approach": "A"},
    "long": {"lane_count": 1, "inflow_vph_per_lane": 280.0, "lane_length_m": 420.0, "approach": "A"},
    "all": {"lane_count": 2, "inflow_vph_per_lane": 220.0, "lane_length_m": 250.0, "approach": "all"},
}


def context(name: str) -> Context:
    plan = {"phase_count": 1, "green_s": 30.0, "red_s": 30.0, "offset_s": 2.0, "speed_limit_mps": 15.0}
    return procedural_context(adoption=1 / 3, **{**plan, **CONTEXTS[name]})


def braking(below_mps: float, from_m: float) -> Callable[[TensorDictBase], TensorDictBase]:
    """Brake to a speed farther than ``from_m`` before the stop line; nearer, leave it to SUMO."""

    def act(state: TensorDictBase) -> TensorDictBase:
        observation = state["agents", "observation"]
        speed, distance = observation[..., 0] * 15.0, -observation[..., 1] * 250.0
        state["agents", "action"] = ((below_mps - speed) / 0.5).clamp(-3.0, 2.6).unsqueeze(-1)
        state["agents", "defer"] = distance < from_m
        return state

    return act


def glide() -> Callable[[TensorDictBase], TensorDictBase]:
    from izoo.algos.scripted import make_driver

    return make_driver("glide", CONFIG)


def outcome(env: EcoDrivingEnv, where: Context, act: Callable[[TensorDictBase], TensorDictBase]) -> dict[str, float]:
    """CO2 per vehicle, crossings, and the sum of each reward over an episode."""
    state, local, team = env.reset(context=where, seed=4), 0.0, 0.0
    for _ in range(CONFIG.decisions):
        state = env.step_lean(act(state))
        local += float(state["agents", "reward"].sum())
        team += float(state["team_reward"])
    sums = {name: float(value.sum()) for name, value in state["metrics", "approach"].items()}
    grams = sums["emission_g"] / max(sums["crossed"], 1.0)
    return {"grams": grams, "crossed": sums["crossed"], "local": local, "team": team, "due": sums["due"]}


@pytest.mark.parametrize("name", ["single", *(pytest.param(name, marks=pytest.mark.slow) for name in ("long", "all"))])
def test_the_order_of_drivers_is_that_of_the_score(name: str) -> None:
    where = context(name)
    # With the parameters of human drivers, CVs that nobody commands drive as at adoption 0, and can be paid.
    drivers = {
        "human": (dataclasses.replace(where, cv_vehicle="human"), defer),
        "uncommanded": (where, defer),
        "glide": (where, glide()),
        "crawling": (where, braking(4.0, 0.0)),
        "blocking": (where, braking(0.0, 150.0)),
    }
    with contextlib.closing(EcoDrivingEnv(where, config=CONFIG)) as env:
        found = {driver: outcome(env, *played) for driver, played in drivers.items()}
    human = found["human"]
    score = {
        # One vehicle more or less at the horizon is no fall of throughput here.
        driver: 100.0 * (1.0 - row["grams"] / human["grams"]) if row["crossed"] >= human["crossed"] - 1.0 else -100.0
        for driver, row in found.items()
    }
    print(name, {k: (round(score[k], 1), round(row["local"], 1), round(row["team"], 1)) for k, row in found.items()})
    assert score["blocking"] == -100.0
    for reward in ("local", "team"):
        ordered = 0
        for one, other in itertools.permutations(found, 2):
            if score[one] > score[other] + MARGIN_PCT:
                assert found[one][reward] > found[other][reward], f"{reward}: {one} before {other}"
                ordered += 1
        assert ordered >= 6
        assert found["blocking"][reward] == min(row[reward] for row in found.values())


def test_sums_without_fuel_or_time_are_refused() -> None:
    with pytest.raises(IzooError, match=r"reward\.beta and reward\.delay are both 0"):
        RewardConfig(sums=True, beta=0.0)


def test_shares_do_not_overlap_and_nobody_is_forgotten() -> None:
    """At full adoption each vehicle has an owner, so what agents get on one approach adds up to the team's."""
    everyone = dataclasses.replace(context("single"), adoption=1.0)
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
