"""The metrics of an episode: sums that agree with each other and with the vehicles."""

import contextlib
import functools
import itertools
from collections import defaultdict

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.mdp.metric_sums import MOVEMENTS, OF_COHORT, STOPPED_MPS
from izoo.networks.road import APPROACHING
from tests.envs.worlds import Driver, at_random, constant, crossing, defer, digest, play, set_action, short, steer

CONFIG = short(horizon_s=150.0, warmup_s=25.0)
SEED = 4


@functools.cache
def run(context: Context, act: Driver = steer, config: EnvConfig = CONFIG) -> TensorDict:
    with contextlib.closing(EcoDrivingEnv(context, config=config)) as env:
        return play(env, config.control_steps, act, env.reset(context=context, seed=SEED))


@pytest.fixture(scope="module", params=["commanded", "uncommanded", "measured"])
def frames(request: pytest.FixtureRequest) -> TensorDict:
    if request.param == "measured":
        return run(request.getfixturevalue("busy")[10].replace(approach=None, adoption=0.5), defer)
    return run(crossing(), defer if request.param == "uncommanded" else steer)


def final(frames: TensorDict) -> TensorDictBase:
    return frames[-1]["next", "metrics", "approach"]


def counted_vehicles(frames: TensorDict) -> list[list[dict[str, float]]]:
    """What ``("vehicles", ...)`` says of each counted vehicle of an episode, step by step."""
    first, vehicles = frames[0]["vehicles"], frames["next", "vehicles"]
    names = ("location", "approach", "is_cv", "emission_g", "speed_mps", "accel_mps2")
    columns = {name: vehicles[name].tolist() for name in (*names, "vehicle_number")}
    found: dict[int, list[dict[str, float]]] = defaultdict(list)
    for t, row in vehicles["present"].nonzero().tolist():
        found[columns["vehicle_number"][t][row]].append({name: columns[name][t][row] for name in names})
    uncounted = set(first["vehicle_number"][first["present"]].tolist())
    return [steps for number, steps in found.items() if number not in uncounted]


def test_sums_agree_with_the_vehicles(frames: TensorDict) -> None:
    """Recompute every sum from the vehicles of every step."""
    expected: dict[str, np.ndarray] = {}

    def add(name: str, approach: float, value: float) -> None:
        expected.setdefault(name, np.zeros(6))[int(approach)] += value

    for steps in counted_vehicles(frames):
        approach = steps[0]["approach"]
        add("entered", approach, 1)
        add("region_emission_g", approach, sum(step["emission_g"] for step in steps))
        add("region_time_s", approach, 0.5 * len(steps))
        crossed = next((k for k, step in enumerate(steps) if step["location"] != APPROACHING), None)
        part = steps if crossed is None else steps[: crossed + 1]
        emission = sum(step["emission_g"] for step in part)
        if crossed is None:
            add("unfinished", approach, 1)
            add("unfinished_emission_g", approach, emission)
            continue
        add("crossed", approach, 1)
        add("emission_g", approach, emission)
        if not steps[0]["is_cv"]:
            add("crossed_hdv", approach, 1)
            add("emission_hdv_g", approach, emission)
        add("vehicle_steps", approach, len(part))
        add("travel_time_s", approach, 0.5 * len(part))
        add("stopped_time_s", approach, 0.5 * sum(step["speed_mps"] < 1.0 for step in part))
        add("abs_accel_sum", approach, sum(abs(step["accel_mps2"]) for step in part))
        accel = [step["accel_mps2"] for step in part]
        # A new vehicle has no acceleration before its first step.
        add("abs_jerk_sum", approach, sum(abs(b - a) / 0.5 for a, b in itertools.pairwise(accel)))
    sums = final(frames)
    for name, values in expected.items():
        np.testing.assert_allclose(sums[name].numpy(), values, rtol=2e-4, atol=2e-3, err_msg=name)


def test_distance_is_the_approach(frames: TensorDict) -> None:
    """A vehicle that crossed has driven its approach and at most one step's distance of the junction."""
    sums = final(frames)
    crossed = sums["crossed"] > 0
    mean = sums["distance_m"][crossed] / sums["crossed"][crossed]
    for p, distance in zip(crossed.nonzero().flatten().tolist(), mean.tolist(), strict=True):
        mine = frames["vehicles", "approach"] == p
        begin = -frames["vehicles", "path_position_m"][mine & frames["vehicles", "present"]].min().item()
        assert begin - 10.0 < distance < begin + 25.0


