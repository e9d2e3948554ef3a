"""The reward: the rewards of an episode against the equation in torch, CO2 against the surrogate."""

import contextlib
from dataclasses import replace

import pytest
import torch

from izoo.emissions.moves import MovesSurrogate
from izoo.emissions.weights import load_weights
from izoo.envs import SIMULATORS, EcoDrivingEnv, RewardConfig
from izoo.envs.backend import episode_traffic
from izoo.envs.mdp.blocked_demand import NEVER, idle_rates
from izoo.envs.mdp.state import BLOCKED, ENTERED
from izoo.envs.mdp.units import human_units
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from tests.envs.worlds import crossing, defer, episode, play, short


@pytest.mark.parametrize(
    "config",
    [
        RewardConfig(),
        RewardConfig(eta=0.3, soft_stop=True, tau_mps=3.0, alpha=-10.0, beta=-1.0, scale=2.0),
        RewardConfig(eta=0.6, comfort=0.5, realism=0.25, delay=-0.5, safety=0.1),
    ],
    ids=("paper", "soft", "all terms"),
)
def test_rewards_of_an_episode_follow_the_equation(config: RewardConfig) -> None:
    """Recompute every reward of an episode from the emitted vehicles."""
    settings = short(reward=config, emit=("vehicles", "signal", "context", "metrics", "reward_vector"))
    with contextlib.closing(EcoDrivingEnv(crossing(), config=settings, seed=2)) as env:
        steps = episode(env)
        limits = torch.tensor(env.road.lane_limit_mps)
    leavers = 0
    # Terms of the last step in which a vehicle was there, by its number: those of a leaver.
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
    numbers = part["vehicle_number"].tolist()
    before = torch.tensor([accel_before.get(n, x) for n, x in zip(numbers, a.tolist(), strict=True)])
    stopped = (v < config.tau_mps).float() * ((config.tau_mps - v) / config.tau_mps if config.soft_stop else 1.0)
    delay = 0.5 * (1.0 - v / limits[part["region_lane"].long()].float()).clamp(min=0.0)
    terms = torch.stack([v, stopped, part["emission_g"], -a.abs(), -(a - before).abs(), delay], -1)
    closing = v - part["leader_speed_mps"]
    ttc = torch.where(part["has_leader"] & (closing > 0), part["leader_gap_m"].clamp(min=0.0) / closing, 10.0)
    shortest = min(10.0, ttc.min().item()) if len(ttc) else 10.0
    mean = terms.mean(0) if len(terms) else torch.zeros(6)
    return dict(zip(numbers, terms, strict=True)), mean, shortest


@pytest.mark.parametrize("engine", ["combustion", "electric"])
def test_emission_equals_the_surrogates(engine: str) -> None:
    """Every vehicle's CO2 is that of the batched surrogate for its emitted state; electric CVs emit nothing."""
    context = crossing(engine=engine, temperature_c=31.0, grade=0.03)
    with contextlib.closing(EcoDrivingEnv(context, config=short(), seed=2)) as env:
        frames = episode(env)["next"]
    v, context = frames["vehicles"], frames["context"]
    active = v["present"] & ~(v["is_cv"] & (engine == "electric"))
    weather = (context["temperature_c"].expand_as(v["speed_mps"]), context["humidity_pct"].expand_as(v["speed_mps"]))
    motion = v["speed_mps"], v["accel_mps2"], v["grade_pct"]
    rate = MovesSurrogate()(*motion, v["moves_class"].long(), *weather, mask=active)
    torch.testing.assert_close(v["emission_g"], rate * 0.5, rtol=1e-3, atol=1e-5)
    assert (v["emission_g"][active] > 0).all()
    assert (v["emission_g"][v["present"] & v["is_cv"]] == 0).all() == (engine == "electric")
    hdv = frames["metrics", "approach", "emission_hdv_g"][-1].sum()
    assert hdv > 0
    assert (hdv == frames["metrics", "approach", "emission_g"][-1].sum()) == (engine == "electric")


@pytest.mark.parametrize(("engine", "burning"), [("combustion", [1.0, 1.0]), ("electric", [0.6, 0.0])])
def test_blocked_vehicles_count_as_idling_inside(engine: str, burning: list[float]) -> None:
    """Electric CVs emit nothing; the unit, human driving, stays the same."""
    found = []
    for adoption, share in zip((0.4, 1.0), burning, strict=True):
        context = crossing(engine=engine, adoption=adoption)
        road = read_road(build_net(context.intersection))
        traffic = episode_traffic(short(horizon_s=1000.0), context, road, 3)
        played, human = context, context.replace(engine="combustion")
        idle_gps, human_gps = (idle_rates(each, road, traffic, load_weights()).sum() for each in (played, human))
        assert idle_gps == pytest.approx(share * human_gps, rel=0.3), adoption
        own, human = (human_units(each, road, traffic, load_weights(), 1000.0, 0.5) for each in (played, human))
        found.append((own.unit_g == human.unit_g).all() and own.fleet_g_per_step == human.fleet_g_per_step)
    assert all(found)


def test_vehicles_that_left_during_the_warm_up_are_not_blocked() -> None:
    config = short(warmup_s=100.0, horizon_s=300.0, reward=RewardConfig.fuel_team())
    for simulator in SIMULATORS:
        context = crossing(inflow_vph_per_lane=200.0, adoption=0.0)
        with contextlib.closing(EcoDrivingEnv(context, config=config, simulator=simulator)) as env:
            play(env, config.control_steps - 1, defer)
            run = env.backend.simulation() if simulator == "sumo" else env.backend._runs[0]  # type: ignore[attr-defined]
            tables = run.episode.tables
            status, arrival_step = tables.demand["status"], tables.demand["arrival_step"]
            assert (arrival_step == 0).sum() > 5 and ((status == ENTERED) == (arrival_step != NEVER)).all()
            assert (status == BLOCKED).sum() == tables.blocked["vehicles"].sum() > 0
            assert not (arrival_step[status == BLOCKED] == 0).any()


def test_reward_settings_do_not_change_the_traffic() -> None:
    speeds = []
    for reward in (RewardConfig(), replace(RewardConfig(), eta=0.0, comfort=1.0)):
        with contextlib.closing(EcoDrivingEnv(crossing(), config=short(reward=reward), seed=2)) as env:
            speeds.append(episode(env)["next", "vehicles", "speed_mps"])
    assert torch.equal(*speeds)
