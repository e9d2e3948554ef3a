"""Desired speeds as actions: 1 leaves everything as it is, and what less does is the same in SUMO and on the twin."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.algos.drivers.by_name import make_driver
from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from tests.envs.worlds import crossing, defer, digest, play, same

SEED = 7
LIMIT_MPS = 16.0
Act = Callable[[TensorDictBase], TensorDictBase]


def speeds(**changes: Any) -> EnvConfig:
    return EnvConfig(**({"horizon_s": 300.0, "action": "speed", "emit": ("vehicles", "metrics", "number")} | changes))


def one_lane(**changes: Any) -> Context:
    values = {"lane_count": 1, "phase_count": 1, "inflow_vph_per_lane": 500.0, "approach": "A", "adoption": 0.5}
    return procedural_context(**(values | changes))


def share_for_all(share: float, parts: int = 1) -> Act:
    def act(state: TensorDictBase) -> TensorDictBase:
        state["agents", "action"] = torch.full((*state["agents", "mask"].shape, parts), share)
        return state

    return act


def share_each(state: TensorDictBase) -> TensorDictBase:
    """0.3 to 1 by the vehicle's number."""
    state["agents", "action"] = (0.3 + 0.1 * (state["agents", "number"] % 8)).float().unsqueeze(-1)
    return state


