"""Desired speeds as actions: 1 is uncommanded, and lower ones have the same effect in SUMO and on the twin."""

import contextlib
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.algos.drivers.by_name import make_driver
from izoo.contexts.context import Context
from izoo.envs import SIMULATORS, EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from tests.envs.worlds import constant, crossing, defer, digest, one_lane, places, play, same, set_action

SEED = 7
LIMIT_MPS = 16.0
Act = Callable[[TensorDictBase], TensorDictBase]


def speeds(**changes: Any) -> EnvConfig:
    return EnvConfig(**({"horizon_s": 300.0, "action": "speed", "emit": ("vehicles", "metrics", "number")} | changes))


def share_each(state: TensorDictBase) -> TensorDictBase:
    """0.3 to 1 by the vehicle's number."""
    return set_action(state, (0.3 + 0.1 * (state["agents", "number"] % 8)).float().unsqueeze(-1))


def new_shares() -> Act:
    """Other shares for all vehicles every 20 s, 1 among them."""
    steps = itertools.count()

    def act(state: TensorDictBase) -> TensorDictBase:
        share = 0.3 + 0.1 * ((state["agents", "number"] + next(steps) // 40) % 8)
        return set_action(state, share.float().unsqueeze(-1))

    return act


def two_parts(state: TensorDictBase) -> TensorDictBase:
    """Slow before the stop line and free behind it, or the other way round, by the vehicle's number."""
    slow, free = torch.tensor([0.5, 1.0]), torch.tensor([1.0, 0.6])
    even = (state["agents", "number"] % 2 == 0).unsqueeze(-1)
    return set_action(state, torch.where(even, slow, free))


def episode(simulator: str, context: Context, config: EnvConfig, act: Act) -> TensorDict:
    with contextlib.closing(EcoDrivingEnv(config=config, worker=0, simulator=simulator)) as env:
        return play(env, config.control_steps, act, env.reset(context=context, seed=SEED))


def motion(frames: TensorDict) -> list[dict[int, tuple[float, float]]]:
    """Position and speed of every vehicle by its number, step by step."""
    return [places(vehicles) for vehicles in frames["next", "vehicles"].unbind(0)]


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_share_of_1_is_uncommanded(simulator: str) -> None:
    """Bit for bit, also on several lanes."""
    left_out, horizon = [("agents", "action"), ("agents", "defer")], {"horizon_s": 150.0}
    theirs = episode(simulator, crossing(), speeds(action="acceleration", **horizon), defer)
    for parts in (("speed",), ("speed_before", "stop"), ("stop", "glide")):
        ours = episode(simulator, crossing(), speeds(action_parts=parts, **horizon), constant(1.0, parts=len(parts)))
        assert same(ours.exclude(*left_out), theirs.exclude(*left_out)) and digest(ours) == digest(theirs)


def assert_same_motion(context: Context, config: EnvConfig, act: Callable[[], Act]) -> list[dict[int, Any]]:
    sumo, twin = (motion(episode(name, context, config, act())) for name in SIMULATORS)
    for step, (ours, theirs) in enumerate(zip(twin, sumo, strict=True)):
        assert ours.keys() == theirs.keys(), step
        for number, place in theirs.items():
            assert ours[number] == pytest.approx(place, abs=1e-6), (step, number)
    return sumo


@pytest.mark.slow
@pytest.mark.parametrize("act", [lambda: constant(0.5), lambda: constant(0.8), lambda: share_each, new_shares])
@pytest.mark.parametrize(
    "features",
    [
        {},
        {"speed_limit_mps": 20.0, "approach": "all"},
        {"phase_count": 2, "inflow_vph_per_lane": 600.0, "lane_length_m": 500.0, "approach": "all"},
        {"inflow_vph_per_lane": 700.0, "lane_length_m": 150.0, "approach": "all"},
    ],
)
def test_sumo_and_twin_drive_alike(features: dict[str, Any], act: Callable[[], Act]) -> None:
    steps = assert_same_motion(one_lane(adoption=0.5, **features), speeds(), act)
    assert sum(map(len, steps)) > 3000


def test_sumo_and_twin_drive_alike_with_a_speed_before_and_one_behind_the_line() -> None:
    config = speeds(horizon_s=150.0, action_parts=("speed_before", "speed_behind"))
    steps = assert_same_motion(one_lane(adoption=0.5), config, lambda: two_parts)
    free = [speed for step in steps for number, (x, speed) in step.items() if number % 2 and x < -30.0]
    assert max(free) > 0.9 * LIMIT_MPS


def gentle_stops(state: TensorDictBase) -> TensorDictBase:
    """At the limit, but with half of 1.5 m/s^2 where a stop is certain."""
    return set_action(state, torch.tensor([1.0, 0.5]).expand(*state["agents", "mask"].shape, 2).clone())


def test_sumo_and_twin_stop_gently_alike() -> None:
    """Vehicles brake from far before a red light that they cannot avoid; their own driver brakes later and harder."""
    config, context = speeds(action_parts=("speed_before", "stop")), one_lane(inflow_vph_per_lane=200.0, adoption=1.0)

    again: list[float] = []

    def gentlest_stop_mps2(steps: list[dict[int, Any]]) -> float:
        """Mean braking from 14 to 6 m/s before the line of the vehicle that needs the longest way for it."""
        braking = []
        for number in set().union(*steps):
            way = [step[number] for step in steps if number in step and step[number][0] < 0.0]
            fast = [x for x, speed in way if speed > 14.0]
            slow = [x for x, speed in way if speed < 6.0 and fast and x > fast[-1]]
            if slow:
                braking.append((14.0**2 - 6.0**2) / 2.0 / (slow[0] - fast[-1]))
                again.append(max(b[1] - a[1] for a, b in itertools.pairwise(way) if fast[-1] <= a[0] < slow[0]))
        return min(braking)

    gentle = assert_same_motion(context, config, lambda: gentle_stops)
    free = motion(episode("twin", context, config, constant(1.0, parts=2)))
    gentlest = gentlest_stop_mps2(gentle)
    assert max(again) < 0.1, "no stop is let go on the way"
    assert 0.7 < gentlest < 0.8 * gentlest_stop_mps2(free)


def test_sumo_and_twin_glide_alike() -> None:
    """Vehicles that may glide pass the line without standing, and never slower than they are allowed to."""
    config, context = speeds(action_parts=("glide",)), one_lane(inflow_vph_per_lane=200.0, adoption=1.0)

    def slowest_before_line_mps(steps: list[dict[int, Any]]) -> list[float]:
        passed = [number for number in set().union(*steps) if any(step.get(number, (-1.0,))[0] > 0.0 for step in steps)]
        return sorted(min(step[n][1] for step in steps if n in step and -400.0 < step[n][0] < 0.0) for n in passed)

    gliding = slowest_before_line_mps(assert_same_motion(context, config, lambda: constant(0.3)))
    free = slowest_before_line_mps(motion(episode("twin", context, config, constant(1.0))))
    standing = [sum(speed < 1.0 for speed in speeds_mps) for speeds_mps in (gliding, free)]
    assert standing[0] < 0.6 * standing[1]
    held = [speed for speed in gliding if speed < 0.95 * LIMIT_MPS and speed > 1.0]
    assert held and sum(speed > 0.29 * LIMIT_MPS for speed in held) > 0.8 * len(held)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_vehicles_slow_down_to_their_share_gently(simulator: str) -> None:
    frames = episode(simulator, one_lane(inflow_vph_per_lane=150.0, adoption=1.0), speeds(), constant(0.6))
    vehicles = frames["next", "vehicles"]
    cvs = vehicles["present"] & vehicles["is_cv"]
    speed, accel = vehicles["speed_mps"][cvs], vehicles["accel_mps2"][cvs]
    slowing = speed > 0.6 * LIMIT_MPS + 1e-4
    assert slowing.float().mean() < 0.2
    assert (accel[slowing] < -0.1).any()
    assert accel[slowing].min() > -1.51
    assert speed[~slowing].max() == pytest.approx(0.6 * LIMIT_MPS, abs=1e-3)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_nan_and_defer_are_uncommanded(simulator: str) -> None:
    def deferred(state: TensorDictBase) -> TensorDictBase:
        return constant(0.4)(state).set(("agents", "defer"), state["agents", "mask"].clone())

    config, context = speeds(horizon_s=120.0), one_lane(adoption=0.5)
    parts = [episode(simulator, context, config, act) for act in (constant(1.0), constant(torch.nan), deferred)]
    assert motion(parts[0]) == motion(parts[1]) == motion(parts[2])
    sums = [frames[-1]["next", "metrics", "approach"] for frames in parts]
    assert [s["nan_actions"].sum().item() > 0 for s in sums] == [False, True, False]
    assert all(s["deferred_steps"].sum() == s["agent_steps"].sum() > 0 for s in sums)


def test_the_scripted_cap_equals_a_constant_share() -> None:
    config = speeds(horizon_s=120.0)
    driver = make_driver("cap_0.6", config)
    with torch.no_grad():
        ours = episode("twin", one_lane(adoption=0.5), config, driver)
    assert motion(ours) == motion(episode("twin", one_lane(adoption=0.5), config, constant(0.6)))
    with pytest.raises(IzooError, match="add speed_before"):
        make_driver("cap_0.6", speeds(action_parts=("glide",)))
    free = make_driver("uncommanded", config)(TensorDict({"agents": TensorDict({"mask": torch.ones(3, dtype=bool)})}))
    assert free["agents", "action"].tolist() == [[1.0]] * 3


@pytest.mark.parametrize("name", ["constant", "constant_2.0", "glide"])
def test_drivers_that_command_accelerations_are_refused(name: str) -> None:
    with pytest.raises(IzooError, match=r"env\.action=acceleration"):
        make_driver(name, speeds())


def test_wrong_options_and_actions_are_refused() -> None:
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("one on either side", {"action": "speed", "action_parts": ("speed", "speed_behind")}),
        ("in this order", {"action": "speed", "action_parts": ("glide", "stop")}),
        ("one speed all the way", {"action": "speed", "action_parts": ()}),
        (r"env\.action=speed", {"action_parts": ("speed_before", "speed_behind")}),
        ("lane_change", {"action": "speed", "lane_change": True}),
        (r"env\.action", {"action": "velocity"}),
    ]
    for message, options in wrong:
        with pytest.raises(IzooError, match=message):
            EnvConfig(**options)
    with (
        contextlib.closing(EcoDrivingEnv(config=speeds(), worker=0, simulator="twin")) as env,
        pytest.raises(IzooError, match="shares of the speed limit"),
    ):
        env.step(constant(0.5, parts=2)(env.reset(context=one_lane(adoption=0.5), seed=1)))


def test_shares_below_the_minimum_are_raised_to_it() -> None:
    config = speeds(horizon_s=80.0)
    low, lower = (motion(episode("twin", one_lane(adoption=0.5), config, constant(s))) for s in (0.1, 0.01))
    for ours, theirs in zip(low, lower, strict=True):
        assert ours.keys() == theirs.keys()
        assert all(ours[number] == pytest.approx(place, abs=1e-3) for number, place in theirs.items())


@pytest.mark.parametrize("decide", ["step", "vehicle"])
@pytest.mark.parametrize("share", [0.0, -0.2, 1.2])
def test_shares_out_of_range_are_refused_unless_deferred(share: float, decide: str) -> None:
    with contextlib.closing(EcoDrivingEnv(config=speeds(decide=decide), worker=0, simulator="twin")) as env:
        state = env.reset(context=one_lane(adoption=0.5), seed=1)
        while not state["agents", "mask"].any():
            state = env.step(constant(0.5)(state))["next"]
        with pytest.raises(IzooError, match=r"desired speeds of \[.*above 0 and up to 1"):
            env.step(constant(share)(state))
        wrong = constant(share)(state)
        wrong["agents", "defer"] = state["agents", "mask"]
        state = env.step(wrong)["next"].exclude(("agents", "reward"))
        others = constant(0.5)(state)
        others["agents", "action"][~state["agents", "mask"]] = share
        others["agents", "defer"] = torch.zeros_like(state["agents", "mask"])
        env.step(others)


@pytest.mark.slow
@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("decide", ["step", "vehicle"])
def test_with_a_speed_before_the_line_only_vehicles_behind_it_are_uncommanded(simulator: str, decide: str) -> None:
    both = speeds(horizon_s=120.0, decide=decide, action_parts=("speed_before", "speed_behind"))
    before = speeds(horizon_s=120.0, decide=decide, action_parts=("speed_before",))

    def one_behind(state: TensorDictBase) -> TensorDictBase:
        share = constant(0.5)(state)["agents", "action"]
        return set_action(state, torch.cat([share, torch.ones_like(share)], -1))

    expected, found = (
        motion(episode(simulator, one_lane(adoption=0.5), config, act))
        for config, act in ((both, one_behind), (before, constant(0.5)))
    )
    assert expected == found and any(expected)