def test_numbers_are_finite_and_in_range(frames: TensorDict) -> None:
    sums = final(frames)
    assert sums["entered"].sum() > 10 and sums["crossed"].sum() > 0 and sums["unfinished"].sum() > 0
    assert torch.equal(sums["entered"], sums["crossed"] + sums["unfinished"])
    assert_finite(frames)
    assert (sums["min_ttc_vehicles"] <= sums["crossed"]).all() and sums["min_ttc_vehicles"].sum() > 0
    assert (sums["min_ttc_sum_s"] > 0).eq(sums["min_ttc_vehicles"] > 0).all()
    assert (sums["stopped_time_s"] <= sums["travel_time_s"]).all()
    assert (sums["region_emission_g"] >= sums["emission_g"]).all()
    assert not sums["red_crossings_cv"].any()


def test_episode_counts(frames: TensorDict) -> None:
    last, mask = frames[-1]["next", "metrics", "episode"], frames["agents", "mask"]
    assert last["steps"].item() == CONFIG.control_steps
    assert last["agent_steps"].item() == mask.sum() == final(frames)["agent_steps"].sum()
    assert last["vehicle_steps"].item() == frames["next", "vehicles", "present"].sum()
    assert last["gridlock"].item() == 0.0


def test_sums_only_grow(frames: TensorDict) -> None:
    sums = dict(frames["next", "metrics", "approach"].items())
    mask = sums.pop("mask")
    assert (mask == mask[0]).all() and 2 <= mask[0].sum() <= 6
    for name, value in sums.items():
        assert not value[-1][~mask[0]].any(), name
        assert name.endswith("_queue") or (value.diff(dim=0) >= 0).all(), name  # a queue is the present one


@pytest.mark.parametrize("simulator", ["twin", "sumo"])
def test_sums_by_movement_add_up_and_queues_are_the_stopped_vehicles(simulator: str) -> None:
    config = EnvConfig(horizon_s=140.0, warmup_s=20.0, drain_s=300.0, num_vehicles=128, emit=("metrics", "vehicles"))
    queue = longest = torch.zeros(config.num_approaches, len(MOVEMENTS))
    with contextlib.closing(EcoDrivingEnv(crossing(), config=config, simulator=simulator)) as env:
        state = env.reset(seed=5)
        while not state["done"].item():
            state = env.step_lean(defer(state))
            if state["metrics", "episode", "steps"].item() > config.control_steps:
                continue
            vehicles = state["vehicles"]
            stopped = vehicles["present"] & (vehicles["location"] == APPROACHING)
            stopped &= vehicles["speed_mps"] < STOPPED_MPS
            where = (vehicles["approach"][stopped].long(), vehicles["movement"][stopped].long())
            queue = torch.zeros_like(queue).index_put_(where, torch.ones(int(stopped.sum())), accumulate=True)
            longest = torch.maximum(longest, queue)
        sums = state["metrics", "approach"]
    for name in OF_COHORT:
        parts = torch.stack([sums[f"{movement}_{name}"] for movement in MOVEMENTS])
        assert (parts > 0).sum() > 4, name
        torch.testing.assert_close(parts.sum(0), sums[name], rtol=1e-5, atol=1e-3)
    for name, expected in (("queue", queue), ("queue_max", longest)):
        torch.testing.assert_close(torch.stack([sums[f"{movement}_{name}"] for movement in MOVEMENTS], -1), expected)
    assert longest.max() >= 2 and queue.sum() > 0


def test_waiting_vehicles_are_spill_back() -> None:
    """More demand than the road takes: some wait outside at the end, on the approaches that are full."""
    full = crossing(lane_count=1, inflow_vph_per_lane=900.0, green_s=20.0, red_s=32.0, lane_length_m=100.0)
    for context, waiting in ((full, True), (crossing(inflow_vph_per_lane=100.0), False)):
        sums = final(run(context, defer, short(horizon_s=300.0, emit=("metrics",))))
        assert (sums["waiting"].sum() > 0) == waiting


def test_without_cvs_and_with_demand_from_one_approach() -> None:
    frames = run(crossing(adoption=0.0, approach="C"))
    assert not frames["agents", "mask"].any() and not frames["next", "agents", "reward"].any()
    sums = final(frames)
    assert sums["entered"].nonzero().flatten().tolist() == [2]
    assert sums["crossed"].sum() > 0 and torch.equal(sums["crossed"], sums["crossed_hdv"])
    assert torch.equal(sums["emission_g"], sums["emission_hdv_g"])
    assert frames[-1]["next", "truncated"].all()


