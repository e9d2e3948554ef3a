"""The planner: what it tries is what happens, and what it finds is better than doing nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from izoo.benchmarks import planner
from izoo.benchmarks.planner_options import PlannerConfig
from izoo.benchmarks.whole_episodes import per_vehicle_g, played, scripted
from izoo.conf import compose
from izoo.contexts.procedural import procedural_context
from izoo.envs import TwinEnv
from izoo.envs.config import EnvConfig

BUSY = procedural_context(inflow_vph_per_lane=550.0, green_s=22.0, red_s=28.0, lane_length_m=350.0, adoption=0.5)
ENV = EnvConfig(horizon_s=260.0, num_agents=24, num_vehicles=96)


def options(**changes: object) -> PlannerConfig:
    return PlannerConfig(**{"env": ENV, "threads": 1, "look_ahead_s": 60.0, "every_s": 5.0, **changes})  # type: ignore[arg-type]


def test_yaml_equals_the_dataclass() -> None:
    assert compose.compose_config("benchmarks.planner", PlannerConfig, []) == PlannerConfig()


@pytest.mark.slow
def test_a_trial_foresees_what_happens() -> None:
    """What a branch says of "as it is" is what the world then earns, to the last bit."""
    config = options(look_ahead_s=5.0)
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
def test_the_planner_earns_more_than_doing_nothing() -> None:
    config = options()
    env = planner.settings(config)
    plays = [(BUSY, 3), (BUSY, 4)]
    found = {
        name: played(plays, env, config.threads, make)
        for name, make in (
            ("uncommanded", scripted("uncommanded", env)),
            ("planner", lambda world: planner.Planner(world, config).act),
        )
    }
    rate = {name: per_vehicle_g(sums["demand_emission_g"], sums["crossed"]) for name, sums in found.items()}
    assert (found["planner"]["crossed"] >= found["uncommanded"]["crossed"]).all()
    assert rate["planner"].mean() < 0.99 * rate["uncommanded"].mean()


@pytest.mark.slow
def test_the_command_writes_its_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "planner.json"
    words = ["contexts=pcg", "contexts.lane_count=[1,2]", "num_contexts=2", "adoptions=[0.5]", "env.horizon_s=160"]
    words += ["contexts.inflow_vph_per_lane=500", "contexts.lane_length_m=120", "look_ahead_s=20", "every_s=10"]
    assert planner.main([*words, f"out={tmp_path}/nowhere/rows.json"]) == 2 and "no folder" in capsys.readouterr().err
    assert planner.main([*words, "threads=1", f"out={out}"]) == 0
    result = json.loads(out.read_text())
    assert len(result["rows"]) == 2 and {row["adoption"] for row in result["rows"]} == {0.5}
    assert all(row["crossed_planner"] > 0 for row in result["rows"])
    assert len({row["context_hash"] for row in result["rows"]}) == 2
    assert "What there is to gain" in capsys.readouterr().out
    before, more = out.read_text(), [word.replace("adoptions=[0.5]", "adoptions=[0.5,1.0]") for word in words]
    assert planner.main([*more, "threads=1", f"out={out}"]) == 0
    again = json.loads(out.read_text())
    assert again["rows"][:2] == result["rows"] and [row["adoption"] for row in again["rows"]] == [0.5, 0.5, 1.0, 1.0]
    assert "holds 2 episodes" in capsys.readouterr().out
    assert planner.main([*words, "every_s=5", f"out={out}"]) == 2
    assert "every_s=10" in capsys.readouterr().err and out.read_text() != before
    again["versions"]["drivers"] = "before"
    out.write_text(json.dumps(again))
    assert planner.main([*more, f"out={out}"]) == 2 and "made by other versions" in capsys.readouterr().err
    other = tmp_path / "other.json"
    other.write_text("[]")
    assert planner.main([*words, f"out={other}"]) == 2 and other.read_text() == "[]"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["adoptions=[0]"], "adoptions is 0"),
        (["caps=[]"], "adoptions and caps each need one"),
        (["every_s=0.1"], "every_s is 0.1"),
        (["look_ahead_s=1"], "look_ahead_s is 1"),
        (["every_s=1.3", "env.horizon_s=50"], "whole multiple"),
    ],
)
def test_what_cannot_work_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert planner.main([*words, "contexts=pcg_easy", "num_contexts=1"]) == 2
    assert message in capsys.readouterr().err


def row(k: int, planner_g: float, planner_crossed: float) -> dict[str, object]:
    own = {"human": (1000.0, 10.0), "uncommanded": (1000.0, 10.0), "glide": (900.0, 10.0)}
    own["planner"] = (planner_g, planner_crossed)
    sums = {f"demand_emission_g_{name}": burned_g for name, (burned_g, _) in own.items()}
    sums |= {f"crossed_{name}": crossed for name, (_, crossed) in own.items()}
    return {"adoption": 1.0, "lanes": 1, "intersection": f"place {k}", **sums}


def test_a_blocked_road_is_no_saving() -> None:
    """Whoever has not crossed burns, too."""
    rows = [row(0, 3000.0, 0.0), *(row(k, 900.0, 10.0) for k in range(1, 4))]
    (line,) = planner.summary(rows)
    assert line["planner"]["value"] == pytest.approx(((1 - 3000 / 100) + 3 * 0.1) / 4)
    assert line["planner_crossed"]["value"] == pytest.approx(-0.25) and line["glide"]["value"] == pytest.approx(0.1)


@pytest.mark.slow
def test_what_is_played_counts_those_who_have_not_crossed() -> None:
    """Commands to stand still keep everyone from the stop line, but not from burning."""
    env = EnvConfig(horizon_s=160.0, num_agents=24, num_vehicles=96)

    def still(state: TensorDictBase) -> TensorDictBase:
        state.set(("agents", "action"), torch.full((*state.batch_size, env.num_agents, 1), -9.0))
        return state.set(("agents", "defer"), torch.zeros(*state.batch_size, env.num_agents, dtype=torch.bool))

    blocked = played([(BUSY.replace(adoption=1.0), 3)], env, 1, lambda world: still)
    free = played([(BUSY.replace(adoption=1.0), 3)], env, 1, scripted("uncommanded", env))
    assert blocked["crossed"][0] < free["crossed"][0]
    rates = [float(per_vehicle_g(sums["demand_emission_g"], sums["crossed"])[0]) for sums in (blocked, free)]
    assert rates[0] > rates[1] > 0.0, "standing is no saving"
