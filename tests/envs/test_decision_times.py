"""Decisions once per vehicle: when a CV must decide, how long its decision holds, and how long a step lasts."""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from izoo.benchmarks.planner import PlannerConfig
from izoo.envs import EcoDrivingEnv, EnvConfig, TwinEnv
from izoo.envs.views.gymnasium import EcoDrivingEgo, EcoDrivingJoint
from izoo.errors import IzooError
from tests.envs.conftest import MakeTwin
from tests.envs.test_determinism import schedule
from tests.envs.worlds import crossing, places, play_on, same

SIMULATORS = ("sumo", "twin")
SEED = 7
Act = Callable[[TensorDictBase], TensorDictBase]


def scope(decide: str = "vehicle", **changes: Any) -> EnvConfig:
    values = {"horizon_s": 120.0, "warmup_s": 5.0, "decide": decide, "action": "speed", "emit": ("vehicles", "number")}
    return EnvConfig(**(values | changes))


def by_number(state: TensorDictBase) -> TensorDictBase:
    """0.3 to 1 by the vehicle's number; NaN, which must not matter, for agents that need not decide."""
    number = state["agents", "number"]
    share = (0.3 + 0.1 * (number % 8)).float()
    asked = state["agents"].get("decides", number >= 0)
    state["agents", "action"] = torch.where(asked, share, torch.nan).unsqueeze(-1)
    return state


def steps(env: EnvBase, act: Act, state: TensorDictBase) -> Iterator[TensorDictBase]:
    """Steps of one episode."""
    over = False
    while not over:
        state = act(state)
        following = env.step(state)["next"]
        yield state.clone().set("next", following)
        over = bool(following["done"].all())
        state = following.exclude(("agents", "reward"))


def whole(simulator: str, config: EnvConfig, act: Act = by_number, **context: Any) -> list[TensorDictBase]:
    with contextlib.closing(EcoDrivingEnv(config=config, worker=0, simulator=simulator)) as env:
        return list(steps(env, act, env.reset(context=crossing(**context), seed=SEED)))


def returns(frames: list[TensorDictBase]) -> dict[int, float]:
    """The sum of each vehicle's rewards."""
    sums: dict[int, float] = defaultdict(float)
    for frame in frames:
        numbers = frame["agents", "number"]
        for number, reward in zip(numbers.tolist(), frame["next", "agents", "reward"].flatten().tolist(), strict=True):
            sums[number] += reward
    sums.pop(-1, None)
    return dict(sums)


def played(frame: TensorDictBase) -> int:
    return int(frame["next", "metrics", "episode", "steps"])


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_decision_equals_one_repeated_in_every_step(simulator: str) -> None:
    """The same shares in every step: the same traffic at every decision, and the same total rewards."""
    emit = ("vehicles", "number", "metrics")
    once = whole(simulator, scope(emit=emit))
    every = whole(simulator, scope("step", emit=emit))
    assert len(once) < len(every) / 3
    by_step = {played(frame): frame["next"] for frame in every}
    for frame in once:
        assert places(frame["next", "vehicles"]) == places(by_step[played(frame)]["vehicles"])
    assert returns(once) == pytest.approx(returns(every), abs=1e-3)
    ours, theirs = once[-1]["next", "metrics"], every[-1]["next", "metrics"]
    for group in ("approach", "episode"):
        for name, value in ours[group].items():
            torch.testing.assert_close(value, theirs[group, name], msg=name)


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("decide", ["vehicle", "vehicle_and_line"])
def test_cvs_decide_when_they_enter_and_when_they_cross_the_line(simulator: str, decide: str) -> None:
    expected: dict[int, set[str]] = defaultdict(set)
    for frame in whole(simulator, scope(decide, hold_s=0.5)):
        agents, vehicles = frame["agents"], frame["vehicles"]
        for number, decides, row in zip(*(agents[n].tolist() for n in ("number", "decides", "vehicle")), strict=True):
            if number < 0:
                assert not decides
                continue
            stage = "before" if vehicles["location"][row] == 0 else "behind"
            due = number not in expected or (
                decide != "vehicle" and stage == "behind" and stage not in expected[number]
            )
            assert decides == due, number
            if due:
                expected[number].add(stage)
    assert sum(found == {"before", "behind"} for found in expected.values()) >= (0 if decide == "vehicle" else 5)
    assert len(expected) > 20


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_step_lasts_until_a_cv_must_decide(simulator: str) -> None:
    """Or until the end; cut into simulation steps it is the same episode."""
    long, short = (whole(simulator, scope(hold_s=hold, emit=("vehicles", "metrics"))) for hold in (None, 0.5))
    assert all(frame["next", "agents", "decides"].any() for frame in long[:-1])
    ends = [k for k, frame in enumerate(short) if frame["next", "agents", "decides"].any()] + [len(short) - 1]
    assert [played(frame) for frame in long] == sorted({played(short[k]) for k in ends})
    assert returns(long) == pytest.approx(returns(short), abs=1e-3)
    leavers = torch.stack([frame["next", "agents", "terminated"].sum() for frame in long]).sum()
    assert leavers == torch.stack([frame["next", "agents", "terminated"].sum() for frame in short]).sum() > 10


