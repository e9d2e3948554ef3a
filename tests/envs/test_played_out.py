"""Episodes that are played out after their horizon, and what they measure: CO2 and delay of the cohort."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList
from izoo.emissions.moves import MovesSurrogate
from izoo.envs import SIMULATORS, EcoDrivingEnv, EnvConfig, RewardConfig, SumoParallelEnv
from izoo.envs.mdp.blocked_demand import reach_times
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic
from tests.envs.conftest import MakeTwin
from tests.envs.outcomes import driving, glide, lane, outcome, shifting, standing, stopping, uncommanded
from tests.envs.reference import run_fcd
from tests.envs.worlds import Driver, crossing, defer, same, set_action

SEED = 3
CONFIG = EnvConfig(horizon_s=200.0, warmup_s=30.0, drain_s=600.0, emit=("metrics",))
COHORT = tuple(name for name in APPROACH_METRICS if name.startswith("cohort"))
TO_HORIZON = tuple(name for name in APPROACH_METRICS if name not in COHORT)
Sums = dict[str, np.ndarray]


def hurry(state: TensorDictBase) -> TensorDictBase:
    """Let every CV accelerate where nothing keeps it from it."""
    return set_action(state, torch.full((*state["agents", "mask"].shape, 1), 1.0))


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
    """What the measure says of an episode: g per vehicle of the cohort."""
    return float((sums["cohort_region_co2_g"] + sums["cohort_blocked_co2_g"]).sum() / sums["cohort"].sum())


# -- the sums, vehicle by vehicle --------------------------------------------------------------------------------------

NETS = {
    "one lane": lane(),
    "one lane, saturated": lane(inflow_vph_per_lane=900.0, lane_length_m=120.0),
    "two lanes, electric": crossing(engine="electric"),
    "three lanes, uphill": crossing(lane_count=3, grade=0.04, lane_length_m=150.0),
    "measured, busy": -1,
    "measured": 20,
}


@pytest.fixture(params=list(NETS))
def context(request: pytest.FixtureRequest) -> Context:
    chosen = NETS[request.param]
    if isinstance(chosen, Context):
        return chosen
    dataset: ContextList = request.getfixturevalue("dataset")
    by_demand = sorted(dataset, key=lambda each: each.flow_vph_per_lane(each.approach or "A"))
    return by_demand[chosen].replace(adoption=0.5)


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


def test_sums_close_with_sumos_own_output(context: Context, tmp_path: Path) -> None:
    """Every vehicle of the cohort: its CO2 and delay in the region, and how long it was blocked, and at what cost."""
    frame = play_out(context)
    sums, steps = sums_of(frame), steps_of(frame)
    road = read_road(build_net(context.intersection))
    traffic = sample_traffic(context, road, SEED, CONFIG.horizon_s)
    end_s = CONFIG.warmup_s + steps * CONFIG.step_s
    ways, reach_s = ways_through_the_region(context, tmp_path, end_s), reach_times(road, traffic)
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
        blocked_s = max(came_s - reach_s[number], 0.0)
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
        np.testing.assert_allclose(sums[name], values, rtol=2e-4, atol=1e-2, err_msg=name)


# -- what cannot be gained by ------------------------------------------------------------------------------------------


def test_gaming_costs() -> None:
    """Keeping vehicles out, blocking the road, and driving so that what is saved up to the line is burned behind it.

    The first and the last of them look better than uncommanded CVs in the paper's form.
    """
    reward = RewardConfig.fuel_team()
    config = dataclasses.replace(CONFIG, horizon_s=625.0, reward=reward, emit=("metrics", "team_reward"))

    def contexts(adoption: float) -> list[Context]:
        return [
            lane(adoption=adoption, inflow_vph_per_lane=200.0, lane_length_m=length, green_s=green, red_s=red)
            for length in (150.0, 250.0, 350.0)
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


# -- rewards are what is measured --------------------------------------------------------------------------------------


@pytest.mark.parametrize("hold_s", [None, 2.0])
@pytest.mark.parametrize("changes", [{}, {"engine": "electric"}])
def test_the_teams_rewards_add_up_to_what_is_measured(changes: dict[str, Any], hold_s: float | None) -> None:
    """Without a warm-up every vehicle is of the cohort."""
    reward = RewardConfig.fuel_team()
    config = dataclasses.replace(CONFIG, warmup_s=0.0, hold_s=hold_s, reward=reward, emit=("metrics", "team_reward"))
    busy = crossing(lane_count=1, inflow_vph_per_lane=800.0, **changes)
    with contextlib.closing(EcoDrivingEnv(busy, config=config)) as env:
        state, team = env.reset(context=busy, seed=SEED), 0.0
        unit_g = env.backend.episode._rules.fleet_g_per_step  # type: ignore[attr-defined]
        while not state["done"].item():
            state = env.step_lean(hurry(state))
            team += float(state["team_reward"])
    sums = sums_of(state)
    assert sums["cohort_blocked_s"].sum() > 500.0 and sums["cohort_left"].sum() == sums["cohort"].sum()
    grams = sums["cohort_region_co2_g"] + sums["cohort_blocked_co2_g"]
    seconds = sums["cohort_region_delay_s"] + sums["cohort_blocked_s"]
    assert -team * unit_g == pytest.approx((grams + 0.5 * seconds).sum(), rel=1e-5)


# -- the cohort, the horizon and the end -------------------------------------------------------------------------------


def test_the_cohort_is_the_same_under_every_policy() -> None:
    """For human driving, too, and on both simulators."""
    busy = crossing(lane_count=1, inflow_vph_per_lane=700.0, adoption=0.5)
    drivers = {
        "uncommanded": defer,
        "hurrying": hurry,
        "glide": lambda state: glide()(state, 0.0),
        "blocking": lambda state: driving(standing)(state, 0.0),
    }
    cohorts = [sums_of(play_out(busy, act, simulator="twin"))["cohort"] for act in drivers.values()]
    cohorts.append(sums_of(play_out(busy.replace(adoption=0.0)))["cohort"])
    road = read_road(build_net(busy.intersection))
    traffic = sample_traffic(busy, road, SEED, CONFIG.horizon_s)
    expected = np.bincount(traffic.approach[traffic.depart_s >= CONFIG.warmup_s], minlength=CONFIG.num_approaches)
    for cohort in cohorts:
        assert cohort.tolist() == expected.tolist() and cohort.sum() > 50


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_what_is_counted_up_to_the_horizon_is_that_of_an_episode_that_ends_there(simulator: str) -> None:
    """Bit for bit, with decisions that do not divide the time; and so is all that is observed until then."""
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
    assert (
        sums["unfinished"].sum() > 0 and sums["cohort_left"].sum() == sums["cohort"].sum() > theirs["cohort_left"].sum()
    )
    assert same(drained["vehicles"], ended["vehicles"])
    assert torch.equal(drained["agents", "observation"], ended["agents", "observation"])
    assert (
        drained["agents", "mask"].any() and not drained["agents", "done"].any() and ended["agents", "truncated"].any()
    )


def test_both_simulators_play_out_alike() -> None:
    """Where the twin is exact: to the last step, also where a decision is longer than a step."""
    for act in (defer, hurry):
        for hold_s in (None, 2.5):
            config = dataclasses.replace(CONFIG, hold_s=hold_s)
            one, other = (play_out(lane(adoption=0.5), act, config, simulator) for simulator in SIMULATORS)
            assert steps_of(one) == steps_of(other) > config.control_steps
            for name in APPROACH_METRICS:
                np.testing.assert_allclose(sums_of(one)[name], sums_of(other)[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_drain_that_is_too_short_loses_nothing(simulator: str) -> None:
    """Vehicles that are there at its end are truncated, and have been charged until then."""
    config = dataclasses.replace(CONFIG, drain_s=1.0)
    frame = play_out(crossing(), config=config, simulator=simulator)
    sums, whole = sums_of(frame), sums_of(play_out(crossing(), simulator=simulator))
    assert steps_of(frame) == config.total_steps == config.control_steps + 2
    assert frame["agents", "truncated"].squeeze(-1).equal(frame["agents", "mask"]) and frame["agents", "mask"].any()
    assert sums["cohort"].tolist() == whole["cohort"].tolist()
    assert 0 < sums["cohort_left"].sum() < whole["cohort_left"].sum() == whole["cohort"].sum()
    assert 0.0 < co2_g(sums) < co2_g(whole)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_without_demand_there_is_nothing_to_wait_for(simulator: str) -> None:
    frame = play_out(crossing(inflow_vph_per_lane=0.0, approach="A"), simulator=simulator)
    assert steps_of(frame) == CONFIG.control_steps
    assert not any(values.any() for values in sums_of(frame).values())


def test_vehicles_that_the_simulator_drops_are_of_the_cohort() -> None:
    """They never leave, and are charged to the end, which they do not put off."""
    from tests.envs.test_departures import cramped_context

    frame = play_out(cramped_context(), config=dataclasses.replace(CONFIG, warmup_s=0.0))
    sums = sums_of(frame)
    assert sums["dropped"].sum() > 5 and steps_of(frame) < CONFIG.total_steps
    assert (sums["cohort"] - sums["cohort_left"] >= sums["dropped"]).all()
    assert sums["cohort_blocked_s"].sum() > 100.0 * sums["dropped"].sum()


# -- many side by side -------------------------------------------------------------------------------------------------


def contexts_of_several_lengths(number: int) -> tuple[Context, int]:
    return lane(inflow_vph_per_lane=(60.0, 250.0, 400.0)[number % 3], adoption=0.5), number


def test_each_environment_ends_by_itself_and_rests_until_all_have_ended(make_twin: MakeTwin) -> None:
    config = dataclasses.replace(CONFIG, hold_s=1.5, emit=("metrics", "team_reward"))
    env = make_twin(3, contexts_of_several_lengths, config=config, surrogate="compiled")
    state, ends = env.reset(), [0, 0, 0]
    last: list[Any] = [None] * 3
    for decision in range(1, 1000):
        state = env.step_lean(hurry(state))
        for k in range(3):
            if last[k] is not None:
                assert state["done"][k] and not state["agents", "mask"][k].any() and not state["team_reward"][k].any()
                assert not state["agents", "reward"][k].any() and not state["agents", "done"][k].any()
                assert same(state["metrics"][k], last[k]["metrics"])
            elif state["done"][k]:
                last[k], ends[k] = state[k].clone(), decision
        if state["done"].all():
            break
    assert len(set(ends)) == 3 and min(ends) >= config.decisions
    with pytest.raises(IzooError, match=r"ended after \d+ steps; call reset"):
        env.step_lean(hurry(state))
    for k in range(3):
        context, seed = contexts_of_several_lengths(k)
        alone = play_out(context, hurry, config, "twin", seed)
        assert same(alone["metrics"], last[k]["metrics"])


def test_environments_that_end_at_their_horizon_refuse_further_steps(make_twin: MakeTwin) -> None:
    """As before: a loop that forgot reset() is told."""
    env = make_twin(2, config=dataclasses.replace(CONFIG, drain_s=0.0))
    state = env.reset()
    env.backend.frames["done"][1] = 1  # as when episodes were begun one after the other
    with pytest.raises(IzooError, match="call reset"):
        env.step_lean(hurry(state))


def test_worker_processes_rest_where_their_episode_has_ended() -> None:
    config = dataclasses.replace(CONFIG, hold_s=2.0)
    with contextlib.closing(SumoParallelEnv(2, contexts_of_several_lengths, config=config)) as env:
        state, ended = env.reset(), torch.zeros(2, 1, dtype=torch.bool)
        seen = []
        while not ended.all():
            state = env.step_lean(defer(state))
            assert (state["done"] >= ended).all()
            ended = state["done"].clone()
            seen.append(ended.sum().item())
        assert 1 in seen
        with pytest.raises(IzooError, match="call reset"):
            env.step_lean(defer(state))
    for k in range(2):
        context, seed = contexts_of_several_lengths(k)
        assert same(play_out(context, config=config, seed=seed)["metrics"], state["metrics"][k])


def test_new_episodes_begin_where_one_has_ended(make_twin: MakeTwin) -> None:
    """As TorchRL's loops have it: nobody rests."""
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
    """Saved before it, after it, and where one environment rests; branches of it, too."""
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
    import gymnasium

    config = dataclasses.replace(CONFIG, hold_s=1.5, emit=())
    view: Any = gymnasium.make(
        "izoo.envs:izoo/EcoDriving-v0", contexts=lane(adoption=0.5), config=config, simulator="twin"
    )
    with contextlib.closing(view):
        view.reset(options={"context": lane(adoption=0.5), "episode_seed": SEED})
        over, info = False, {}
        while not over:
            _, _, _, over, info = view.step(np.full(config.num_agents, np.nan, np.float32))
    frame = play_out(lane(adoption=0.5), config=dataclasses.replace(config, emit=("metrics",)), simulator="twin")
    assert info["time_s"] == CONFIG.warmup_s + steps_of(frame) * CONFIG.step_s > CONFIG.horizon_s
    for name in COHORT:
        np.testing.assert_allclose(info["metrics"]["approach"][name], sums_of(frame)[name], err_msg=name)
