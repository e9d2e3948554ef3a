"""Episodes that are played out after their horizon, and their measure: CO2 and delay of the cohort."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.emissions.moves import MovesSurrogate
from izoo.envs import SIMULATORS, EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.envs.mdp.blocked_demand import earliest_arrivals
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.envs.views.gymnasium import EcoDrivingJoint
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic
from tests.envs.conftest import Make, MakeTwin
from tests.envs.outcomes import driving, glide, lane, outcome, shifting, standing, stopping, uncommanded
from tests.envs.reference import run_fcd
from tests.envs.worlds import Driver, constant, cramped, crossing, defer, same

SEED = 3
CONFIG = EnvConfig(horizon_s=200.0, warmup_s=30.0, drain_s=600.0, emit=("metrics",))
COHORT = tuple(name for name in APPROACH_METRICS if name.startswith("cohort"))
TO_HORIZON = tuple(name for name in APPROACH_METRICS if "cohort" not in name)
Sums = dict[str, np.ndarray]
hurry = constant(1.0)


def play_out(
    context: Context, act: Driver = defer, config: EnvConfig = CONFIG, simulator: str = "sumo", seed: int = SEED
) -> TensorDictBase:
    """Return the last frame of an episode."""
    with contextlib.closing(EcoDrivingEnv(context, config=config, simulator=simulator)) as env:
        state = env.reset(context=context, seed=seed)
        while not state["done"].item():
            state = env.step_lean(act(state))
    return state


def sums_of(frame: TensorDictBase) -> Sums:
    """Return the per-approach sums of a frame, ``[P]`` each."""
    return {name: frame["metrics", "approach", name].numpy().astype(float) for name in APPROACH_METRICS}


def steps_of(frame: TensorDictBase) -> int:
    return int(frame["metrics", "episode", "steps"].item())


def co2_g(sums: Sums) -> float:
    """The measure of an episode, g per vehicle of the cohort."""
    return float((sums["cohort_region_co2_g"] + sums["cohort_blocked_co2_g"]).sum() / sums["cohort"].sum())


NETS = {
    "one lane": lane(),
    "one lane, saturated": lane(inflow_vph_per_lane=900.0, lane_length_m=120.0),
    "two lanes, electric": crossing(engine="electric"),
    "three lanes, uphill": crossing(lane_count=3, grade=0.04, lane_length_m=150.0),
    "measured, busy": 0,
    "measured": -21,
}


SLOW = ("three lanes, uphill", "measured, busy")


@pytest.fixture(params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in NETS])
def context(request: pytest.FixtureRequest) -> Context:
    chosen = NETS[request.param]
    if isinstance(chosen, Context):
        return chosen
    return request.getfixturevalue("busy")[chosen].replace(adoption=0.5)


class Way(NamedTuple):
    """What floating car data say of a vehicle in the region."""

    time_s: list[float]
    lane: list[int]
    speed_mps: list[float]
    accel_mps2: list[float]
    grade_pct: list[float]


def ways_through_the_region(context: Context, folder: Path, until_s: float) -> dict[int, Way]:
    """Read each vehicle's way in the ``sumo`` program's own output, up to ``until_s``."""
    lane_ids = read_road(build_net(context.intersection)).lane_ids
    lanes = {name: number for number, name in enumerate(lane_ids)}
    ways: dict[int, Way] = {}
    before: dict[str, float] = {}
    for step in run_fcd(context, SEED, folder, CONFIG):
        time_s = float(step.get("time")) + CONFIG.step_s
        if time_s > until_s + 1e-6:
            break
        for vehicle in step:
            number, speed = vehicle.get("id"), float(vehicle.get("speed"))
            accel = (speed - before.get(number, speed)) / CONFIG.step_s
            before[number] = speed
            if vehicle.get("lane") in lanes:
                way = ways.setdefault(int(number), Way([], [], [], [], []))
                slope = 100.0 * float(np.tan(np.radians(float(vehicle.get("slope")))))
                found = (time_s, lanes[vehicle.get("lane")], speed, accel, slope)
                for column, value in zip(way, found, strict=True):
                    column.append(value)  # type: ignore[arg-type]
    return ways


def test_sums_equal_those_of_sumos_own_output(context: Context, tmp_path: Path) -> None:
    """For every vehicle of the cohort: CO2 and delay in the region, time blocked outside, and its CO2."""
    frame = play_out(context)
    sums, steps = sums_of(frame), steps_of(frame)
    road = read_road(build_net(context.intersection))
    traffic = sample_traffic(context, road, SEED, CONFIG.horizon_s)
    end_s = CONFIG.warmup_s + steps * CONFIG.step_s
    ways, earliest_s = ways_through_the_region(context, tmp_path, end_s), earliest_arrivals(road, traffic)
    surrogate, weather = MovesSurrogate(), (context.temperature_c, context.humidity_pct)
    expected = {name: np.zeros(CONFIG.num_approaches) for name in COHORT}

    def rate(number: int, speed: Any, accel: Any, grade: Any) -> np.ndarray:
        """CO2 rate in g/s."""
        if traffic.is_cv[number] and context.engine == "electric":
            return np.zeros(len(speed))
        motion = (torch.tensor(column, dtype=torch.float32) for column in (speed, accel, grade))
        same = torch.ones(len(speed))
        found = surrogate(*motion, same.long() * int(traffic.moves_class[number]), *(same * value for value in weather))
        return found.numpy().astype(float)

    for number in np.flatnonzero(traffic.depart_s.round(3) >= CONFIG.warmup_s).tolist():
        p, way = int(traffic.approach[number]), ways.get(number)
        came_s = end_s if way is None else way.time_s[0] - CONFIG.step_s
        blocked_s = max(came_s - earliest_s[number], 0.0)
        idle_gps = float(rate(number, [0.0], [0.0], [100.0 * road.grade[p]])[0])
        found = {"cohort": 1.0, "cohort_blocked_s": blocked_s, "cohort_blocked_co2_g": idle_gps * blocked_s}
        if way is not None:
            limit = road.lane_limit_mps[way.lane]
            found["cohort_left"] = float(way.time_s[-1] < end_s - 1e-6)
            found["cohort_region_co2_g"] = CONFIG.step_s * rate(number, *way[2:]).sum()
            found["cohort_region_delay_s"] = CONFIG.step_s * np.maximum(1.0 - way.speed_mps / limit, 0.0).sum()
        for name, value in found.items():
            expected[name][p] += value
    assert expected["cohort"].sum() > 5
    for name, values in expected.items():
        rtol = 5e-4 if name.endswith("co2_g") else 2e-4  # the output rounds slopes to 0.01 degrees
        np.testing.assert_allclose(sums[name], values, rtol=rtol, atol=1e-2, err_msg=name)


def test_gaming_the_papers_measure_worsens_the_own_measure_and_the_reward() -> None:
    """Keeping vehicles out, blocking the road, and shifting CO2 from before the stop line to behind it.

    The first and the last save CO2 in the paper's form.
    """
    reward = RewardConfig.fuel_team()
    config = dataclasses.replace(CONFIG, horizon_s=625.0, reward=reward, emit=("metrics", "team_reward"))

    def contexts(adoption: float) -> list[Context]:
        return [
            lane(adoption=adoption, inflow_vph_per_lane=200.0, lane_length_m=length, green_s=green, red_s=red)
            for length in (150.0, 350.0)
            for green, red in ((30.0, 30.0), (40.0, 25.0))
        ]

    some, everyone = contexts(1 / 3), contexts(1.0)
    keeping_out, free_of_some = (outcome(some, act, config) for act in (driving(standing, 100.0), uncommanded))
    free = outcome(everyone, uncommanded, config)
    blocking, shifting_ = (outcome(everyone, driving(rule, -1e9), config) for rule in (stopping, shifting))
    assert free.sums["cohort_left"].sum() == free.sums["cohort"].sum()
    assert keeping_out.to_line_g < 0.8 * free_of_some.to_line_g and shifting_.to_line_g < 0.99 * free.to_line_g
    assert (keeping_out.co2_g > 1.5 * free_of_some.co2_g).all()
    assert (blocking.co2_g > 1.05 * free.co2_g).all() and blocking.co2_g.mean() > 1.2 * free.co2_g.mean()
    assert (shifting_.co2_g > 1.02 * free.co2_g).all() and shifting_.co2_g.mean() > 1.05 * free.co2_g.mean()
    for policy, baseline in ((keeping_out, free_of_some), (blocking, free), (shifting_, free)):
        assert (policy.sums["cohort"] == baseline.sums["cohort"]).all()
        assert policy.cost.mean() > baseline.cost.mean() and policy.team.sum() < baseline.team.sum()


@pytest.mark.parametrize("hold_s", [None, 2.0])
@pytest.mark.parametrize("changes", [{}, {"engine": "electric"}])
def test_team_rewards_add_up_to_the_measure(changes: dict[str, Any], hold_s: float | None) -> None:
    """Without a warm-up every vehicle belongs to the cohort."""
    reward = RewardConfig.fuel_team()
    config = dataclasses.replace(CONFIG, warmup_s=0.0, hold_s=hold_s, reward=reward, emit=("metrics", "team_reward"))
    busy = crossing(lane_count=1, inflow_vph_per_lane=800.0, **changes)
    with contextlib.closing(EcoDrivingEnv(busy, config=config)) as env:
        state, team = env.reset(context=busy, seed=SEED), 0.0
        unit_g = float(env.backend.simulation().episode._world.rules["fleet_g_per_step"])  # type: ignore[attr-defined]
        while not state["done"].item():
            state = env.step_lean(hurry(state))
            team += float(state["team_reward"])
    sums = sums_of(state)
    assert sums["cohort_blocked_s"].sum() > 500.0 and sums["cohort_left"].sum() == sums["cohort"].sum()
    grams = sums["cohort_region_co2_g"] + sums["cohort_blocked_co2_g"]
    seconds = sums["cohort_region_delay_s"] + sums["cohort_blocked_s"]
    assert -team * unit_g == pytest.approx((grams + 0.5 * seconds).sum(), rel=1e-5)


def test_the_cohort_is_the_same_under_every_policy() -> None:
    """For human driving, too, and on both simulators."""
    busy = crossing(lane_count=1, inflow_vph_per_lane=700.0, adoption=0.5)
    smoothly, blocking = glide(), driving(standing)
    drivers: tuple[Driver, ...] = (defer, hurry, lambda s: smoothly(s, 0.0), lambda s: blocking(s, 0.0))
    cohorts = [sums_of(play_out(busy, act, simulator="twin"))["cohort"] for act in drivers]
    cohorts.append(sums_of(play_out(busy.replace(adoption=0.0)))["cohort"])
    road = read_road(build_net(busy.intersection))
    traffic = sample_traffic(busy, road, SEED, CONFIG.horizon_s)
    expected = np.bincount(traffic.approach[traffic.depart_s >= CONFIG.warmup_s], minlength=CONFIG.num_approaches)
    for cohort in cohorts:
        assert cohort.tolist() == expected.tolist() and cohort.sum() > 50


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_sums_to_the_horizon_are_those_of_an_episode_that_ends_there(simulator: str) -> None:
    """Bit for bit, with decisions that do not divide the time; and so are vehicles and observations."""
    config = dataclasses.replace(CONFIG, hold_s=1.5, emit=("metrics", "vehicles"))
    ends = dataclasses.replace(config, drain_s=0.0)
    assert config.decisions * 3 != config.control_steps
    finals = []
    for settings in (config, ends):
        with contextlib.closing(EcoDrivingEnv(crossing(), config=settings, simulator=simulator)) as env:
            state = env.reset(context=crossing(), seed=SEED)
            for _ in range(config.decisions):
                state = env.step_lean(hurry(state))
            at_horizon = state.clone()
            while not state["done"].item():
                state = env.step_lean(hurry(state))
            finals.append((at_horizon, sums_of(state), steps_of(state)))
    (drained, sums, steps), (ended, theirs, last) = finals
    assert last == config.control_steps < steps < config.total_steps
    assert (steps - last) % 3 == 0, "the grid of decisions begins anew at the horizon"
    for name in TO_HORIZON:
        assert sums[name].tolist() == theirs[name].tolist(), name
    assert sums["cohort_left"].sum() == sums["cohort"].sum() > theirs["cohort_left"].sum() and sums["unfinished"].any()
    assert same(drained["vehicles"], ended["vehicles"])
    assert torch.equal(drained["agents", "observation"], ended["agents", "observation"])
    assert drained["agents", "mask"].any() and not drained["agents", "done"].any()
    assert ended["agents", "truncated"].any()


def test_both_simulators_end_in_the_same_step_with_the_same_sums() -> None:
    """On a scenario where the twin is exact, also with decisions longer than a step."""
    for act in (defer, hurry):
        for hold_s in (None, 2.5):
            config = dataclasses.replace(CONFIG, hold_s=hold_s)
            one, other = (play_out(lane(adoption=0.5), act, config, simulator) for simulator in SIMULATORS)
            assert steps_of(one) == steps_of(other) > config.control_steps
            for name in APPROACH_METRICS:
                np.testing.assert_allclose(sums_of(one)[name], sums_of(other)[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_short_drain_truncates_vehicles_and_counts_their_co2_so_far(simulator: str) -> None:
    config = dataclasses.replace(CONFIG, drain_s=1.0)
    frame = play_out(crossing(), config=config, simulator=simulator)
    sums, whole = sums_of(frame), sums_of(play_out(crossing(), simulator=simulator))
    assert steps_of(frame) == config.total_steps == config.control_steps + 2
    assert frame["agents", "truncated"].squeeze(-1).equal(frame["agents", "mask"]) and frame["agents", "mask"].any()
    assert sums["cohort"].tolist() == whole["cohort"].tolist()
    assert 0 < sums["cohort_left"].sum() < whole["cohort_left"].sum() == whole["cohort"].sum()
    assert 0.0 < co2_g(sums) < co2_g(whole)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_without_demand_the_episode_ends_at_the_horizon(simulator: str) -> None:
    frame = play_out(crossing(inflow_vph_per_lane=0.0, approach="A"), simulator=simulator)
    assert steps_of(frame) == CONFIG.control_steps
    assert not any(values.any() for values in sums_of(frame).values())


def test_dropped_vehicles_belong_to_the_cohort() -> None:
    """They never leave, count to the end, and do not delay it."""
    frame = play_out(cramped(), config=dataclasses.replace(CONFIG, warmup_s=0.0))
    sums = sums_of(frame)
    assert sums["dropped"].sum() > 5 and steps_of(frame) < CONFIG.total_steps
    assert (sums["cohort"] - sums["cohort_left"] >= sums["dropped"]).all()
    assert sums["cohort_blocked_s"].sum() > 100.0 * sums["dropped"].sum()


def contexts_of_several_lengths(number: int) -> tuple[Context, int]:
    return lane(inflow_vph_per_lane=(60.0, 250.0, 400.0)[number % 3], adoption=0.5), number


@pytest.mark.parametrize(("simulator", "count"), [("sumo", 2), ("twin", 3)])
def test_each_environment_ends_by_itself_and_rests_until_all_have_ended(make: Make, simulator: str, count: int) -> None:
    config = dataclasses.replace(CONFIG, hold_s=1.5, emit=("metrics", "team_reward"))
    env = make(simulator, count, contexts_of_several_lengths, config=config)
    state, decisions = env.reset(), 0
    ends: dict[int, tuple[int, TensorDictBase]] = {}
    while not state["done"].all():
        state, decisions = env.step_lean(hurry(state)), decisions + 1
        for k in range(count):
            if k in ends:
                assert state["done"][k] and not state["agents", "mask"][k].any() and not state["team_reward"][k].any()
                assert not state["agents", "reward"][k].any() and not state["agents", "done"][k].any()
                assert same(state["metrics"][k], ends[k][1]["metrics"])
            elif state["done"][k]:
                ends[k] = decisions, state[k].clone()
    assert len({end for end, _ in ends.values()}) == count and min(end for end, _ in ends.values()) >= config.decisions
    with pytest.raises(IzooError, match=r"ended after \d+ steps; call reset"):
        env.step_lean(hurry(state))
    for k, (_, last) in ends.items():
        context, seed = contexts_of_several_lengths(k)
        alone, found = (part["metrics"] for part in (play_out(context, hurry, config, simulator, seed), last))
        assert all(torch.allclose(alone[key], found[key], rtol=1e-5) for key in alone.keys(True, True))


def test_new_episodes_begin_where_one_has_ended(make_twin: MakeTwin) -> None:
    """As in TorchRL's loops."""
    env = make_twin(3, contexts_of_several_lengths, config=CONFIG)
    state, ends = env.reset(), 0
    for _ in range(700):
        frame, state = env.step_and_maybe_reset(hurry(state))
        assert not state["done"].any()
        for k in torch.nonzero(frame["next", "done"].flatten()).flatten().tolist():
            ends += 1
            assert steps_of(frame["next"][k]) >= CONFIG.control_steps and steps_of(state[k]) == 0
    assert ends >= 3