def test_without_any_vehicle() -> None:
    reward = RewardConfig(eta=0.5, safety=2.0)
    config = short(horizon_s=150.0, warmup_s=25.0, reward=reward, emit=EMIT_GROUPS)
    frames = run(crossing(inflow_vph_per_lane=0.0, approach="A"), config=config)
    assert not frames["next", "vehicles", "present"].any() and not frames["next", "agents", "reward"].any()
    assert not frames["next", "agents", "reward_vector"].any() and not frames["next", "team_reward"].any()
    for name, value in final(frames).items():
        assert name == "mask" or not value.any(), name
    assert frames[-1]["next", "truncated"].all() and len(frames) == CONFIG.control_steps


def assert_finite(frames: TensorDict) -> None:
    for name, value in frames.exclude(("agents", "action")).items(True, True):
        assert torch.isfinite(value.float()).all(), name


def test_nan_actions_are_counted_and_deferred() -> None:
    nan, asked = run(crossing(), constant(torch.nan)), run(crossing(), defer)
    assert torch.equal(nan["next", "vehicles", "speed_mps"], asked["next", "vehicles", "speed_mps"])
    steps = nan["agents", "mask"].sum()
    assert final(nan)["nan_actions"].sum() == final(nan)["deferred_steps"].sum() == steps > 0
    assert final(asked)["nan_actions"].sum() == 0 and final(asked)["deferred_steps"].sum() == steps
    assert_finite(nan)


def test_deferred_flag_marks_uncommanded_cvs() -> None:
    def half_deferred(state: TensorDictBase) -> TensorDictBase:
        return steer(state).set(("agents", "defer"), torch.arange(64) % 2 == 0)

    frames = run(crossing(), half_deferred)
    after = frames["next", "vehicles"]
    count = (after["deferred"] & after["present"]).sum()
    left = final(frames)["deferred_steps"].sum() - count
    assert 0 <= left <= frames["next", "agents", "terminated"].sum(), "only vehicles that left may be missing"
    assert 0 < final(frames)["deferred_steps"].sum() < final(frames)["agent_steps"].sum()


def test_actions_of_empty_slots_do_not_matter() -> None:
    def noisy(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = steer(tensordict)
        empty = ~tensordict["agents", "mask"]
        junk = torch.where(torch.arange(64) % 2 == 0, torch.nan, 1e30)
        action = torch.where(empty, junk, tensordict["agents", "action"].squeeze(-1))
        tensordict["agents", "defer"] = empty & (torch.arange(64) % 3 == 0)
        return set_action(tensordict, action.unsqueeze(-1))

    assert digest(run(crossing(), noisy)) == digest(run(crossing(), steer))


def test_actions_beyond_the_bounds_are_clipped() -> None:
    for wild, bound in ((torch.inf, 2.6), (-torch.inf, -4.5)):
        assert digest(run(crossing(), constant(wild), short())) == digest(run(crossing(), constant(bound), short()))


def test_commands_are_applied() -> None:
    """In free flow the commanded acceleration is the realised one; a command never exceeds the speed limit."""
    value = 0.5
    frames = run(crossing(inflow_vph_per_lane=100.0, adoption=1.0), constant(value))
    mask = frames["agents", "mask"] & frames["next", "agents", "mask"]
    row = frames["agents", "vehicle"]
    speed = torch.gather(frames["vehicles", "speed_mps"], 1, row)
    realised = torch.gather(frames["next", "vehicles", "accel_mps2"], 1, row)
    v = {name: torch.gather(frames["vehicles", name], 1, row) for name in ("location", "has_leader", "leader_gap_m")}
    # Behind the junction, where neither the signal nor a leader matters.
    free = mask & (speed < 15.0) & (v["location"] == 2) & (~v["has_leader"] | (v["leader_gap_m"] > 40.0))
    assert free.sum() > 50
    close = (realised[free] - value).abs() < 1e-3
    assert close.float().mean() > 0.9
    # Where SUMO intervenes it is for safety: it brakes harder, never less.
    moving = mask & (speed > 1.0) & (v["location"] != 1)
    assert (realised[moving] <= value + 1e-3).all() and (realised[moving] < value - 0.1).any()
    # Inside the junction SUMO's own models drive it.
    deferred = torch.gather(frames["next", "vehicles", "deferred"], 1, row)
    inside = mask & (v["location"] == 1)
    assert deferred[inside].all() and not deferred[free].any()
    assert final(frames)["junction_deferred"].sum() == (frames["agents", "mask"] & (v["location"] == 1)).sum() > 0
    fast = run(crossing(adoption=1.0), constant(2.6))
    assert fast["next", "vehicles", "speed_mps"].max() <= 16.0 + 1e-4


@pytest.mark.parametrize("act", [steer, constant(torch.nan), at_random(1)])
def test_no_nan_leaves_an_environment(act: Driver) -> None:
    assert_finite(run(crossing(grade=0.1, adoption=1.0), act, short(emit=EMIT_GROUPS)))
