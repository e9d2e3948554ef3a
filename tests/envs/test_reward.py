"""The reward: its kernels against numbers worked out by hand, and an episode against the equation in torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from izoo.emissions.moves import MovesSurrogate
from izoo.emissions.weights import load_weights
from izoo.envs import SIMULATORS, EcoDrivingEnv, RewardConfig
from izoo.envs.backend import episode_traffic
from izoo.envs.mdp.blocked_demand import NEVER, idle_rates
from izoo.envs.mdp.columns import ACCEL, EMISSION, FLOATS, PREV_ACCEL, SPEED, TTC
from izoo.envs.mdp.credit import BLOCKED, HERE
from izoo.envs.mdp.reward import REWARD_VECTOR
from izoo.envs.mdp.reward_kernel import pay, reward_arrays, reward_terms, team_pay
from izoo.envs.mdp.units import units_of
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from tests.envs.worlds import crossing, defer, episode, play, short

ROWS = np.array([4, 1, 2])
VEHICLES = {  # row: speed, emission, acceleration, the one before, time to collision
    4: (10.0, 1.5, 2.0, -1.0, 6.0),
    1: (0.25, 0.5, -3.0, -3.0, np.inf),
    2: (5.0, 4.0, 0.0, 0.5, 2.5),
}
LEAVER, EMPTY = 6, -1


def tables() -> tuple[np.ndarray, np.ndarray]:
    floats, terms = np.zeros((8, len(FLOATS))), np.full((8, 6), np.nan)
    floats[:, TTC] = np.inf
    for row, values in VEHICLES.items():
        floats[row, [SPEED, EMISSION, ACCEL, PREV_ACCEL, TTC]] = values
    terms[LEAVER] = (12.0, 0.0, 1.0, -0.5, -0.25, 0.0)  # of the step before
    return floats, terms


def paid(config: RewardConfig, rows: np.ndarray = ROWS) -> tuple[np.ndarray, np.ndarray]:
    """Return the reward and its vector for slots that hold rows 4, 1, a leaver, and nobody."""
    floats, terms = tables()
    fleet, shared = np.empty(6), np.empty(1)
    numbers, weights, shared_weights = reward_arrays(config)
    reward_terms(rows, floats, numbers, terms, fleet, shared, np.empty(1))
    reward, vector = np.full(4, np.nan, np.float32), np.full((4, 13), np.nan, np.float32)
    step = np.full(4, np.nan)
    rules = (numbers, weights, shared_weights)
    slots = np.array([4, 1, LEAVER, EMPTY])
    pay(slots, terms[slots], fleet, shared, *rules, step, reward, vector, True, len(rows) == 0, True)
    np.testing.assert_allclose(step, reward, rtol=1e-6)
    return reward, vector


FLEET = (10.0 + 0.25 + 5.0) / 3 - 35.0 * (1 / 3) - 3.0 * (1.5 + 0.5 + 4.0) / 3


def test_fleet_reward_by_hand() -> None:
    reward, _ = paid(RewardConfig())
    assert reward == pytest.approx([FLEET / 15] * 3 + [0.0])


def test_individual_reward_by_hand() -> None:
    reward, _ = paid(RewardConfig(eta=0.0))
    assert reward == pytest.approx([(10.0 - 4.5) / 15, (0.25 - 35.0 - 1.5) / 15, (12.0 - 3.0) / 15, 0.0])


def test_a_leaver_gets_its_last_individual_term_and_the_fleet_mean() -> None:
    reward, _ = paid(RewardConfig(eta=0.75))
    assert reward[2] == pytest.approx((0.75 * FLEET + 0.25 * 9.0) / 15)


def test_soft_stop() -> None:
    reward, _ = paid(RewardConfig(eta=0.0, soft_stop=True, tau_mps=2.0))
    assert reward[1] == pytest.approx((0.25 - 35.0 * (2.0 - 0.25) / 2.0 - 1.5) / 15)
    assert reward[0] == pytest.approx((10.0 - 4.5) / 15)


def test_comfort() -> None:
    base, _ = paid(RewardConfig())
    fleet, _ = paid(RewardConfig(comfort=0.3))
    assert fleet - base == pytest.approx([-0.3 * (2.0 + 3.0 + 0.0) / 3 / 15] * 3 + [0.0], abs=1e-6)
    own, _ = paid(RewardConfig(eta=0.0, alpha=0.0, beta=0.0, comfort=0.3))
    assert own == pytest.approx([(10.0 - 0.6) / 15, (0.25 - 0.9) / 15, (12.0 - 0.15) / 15, 0.0])


def test_realism() -> None:
    base, _ = paid(RewardConfig())
    fleet, _ = paid(RewardConfig(realism=2.0))
    assert fleet - base == pytest.approx([-2.0 * (3.0 + 0.0 + 0.5) / 3 / 15] * 3 + [0.0], abs=1e-6)
    own, _ = paid(RewardConfig(eta=0.0, alpha=0.0, beta=0.0, realism=2.0))
    assert own == pytest.approx([(10.0 - 6.0) / 15, 0.25 / 15, (12.0 - 0.5) / 15, 0.0])


def test_safety_is_shared_and_capped() -> None:
    base, _ = paid(RewardConfig())
    safe, _ = paid(RewardConfig(safety=1.5))
    assert safe - base == pytest.approx([1.5 * 2.5 / 15] * 3 + [0.0], abs=1e-6)
    without, _ = paid(RewardConfig(), ROWS[1:2])
    capped, _ = paid(RewardConfig(safety=1.5), ROWS[1:2])
    assert (capped - without)[1:] == pytest.approx([1.5 * 10.0 / 15] * 2 + [0.0], abs=1e-6)


def test_an_empty_region_pays_nothing() -> None:
    reward, vector = paid(RewardConfig(eta=0.5, safety=1.0), ROWS[:0])
    assert not reward.any() and not vector.any()


def test_reward_vector_holds_the_raw_columns() -> None:
    _, vector = paid(RewardConfig(eta=0.5))
    fleet = [15.25 / 3, 1 / 3, 2.0, -5.0 / 3, -3.5 / 3, 0.0]
    assert vector[0] == pytest.approx([10.0, 0.0, 1.5, -2.0, -3.0, 0.0, *fleet, 2.5])
    assert vector[1] == pytest.approx([0.25, 1.0, 0.5, -3.0, 0.0, 0.0, *fleet, 2.5])
    assert vector[2] == pytest.approx([12.0, 0.0, 1.0, -0.5, -0.25, 0.0, *fleet, 2.5])
    assert not vector[3].any() and len(REWARD_VECTOR) == 13


@pytest.mark.parametrize(
    "config",
    [
        RewardConfig(),
        RewardConfig(eta=0.3, soft_stop=True, tau_mps=3.0, alpha=-10.0, beta=-1.0, scale=2.0),
        RewardConfig(eta=0.6, comfort=0.5, realism=0.25, delay=-0.5, safety=0.1),
    ],
    ids=("paper", "soft", "all terms"),
)
def test_an_episode_is_paid_by_the_equation(config: RewardConfig) -> None:
    """Recompute every reward of an episode from the vehicles that it reports."""
    settings = short(reward=config, emit=("vehicles", "signal", "context", "metrics", "reward_vector"))
    env = EcoDrivingEnv(crossing(), config=settings, seed=2)
    try:
        steps = episode(env)
        limits = torch.tensor(env.road.lane_limit_mps)
    finally:
        env.close()
    leavers = 0
    # What a vehicle was doing: terms of the last step in which it was there, by its number.
    last: dict[int, torch.Tensor] = {}
    accel_before: dict[int, float] = {}
    for t in range(len(steps)):
        frame = steps[t]
        if t == 0:
            last, _, _ = individual_terms(frame["vehicles"], accel_before, config, limits)
            accel_before = accelerations(frame["vehicles"])
        acting, row = frame["agents", "mask"], frame["agents", "vehicle"]
        number = frame["vehicles", "vehicle_number"][row]
        now, fleet, shortest = individual_terms(frame["next", "vehicles"], accel_before, config, limits)
        accel_before |= accelerations(frame["next", "vehicles"])
        weights = torch.tensor([1.0, config.alpha, config.beta, config.comfort, config.realism, config.delay])
        expected = torch.zeros(len(acting))
        for slot in torch.nonzero(acting).flatten().tolist():
            mine = now.get(int(number[slot]), last[int(number[slot])])
            leavers += int(number[slot]) not in now
            total = weights @ (config.eta * fleet + (1 - config.eta) * mine) + config.safety * shortest
            expected[slot] = total / config.scale
            vector = torch.cat([mine, fleet, torch.tensor([shortest])])
            torch.testing.assert_close(frame["next", "agents", "reward_vector"][slot], vector, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(frame["next", "agents", "reward"].squeeze(-1), expected, rtol=1e-4, atol=1e-4)
        last = now
    assert leavers > 0
    reward, mask = steps["next", "agents", "reward"].squeeze(-1), steps["agents", "mask"]
    final = steps["next", "metrics", "episode"][-1]
    assert final["reward_sum"].item() == pytest.approx(reward[mask].sum().item(), rel=1e-4)
    per_step = torch.where(mask, reward, 0.0).sum(-1) / mask.sum(-1).clamp(min=1)
    assert final["return"].item() == pytest.approx(per_step.sum().item(), rel=1e-4)


def accelerations(vehicles) -> dict[int, float]:  # type: ignore[no-untyped-def]
    there = vehicles["present"]
    return dict(zip(vehicles["vehicle_number"][there].tolist(), vehicles["accel_mps2"][there].tolist(), strict=True))


def individual_terms(vehicles, accel_before, config, limits):  # type: ignore[no-untyped-def]
    """Return ``{vehicle number: terms [6]}``, their mean ``[6]``, and the smallest time to collision."""
    there = vehicles["present"]
    part = vehicles[there]
    v, a = part["speed_mps"], part["accel_mps2"]
    before = torch.tensor(
        [accel_before.get(n, x) for n, x in zip(part["vehicle_number"].tolist(), a.tolist(), strict=True)]
    )
    stopped = (v < config.tau_mps).float() * ((config.tau_mps - v) / config.tau_mps if config.soft_stop else 1.0)
    delay = 0.5 * (1.0 - v / limits[part["region_lane"].long()].float()).clamp(min=0.0)
    terms = torch.stack([v, stopped, part["emission_g"], -a.abs(), -(a - before).abs(), delay], -1)
    closing = v - part["leader_speed_mps"]
    ttc = torch.where(part["has_leader"] & (closing > 0), part["leader_gap_m"].clamp(min=0.0) / closing, 10.0)
    shortest = min(10.0, ttc.min().item()) if len(ttc) else 10.0
    mean = terms.mean(0) if len(terms) else torch.zeros(6)
    return dict(zip(part["vehicle_number"].tolist(), terms, strict=True)), mean, shortest


@pytest.mark.parametrize("engine", ["combustion", "electric"])
def test_emission_is_the_surrogates(engine: str) -> None:
    """Every vehicle's CO2 is what the batched surrogate says of its reported state; electric CVs emit nothing."""
    env = EcoDrivingEnv(crossing(engine=engine, temperature_c=31.0, grade=0.03), config=short(), seed=2)
    try:
        frames = episode(env)["next"]
    finally:
        env.close()
    v, context = frames["vehicles"], frames["context"]
    active = v["present"] & ~(v["is_cv"] & (engine == "electric"))
    weather = (context["temperature_c"].expand_as(v["speed_mps"]), context["humidity_pct"].expand_as(v["speed_mps"]))
    rate = MovesSurrogate()(
        v["speed_mps"], v["accel_mps2"], v["grade_pct"], v["moves_class"].long(), *weather, mask=active
    )
    torch.testing.assert_close(v["emission_g"], rate * 0.5, rtol=1e-3, atol=1e-5)
    assert (v["emission_g"][active] > 0).all()
    assert (v["emission_g"][v["present"] & v["is_cv"]] == 0).all() == (engine == "electric")
    hdv = frames["metrics", "approach", "emission_hdv_g"][-1].sum()
    assert hdv > 0
    assert (hdv == frames["metrics", "approach", "emission_g"][-1].sum()) == (engine == "electric")