def test_states_are_exact_on_both_sides_of_the_horizon(make_twin: MakeTwin) -> None:
    """Saved before it, after it, and while one environment rests; also in branches."""
    config = dataclasses.replace(CONFIG, hold_s=1.5, reward=RewardConfig.fuel(), emit=("metrics", "team_reward"))
    env, other = (make_twin(3, contexts_of_several_lengths, config=config) for _ in range(2))
    state, wanted = env.reset(), [config.decisions - 2, config.decisions + 1]
    saved, rested = {}, False
    for decision in range(1, 1000):
        state = env.step_lean(hurry(state))
        if decision in wanted or (state["done"].any() and not rested):
            saved[decision] = env.state_dict()
            rested |= bool(state["done"].any())
        if state["done"].all():
            break
    assert len(saved) == 3 and rested
    for loaded in saved.values():
        other.load_state_dict(loaded)
        branches = other.branch(2)
        for going_on in (other, branches):
            seen = going_on.present()
            while not seen["done"].all():
                seen = going_on.step_lean(hurry(seen))
            copies = going_on.num_envs // 3
            for k in range(going_on.num_envs):
                assert same(seen["metrics"][k], state["metrics"][k // copies])
        branches.close()


def test_views_go_on_to_the_end() -> None:
    config = dataclasses.replace(CONFIG, hold_s=1.5, emit=())
    with contextlib.closing(EcoDrivingJoint(lane(adoption=0.5), config, simulator="twin")) as view:
        view.reset(options={"context": lane(adoption=0.5), "episode_seed": SEED})
        over, info = False, {}
        while not over:
            _, _, _, over, info = view.step(np.full(config.num_agents, np.nan, np.float32))
    frame = play_out(lane(adoption=0.5), config=dataclasses.replace(config, emit=("metrics",)), simulator="twin")
    assert info["time_s"] == CONFIG.warmup_s + steps_of(frame) * CONFIG.step_s > CONFIG.horizon_s
    for name in COHORT:
        np.testing.assert_allclose(info["metrics"]["approach"][name], sums_of(frame)[name], err_msg=name)
