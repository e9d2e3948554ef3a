"""The planner: what it tries is what happens, and what it finds is better than leaving CVs uncommanded."""

from pathlib import Path
from typing import Any

import pytest
import torch

from izoo.benchmarks import planner
from izoo.benchmarks.planner import PlannerConfig
from izoo.contexts.procedural import procedural_context
from izoo.envs import TwinEnv
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.metrics.figures import FIGURES
from izoo.results.rollout import Play, rollout
from izoo.results.schema import make_table

BUSY = procedural_context(inflow_vph_per_lane=550.0, green_s=22.0, red_s=28.0, lane_length_m=350.0, adoption=0.5)
ENV = EnvConfig(horizon_s=260.0, num_agents=24, num_vehicles=96)


def options(look_ahead_s: float = 60.0) -> PlannerConfig:
    return PlannerConfig(ENV, look_ahead_s=look_ahead_s, every_s=5.0)


@pytest.mark.slow
def test_a_trial_foresees_what_happens() -> None:
    """What a branch says of "as it is" is what the world then earns, to the last bit."""
    config = options(5.0)
    env = planner.settings(config)
    world = TwinEnv(2, lambda number: (BUSY, 3 + number % 2), config=env, threads=1, surrogate="compiled")
    state = world.reset()
    agent = planner.Planner(world, config)
    foreseen, earned = [], []
    for _ in range(30):
        slot = torch.zeros(2, dtype=torch.int64)
        worth = agent._tried(slot, agent.advice[torch.arange(2), slot].unsqueeze(-1).expand(2, 7).clone())
        assert torch.equal(worth, worth[:, :1].expand_as(worth)), "the same advice has the same worth in every branch"
        foreseen.append(worth[:, 0].clone())
        agent._forget(agent.advice, state)
        following = world.step_lean(agent._command(state, agent.advice))
        earned.append(following["team_reward"].squeeze(-1).clone())
        state = following.exclude(("agents", "reward"))
    torch.testing.assert_close(torch.stack(foreseen), torch.stack(earned), rtol=0.0, atol=0.0)
    assert torch.stack(earned).abs().sum() > 0
    world.close()


@pytest.mark.slow
def test_the_planner_burns_less_than_uncommanded_cvs(tmp_path: Path) -> None:
    config = options()
    plays = [Play(name, 0, BUSY, seed) for name in ("uncommanded", "planner") for seed in (3, 4)]
    own, settings = {"planner": planner.Planning(config)}, planner.settings(config)
    options_ = {"simulator": "twin", "workers": 1, "record": ("team_reward",), "cache": tmp_path}
    played = rollout(plays, own, settings, **options_)
    table = make_table([row for each in played for row in each.rows])
    sums = table.groupby("policy")[["cohort", "cohort_left", "cohort_region_co2_g", "cohort_blocked_co2_g"]].sum()
    assert (sums["cohort"] == sums["cohort_left"]).all() and sums["cohort"].nunique() == 1
    burned = dict(zip(sums.index, FIGURES["co2_g"].value(sums, sums), strict=True))
    assert burned["planner"] < 0.97 * burned["uncommanded"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"caps": ()}, "caps needs one"),
        ({"every_s": 0.1}, "every_s is 0.1"),
        ({"look_ahead_s": 1.0}, "look_ahead_s is 1"),
        ({"every_s": 1.3}, "whole multiple"),
    ],
)
def test_what_cannot_work_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        PlannerConfig(**options)