@pytest.mark.parametrize(("engine", "burning"), [("combustion", [1.0, 1.0]), ("electric", [0.6, 0.0])])
def test_blocked_vehicles_burn_what_they_would_inside(engine: str, burning: list[float]) -> None:
    """Electric CVs nothing; the unit, human driving, is the same."""
    found = []
    for adoption, share in zip((0.4, 1.0), burning, strict=True):
        context = crossing(engine=engine, adoption=adoption)
        road = read_road(build_net(context.intersection))
        traffic = episode_traffic(short(horizon_s=1000.0), context, road, 3)
        played, human = context, context.replace(engine="combustion")
        idle_gps, human_gps = (idle_rates(each, road, traffic, load_weights()).sum() for each in (played, human))
        assert idle_gps == pytest.approx(share * human_gps, rel=0.3), adoption
        own, human = (units_of(each, road, traffic, load_weights(), 1000.0, 0.5) for each in (played, human))
        found.append((own.unit_g == human.unit_g).all() and own.fleet_g_per_step == human.fleet_g_per_step)
    assert all(found)


def test_vehicles_that_came_and_left_before_control_are_not_blocked() -> None:
    config = short(warmup_s=100.0, horizon_s=300.0, reward=RewardConfig.fuel_team())
    for simulator in SIMULATORS:
        env = EcoDrivingEnv(crossing(inflow_vph_per_lane=200.0, adoption=0.0), config=config, simulator=simulator)
        try:
            play(env, config.control_steps - 1, defer)
            run = env.backend if simulator == "sumo" else env.backend._runs[0]  # type: ignore[attr-defined]
            fate, blocked, came = run.episode.awaited
            assert (came == 0).sum() > 5 and ((fate == HERE) == (came != NEVER)).all()
            assert (fate == BLOCKED).sum() == blocked[:, 0].sum() > 0
            assert not came[fate == BLOCKED].tolist().count(0)
        finally:
            env.close()


def test_reward_settings_do_not_change_what_happens() -> None:
    """Weights change what is paid, not the traffic."""
    speeds = []
    for reward in (RewardConfig(), replace(RewardConfig(), eta=0.0, comfort=1.0)):
        env = EcoDrivingEnv(crossing(), config=short(reward=reward), seed=2)
        try:
            speeds.append(episode(env)["next", "vehicles", "speed_mps"])
        finally:
            env.close()
    assert torch.equal(*speeds)


def test_nothing_is_shared_with_the_team_in_an_empty_region() -> None:
    """As nobody is paid there: a time to collision that nobody has is no merit."""
    config = RewardConfig(safety=2.0)
    numbers, weights, shared_weights = reward_arrays(config)
    floats, terms = tables()
    fleet, shared = np.empty(6), np.empty(1)
    for rows, expected in ((ROWS, (FLEET + 2.0 * 2.5) / 15), (ROWS[:0], 0.0)):
        reward_terms(rows, floats, numbers, terms, fleet, shared, np.empty(1))
        found = team_pay(fleet, shared, numbers, weights, shared_weights, len(rows) == 0)
        assert found == pytest.approx(expected)