def test_cvs_decide_at_the_same_times_in_sumo_and_on_the_twin() -> None:
    """On one lane, with the drain: the same steps, deciding vehicles and rewards."""
    context = {"lane_count": 1, "phase_count": 1, "approach": "A", "inflow_vph_per_lane": 400.0}
    found = [
        whole(name, scope("vehicle_and_line", drain_s=300.0, emit=("vehicles", "metrics")), **context)
        for name in SIMULATORS
    ]
    assert len(found[0]) == len(found[1])
    for sumo, twin in zip(*found, strict=True):
        for name in ("decides", "number", "mask"):
            assert torch.equal(sumo["agents", name], twin["agents", name])
        torch.testing.assert_close(sumo["next", "agents", "reward"], twin["next", "agents", "reward"])
        assert played(sumo) == played(twin)
    last = found[0][-1]["next"]
    assert played(found[0][-1]) > 230 and not last["agents", "mask"].any()
    assert played(found[0][-1]) < 230 + 600
    assert 230 in {played(frame) for frame in found[0]}


@pytest.mark.parametrize("surrogate", ["torch", "compiled"])
@pytest.mark.parametrize("drain_s", [0.0, 200.0])
def test_each_environment_plays_what_it_plays_alone(surrogate: str, drain_s: float) -> None:
    """With its own number of steps; one that has ended stays unchanged."""
    config = scope(drain_s=drain_s)
    with (
        contextlib.closing(TwinEnv(5, schedule(), config=config, threads=2, surrogate=surrogate, shard=0)) as env,
        contextlib.closing(EcoDrivingEnv(schedule(), config=config, simulator="twin", worker=0)) as alone,
    ):
        state, frames = env.reset(), []
        while len(frames) < 400 and not (drain_s == 0.0 and frames and frames[-1]["next", "done"].any()):
            frames.append(env.step(by_number(state)))
            state = frames[-1]["next"].exclude(("agents", "reward"))
            if state["done"].all():
                break
        counts = []
        for k in range(5):
            ours = [frame[k] for frame in frames]
            for count, theirs in enumerate(steps(alone, by_number, alone.reset(episode=k))):
                if count == len(ours):
                    break
                for name in ("number", "decides", "mask"):
                    assert torch.equal(ours[count]["agents", name], theirs["agents", name])
                torch.testing.assert_close(
                    ours[count]["next", "agents", "reward"], theirs["next", "agents", "reward"], atol=1e-4, rtol=1e-4
                )
            counts.append(count + 1)
            for frame in ours[count + 2 :]:
                assert not frame["agents", "decides"].any() and not frame["agents", "mask"].any()
                assert (frame["agents", "number"] == -1).all()
        assert drain_s == 0.0 or len(set(counts)) > 1


