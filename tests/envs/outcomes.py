"""Drivers whose outcomes are compared, and their outcomes on the twin by an evaluation's measure."""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.envs import EnvConfig, TwinEnv
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from tests.envs.worlds import defer, one_lane

Drive = Callable[[TensorDictBase, float], TensorDictBase]
"""``act(state, time since the warm-up in s)``."""
Rule = Callable[[torch.Tensor, torch.Tensor, float], torch.Tensor]
"""Maps speed (m/s), distance to the stop line (m) and time since the warm-up (s) to the desired speed."""
STEP_S = 0.5


def lane(**changes: Any) -> Context:
    road = {"inflow_vph_per_lane": 300.0, "lane_length_m": 250.0, "speed_limit_mps": 15.0, "adoption": 1 / 3}
    return one_lane(**({"green_s": 30.0, "red_s": 30.0} | road | changes))


def driving(rule: Rule, until_m: float = 0.0) -> Drive:
    """Let CVs drive by a rule, uncommanded from ``until_m`` before the stop line on.

    Args:
        rule: the desired speed.
        until_m: below 0, CVs are commanded behind the line too.
    """

    def act(state: TensorDictBase, time_s: float) -> TensorDictBase:
        observation = state["agents", "observation"]
        speed, distance = observation[..., 0] * 15.0, -observation[..., 1] * 250.0
        wanted = rule(speed, distance, time_s)
        state["agents", "action"] = ((wanted - speed) / STEP_S).clamp(-3.0, 2.6).unsqueeze(-1)
        state["agents", "defer"] = distance < until_m
        return state

    return act


def crawling(speed: torch.Tensor, distance: torch.Tensor, time_s: float) -> torch.Tensor:
    return torch.full_like(speed, 4.0)


def standing(speed: torch.Tensor, distance: torch.Tensor, time_s: float) -> torch.Tensor:
    return torch.zeros_like(speed)


def stopping(speed: torch.Tensor, distance: torch.Tensor, time_s: float) -> torch.Tensor:
    """Stop for two minutes of six."""
    return torch.full_like(speed, 0.0 if time_s % 360.0 < 120.0 else 40.0)


def shifting(speed: torch.Tensor, distance: torch.Tensor, time_s: float) -> torch.Tensor:
    """Drive slowly up to the stop line, and fast behind it."""
    return torch.where(distance > 0.0, 10.0, 40.0) * torch.ones_like(speed)


def uncommanded(state: TensorDictBase, time_s: float) -> TensorDictBase:
    return defer(state)


def glide() -> Drive:
    from izoo.algos.drivers.by_name import make_driver

    driver = make_driver("glide", EnvConfig(step_s=STEP_S))
    return lambda state, time_s: driver(state)


class Outcome(NamedTuple):
    """Sums and returns of contexts that were played on the twin: ``[N]`` each."""

    sums: dict[str, np.ndarray]
    local: np.ndarray
    team: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """CO2 in g and half a gram per second of delay, per vehicle of the cohort."""
        seconds = self.sums["cohort_region_delay_s"] + self.sums["cohort_blocked_s"]
        return self.co2_g + 0.5 * seconds / self.sums["cohort"]

    @property
    def co2_g(self) -> np.ndarray:
        """CO2 in g per vehicle of the cohort."""
        return (self.sums["cohort_region_co2_g"] + self.sums["cohort_blocked_co2_g"]) / self.sums["cohort"]

    @property
    def to_line_g(self) -> float:
        """The paper's form: CO2 up to the stop line per vehicle that crossed it within the horizon, of all contexts."""
        return float(self.sums["emission_g"].sum() / self.sums["crossed"].sum())


def outcome(contexts: list[Context], act: Drive, config: EnvConfig) -> Outcome:
    """Play one episode of every context to its end."""
    options: dict[str, Any] = {"config": config, "threads": 1, "surrogate": "compiled"}
    env = TwinEnv(len(contexts), lambda number: (contexts[number % len(contexts)], 4 + number), **options)
    with contextlib.closing(env):
        state, steps = env.reset(), 0
        local, team = torch.zeros(2, len(contexts), dtype=torch.float64)
        while not state["done"].all():
            state = env.step_lean(act(state, steps * config.decision_s))
            steps += 1
            local += state["agents", "reward"].sum((-1, -2))
            team += state["team_reward"].squeeze(-1)
    sums = {name: state["metrics", "approach", name].sum(-1).double().numpy() for name in APPROACH_METRICS}
    return Outcome(sums, local.numpy(), team.numpy())