class Anew:
    """Other shares for everybody every 20 s, 1 among them."""

    def __init__(self) -> None:
        self.step = 0

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        share = 0.3 + 0.1 * ((state["agents", "number"] + self.step // 40) % 8)
        self.step += 1
        state["agents", "action"] = share.float().unsqueeze(-1)
        return state


def two_parts(state: TensorDictBase) -> TensorDictBase:
    """Slow before the stop line and free behind it, or the other way round, by the vehicle's number."""
    slow, free = torch.tensor([0.5, 1.0]), torch.tensor([1.0, 0.6])
    even = (state["agents", "number"] % 2 == 0).unsqueeze(-1)
    state["agents", "action"] = torch.where(even, slow, free)
    return state


def episode(simulator: str, context: Context, config: EnvConfig, act: Act) -> TensorDict:
    with contextlib.closing(EcoDrivingEnv(config=config, worker=0, simulator=simulator)) as env:
        return play(env, config.control_steps, act, env.reset(context=context, seed=SEED))


def motion(frames: TensorDict) -> list[dict[int, tuple[float, float]]]:
    """Position and speed of every vehicle by its number, step by step."""
    found = []
    for vehicles in frames["next", "vehicles"].unbind(0):
        there = vehicles["present"]
        columns = (vehicles[name][there].tolist() for name in ("vehicle_number", "path_position_m", "speed_mps"))
        found.append({number: (position, speed) for number, position, speed in zip(*columns, strict=True)})
    return found


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_1_is_uncommanded(simulator: str) -> None:
    """Nothing at all is told to the simulator: on several lanes too, all is the same to the last bit."""
    ours = episode(simulator, crossing(), speeds(), share_for_all(1.0))
    theirs = episode(simulator, crossing(), speeds(action="acceleration"), defer)
    for frames in (ours, theirs):
        del frames["agents", "action"]
        frames.pop(("agents", "defer"), None)
    assert same(ours, theirs)
    assert digest(ours) == digest(theirs)


@pytest.mark.slow
@pytest.mark.parametrize("act", [share_for_all(0.5), share_for_all(0.8), share_each, Anew])
@pytest.mark.parametrize(
    "features",
    [
        {},
        {"speed_limit_mps": 20.0, "approach": "all"},
        {"phase_count": 2, "inflow_vph_per_lane": 600.0, "lane_length_m": 500.0, "approach": "all"},
        {"inflow_vph_per_lane": 700.0, "lane_length_m": 150.0, "approach": "all"},
    ],
)
def test_sumo_and_twin_drive_alike(features: dict[str, Any], act: Any) -> None:
    context = one_lane(**features)
    acts = [act() if isinstance(act, type) else act for _ in range(2)]
    sumo, twin = (motion(episode(name, context, speeds(), a)) for name, a in zip(("sumo", "twin"), acts, strict=True))
    assert sum(map(len, sumo)) > 3000
    for step, (ours, theirs) in enumerate(zip(twin, sumo, strict=True)):
        assert ours.keys() == theirs.keys(), step
        for number, place in theirs.items():
            assert ours[number] == pytest.approx(place, abs=1e-6), (step, number)


def test_before_and_behind_the_line_alike() -> None:
    config = speeds(action_parts=("speed_before", "speed_behind"))
    sumo, twin = (motion(episode(name, one_lane(), config, two_parts)) for name in ("sumo", "twin"))
    for ours, theirs in zip(twin, sumo, strict=True):
        assert ours.keys() == theirs.keys()
        for number, place in theirs.items():
            assert ours[number] == pytest.approx(place, abs=1e-6)
    cvs = {n for n in range(200) if n % 2 == 0}
    free = [speed for places in sumo for n, (x, speed) in places.items() if n not in cvs and x < -30.0]
    assert max(free) > 0.9 * LIMIT_MPS


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_the_share_is_kept_to_gently(simulator: str) -> None:
    """Nobody is faster than its share once it is there, and nobody brakes hard to get there."""
    frames = episode(simulator, one_lane(inflow_vph_per_lane=150.0, adoption=1.0), speeds(), share_for_all(0.6))
    vehicles = frames["next", "vehicles"]
    cvs = vehicles["present"] & vehicles["is_cv"]
    speed, accel = vehicles["speed_mps"][cvs], vehicles["accel_mps2"][cvs]
    slowing = speed > 0.6 * LIMIT_MPS + 1e-4
    assert slowing.float().mean() < 0.2
    assert (accel[slowing] < -0.1).any()
    assert accel[slowing].min() > -1.51
    assert speed[~slowing].max() == pytest.approx(0.6 * LIMIT_MPS, abs=1e-3)


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_nan_and_defer_leave_a_vehicle_alone(simulator: str) -> None:
    def nan(state: TensorDictBase) -> TensorDictBase:
        return share_for_all(float("nan"))(state)

    def deferred(state: TensorDictBase) -> TensorDictBase:
        state["agents", "defer"] = state["agents", "mask"].clone()
        return share_for_all(0.4)(state)

    config = speeds(horizon_s=120.0)
    free, lost, left = (episode(simulator, one_lane(), config, a) for a in (share_for_all(1.0), nan, deferred))
    assert motion(free) == motion(lost) == motion(left)
    sums = [frames[-1]["next", "metrics", "approach"] for frames in (free, lost, left)]
    assert [s["nan_actions"].sum().item() > 0 for s in sums] == [False, True, False]
    for s in sums:
        assert s["deferred_steps"].sum() == s["agent_steps"].sum() > 0


def test_a_cap_is_the_scripted_driver() -> None:
    config = speeds(horizon_s=120.0)
    driver = make_driver("cap_0.6", config)
    with torch.no_grad():
        ours = episode("twin", one_lane(), config, driver)
    assert motion(ours) == motion(episode("twin", one_lane(), config, share_for_all(0.6)))
    free = make_driver("uncommanded", config)(TensorDict({"agents": TensorDict({"mask": torch.ones(3, dtype=bool)})}))
    assert free["agents", "action"].tolist() == [[1.0]] * 3


@pytest.mark.parametrize("name", ["constant", "constant_2.0", "glide"])
def test_drivers_that_command_accelerations_are_refused(name: str) -> None:
    with pytest.raises(IzooError, match=r"env\.action=acceleration"):
        make_driver(name, speeds())


def test_what_is_asked_for_is_said() -> None:
    with pytest.raises(IzooError, match="one on either side"):
        EnvConfig(action="speed", action_parts=("speed", "speed_behind"))
    with pytest.raises(IzooError, match=r"env\.action=speed"):
        EnvConfig(action_parts=("speed_before", "speed_behind"))
    with pytest.raises(IzooError, match="lane_change"):
        EnvConfig(action="speed", lane_change=True)
    with pytest.raises(IzooError, match=r"env\.action"):
        EnvConfig(action="velocity")
    with (
        contextlib.closing(EcoDrivingEnv(config=speeds(), worker=0, simulator="twin")) as env,
        pytest.raises(IzooError, match="shares of the speed limit"),
    ):
        env.step(share_for_all(0.5, parts=2)(env.reset(context=one_lane(), seed=1)))


def test_speeds_below_the_least_share_are_the_least() -> None:
    """What is below the bounds of the action is cut to them, as accelerations are."""
    config = speeds(horizon_s=80.0)
    low, lower = (motion(episode("twin", one_lane(), config, share_for_all(s))) for s in (0.1, 0.01))
    for ours, theirs in zip(low, lower, strict=True):
        assert ours.keys() == theirs.keys()
        for number, place in theirs.items():
            assert ours[number] == pytest.approx(place, abs=1e-3)


@pytest.mark.parametrize("decide", ["step", "vehicle"])
@pytest.mark.parametrize("share", [0.0, -0.2, 1.2])
def test_a_speed_that_is_no_share_is_refused_where_it_is_asked_for(share: float, decide: str) -> None:
    with contextlib.closing(EcoDrivingEnv(config=speeds(decide=decide), worker=0, simulator="twin")) as env:
        state = env.reset(context=one_lane(), seed=1)
        while not state["agents", "mask"].any():
            state = env.step(share_for_all(0.5)(state))["next"]
        with pytest.raises(IzooError, match=r"desired speeds of \[.*above 0 and up to 1"):
            env.step(share_for_all(share)(state))
        wrong = share_for_all(share)(state)
        wrong["agents", "defer"] = state["agents", "mask"]
        state = env.step(wrong)["next"].exclude(("agents", "reward"))
        others = share_for_all(0.5)(state)
        others["agents", "action"][~state["agents", "mask"]] = share
        others["agents", "defer"] = torch.zeros_like(state["agents", "mask"])
        env.step(others)


@pytest.mark.parametrize("simulator", [pytest.param("sumo", marks=pytest.mark.slow), "twin"])
@pytest.mark.parametrize("decide", ["step", "vehicle"])
def test_a_speed_before_the_line_alone_leaves_everybody_alone_behind_it(simulator: str, decide: str) -> None:
    both = speeds(horizon_s=120.0, decide=decide, action_parts=("speed_before", "speed_behind"))
    before = speeds(horizon_s=120.0, decide=decide, action_parts=("speed_before",))

    def one_behind(state: TensorDictBase) -> TensorDictBase:
        share = share_for_all(0.5)(state)["agents", "action"]
        state["agents", "action"] = torch.cat([share, torch.ones_like(share)], -1)
        return state

    expected, found = (
        motion(episode(simulator, one_lane(), config, act))
        for config, act in ((both, one_behind), (before, share_for_all(0.5)))
    )
    assert expected == found and any(expected)