@pytest.mark.parametrize("decide", ["vehicle", "vehicle_and_line"])
def test_states_and_branches(make_twin: MakeTwin, decide: str) -> None:
    """Decisions in force, and pending ones, are part of the state."""
    env, other = (make_twin(3, schedule(), config=scope(decide)) for _ in range(2))
    _, state = play_on(env, 25, by_number, env.reset())
    saved = env.state_dict()
    branches = env.branch(2)
    ahead, _ = play_on(env, 20, by_number, state)
    other.reset()
    other.load_state_dict(saved)
    action = ("agents", "action")  # it holds NaN
    ahead = ahead.exclude(action)
    assert same(ahead, play_on(other, 20, by_number, other.present())[0].exclude(action))
    forked = play_on(branches, 20, by_number, branches.present())[0].exclude(action)
    until = int(ahead["next", "done"].any(0).flatten().float().argmax()) if ahead["next", "done"].any() else 20
    assert same(ahead[:, :until], forked[::2, :until]) and same(ahead[:, :until], forked[1::2, :until])
    branches.close()


def test_accelerations_may_hold_too() -> None:
    def gently(state: TensorDictBase) -> TensorDictBase:
        action = torch.where(state["agents", "decides"], 0.5, torch.nan)
        state["agents", "action"] = action.unsqueeze(-1)
        return state

    frames = whole("twin", scope(action="acceleration", emit=("vehicles", "metrics")), gently)
    sums = frames[-1]["next", "metrics", "approach"]
    assert sums["nan_actions"].sum() == 0
    assert sums["deferred_steps"].sum() < 0.5 * sums["agent_steps"].sum()


@pytest.mark.parametrize("parts", [("speed",), ("speed_before", "speed_behind")])
def test_gymnasium_joint(parts: tuple[str, ...]) -> None:
    config = scope(action_parts=parts, horizon_s=60.0)
    shape = (64,) if len(parts) == 1 else (64, 2)
    with contextlib.closing(EcoDrivingJoint(crossing(), config, simulator="twin")) as env:
        assert env.action_space.shape == shape
        seen, _ = env.reset(seed=SEED)
        asked, over = 0, False
        while not over:
            assert env.observation_space.contains(seen)
            asked += int(seen["decides"].sum())
            seen, _, _, over, info = env.step(np.full(shape, 0.6, np.float32))
    assert asked > 3 and info["metrics"]["approach"]["agent_steps"].sum() > 10 * asked


def test_gymnasium_ego_decides_once() -> None:
    """An ego's episode is one step: its decision, and all its rewards until it leaves."""
    rewards = set()
    with contextlib.closing(EcoDrivingEgo(crossing(), scope(), simulator="twin")) as env:
        for _ in range(3):
            env.reset(seed=None if rewards else SEED)
            _, reward, terminated, truncated, info = env.step(np.array([0.6], np.float32))
            assert (terminated or truncated) and info["time_s"] > 5.0
            rewards.add(reward)
    assert len(rewards) == 3


def test_pettingzoo_marks_agents_that_must_decide() -> None:
    pettingzoo = pytest.importorskip("izoo.envs.views.pettingzoo")
    asked = []
    with contextlib.closing(pettingzoo.parallel_env(crossing(), scope(), simulator="twin")) as env:
        _, infos = env.reset(seed=SEED)
        while env.agents:
            asked += [agent for agent in env.agents if infos[agent]["decides"]]
            *_, infos = env.step({agent: np.array([0.6], np.float32) for agent in env.agents})
    assert len(asked) == len(set(asked)) > 3


def test_planners_and_lane_changes_need_decisions_in_every_step() -> None:
    for options in ({"decide": "vehicle"}, {"action": "speed"}):
        with pytest.raises(IzooError, match="the planner"):
            PlannerConfig(env=EnvConfig(**options))
    with pytest.raises(IzooError, match=r"env\.lane_change"):
        EnvConfig(decide="vehicle", lane_change=True)
