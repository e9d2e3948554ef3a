"""Slots of agents and vehicles: vehicles that leave and enter, the horizon, and too few slots."""

import contextlib

import pytest
import torch
from tensordict import TensorDict

from izoo.envs import EcoDrivingEnv, EnvConfig
from tests.envs.worlds import crossing, defer, episode, play, short, steer


def run(config: EnvConfig, act=steer, **changes: object) -> TensorDict:  # type: ignore[no-untyped-def]
    with contextlib.closing(EcoDrivingEnv(crossing(**changes), config=config, seed=3)) as env:
        return episode(env, act)


@pytest.fixture(scope="module")
def frames() -> TensorDict:
    """An episode in which CVs leave and others take their slots."""
    return run(short(horizon_s=200.0), inflow_vph_per_lane=500.0)


def holders(part: TensorDict) -> torch.Tensor:
    """Number of the vehicle in every agent slot ``[T, A]``, -1 where the slot is empty."""
    number = torch.gather(part["vehicles", "vehicle_number"].long(), 1, part["agents", "vehicle"])
    return torch.where(part["agents", "mask"], number, -1)


def rows(part: TensorDict) -> torch.Tensor:
    """Number of the vehicle in every vehicle slot ``[T, V]``, -1 where the slot is empty."""
    return torch.where(part["vehicles", "present"], part["vehicles", "vehicle_number"].long(), -1)


def test_a_vehicle_keeps_its_slot_which_serves_others_later(frames: TensorDict) -> None:
    served = [set(column[column >= 0].tolist()) for column in holders(frames).unbind(1)]
    assert max(len(numbers) for numbers in served) >= 2
    numbers = [number for slot in served for number in slot]
    assert len(numbers) == len(set(numbers))


@pytest.mark.parametrize("occupants", [holders, rows], ids=["agents", "vehicles"])
def test_next_shows_the_same_vehicle_or_an_empty_slot(frames: TensorDict, occupants) -> None:  # type: ignore[no-untyped-def]
    """A slot freed in a step is empty in that step's ``next``."""
    now, after = occupants(frames), occupants(frames["next"])
    held = now >= 0
    assert ((after == now) | (after == -1))[held].all()
    assert (held & (after == -1)).any()


def test_an_agent_that_leaves_is_terminated(frames: TensorDict) -> None:
    after, agents = frames["next", "agents"], frames["agents"]
    left = agents["mask"] & ~after["mask"]
    assert left.any()
    assert torch.equal(left, after["terminated"].squeeze(-1))
    assert after["done"].squeeze(-1)[left].all() and not after["truncated"].squeeze(-1)[left].any()
    assert not after["observation"][left].any()
    assert (after["reward"].squeeze(-1)[left] != 0).all()
    stayed = agents["mask"] & after["mask"]
    assert not after["done"][:-1].squeeze(-1)[stayed[:-1]].any()
    gone = (rows(frames) >= 0) & (rows(frames["next"]) == -1)
    assert (frames["vehicles", "location"][gone] == 2).all(), "only vehicles on their exit may disappear"


def test_empty_slots_are_zero(frames: TensorDict) -> None:
    """And a new agent, which is in ``next`` but did not act, has no reward."""
    idle = ~frames["agents", "mask"]
    after = frames["next", "agents"]
    for name in ("reward", "done", "terminated", "truncated"):
        assert not after[name].squeeze(-1)[:-1][idle[:-1]].any(), name
    assert (idle & after["mask"]).any(), "no vehicle enters in the scenario"
    for part in (frames, frames["next"]):
        empty = ~part["agents", "mask"]
        assert not part["agents", "observation"][empty].any() and not part["agents", "vehicle"][empty].any()
        gone = ~part["vehicles", "present"]
        for name, value in part["vehicles"].items():
            assert not value[gone].any(), name


def test_the_horizon_truncates(frames: TensorDict) -> None:
    after = frames["next"]
    assert after["truncated"].squeeze(-1).tolist() == [False] * (len(frames) - 1) + [True]
    assert torch.equal(after["done"], after["truncated"]) and not after["terminated"].any()
    last = after[-1]
    mask = last["agents", "mask"]
    assert mask.any()
    assert torch.equal(last["agents", "truncated"].squeeze(-1), mask)
    assert not (last["agents", "terminated"].squeeze(-1) & mask).any()
    assert (last["agents", "observation"][mask].abs().sum(-1) > 0).all()


def test_agents_point_to_the_vehicle_that_they_observe(frames: TensorDict) -> None:
    mask = frames["agents", "mask"]
    speed = torch.gather(frames["vehicles", "speed_mps"], 1, frames["agents", "vehicle"])
    torch.testing.assert_close(frames["agents", "observation"][..., 0][mask], speed[mask] / 15.0)
    is_cv = torch.gather(frames["vehicles", "is_cv"], 1, frames["agents", "vehicle"])
    assert is_cv[mask].all()
    assert (frames["vehicles", "is_cv"].sum(-1) == mask.sum(-1)).all(), "a CV has no slot though slots are free"


def test_a_freed_slot_is_empty_for_a_step() -> None:
    """With one agent slot for many CVs."""
    frames = run(short(horizon_s=150.0, num_agents=1), defer, adoption=1.0, lane_count=1, inflow_vph_per_lane=600.0)
    held = holders(frames).squeeze(-1)
    changes = [(a, b) for a, b in zip(held.tolist(), held.tolist()[1:], strict=False) if a != b]
    assert len([b for a, b in changes if b >= 0]) >= 2
    assert all(a == -1 or b == -1 for a, b in changes)


def test_more_cvs_than_slots() -> None:
    """Surplus CVs are uncommanded and counted; a CV without a slot never gets one later."""
    frames = run(short(num_agents=2), adoption=1.0)
    metrics = frames["next", "metrics"]
    cvs, slots = frames["vehicles", "is_cv"].sum(-1), frames["agents", "mask"].sum(-1)
    assert slots.max() == 2 and cvs.max() > 2
    after = frames["next"]
    surplus = after["vehicles", "is_cv"].sum(-1) - after["agents", "mask"].sum(-1)
    assert metrics["approach", "unslotted_steps"][-1].sum() == surplus.sum()
    numbers, held = (
        {number for part in (frames, after) for number in found(part).tolist()}
        for found in (lambda part: rows(part)[part["vehicles", "is_cv"]], lambda part: holders(part).flatten())
    )
    assert metrics["episode", "unslotted"][-1].item() == len(numbers - held)
    waiting = frames["vehicles", "is_cv"].clone()
    waiting.scatter_(1, frames["agents", "vehicle"], ~frames["agents", "mask"])
    assert not frames["vehicles", "deferred"][waiting].any()


def test_more_vehicles_than_slots() -> None:
    """Surplus vehicles are simulated and measured too."""
    few, many = run(short(num_vehicles=3), defer), run(short(), defer)
    assert few["vehicles", "present"].sum(-1).max() == 3
    assert (few["agents", "vehicle"] < 3).all()
    for name in ("entered", "crossed", "emission_g", "region_emission_g", "travel_time_s"):
        one, other = (part["next", "metrics", "approach", name][-1] for part in (few, many))
        assert other.sum() > 0
        torch.testing.assert_close(one, other)
    assert few["next", "metrics", "episode", "vehicle_steps"][-1] == many["next", "vehicles", "present"].sum()
    assert few["next", "metrics", "episode", "unslotted"][-1] > 0


def test_no_vehicle_of_a_crowd_is_lost() -> None:
    """With far more vehicles than slots for them."""
    crowded = crossing(lane_count=4, inflow_vph_per_lane=900.0, adoption=1.0, lane_length_m=400.0)
    config = EnvConfig(horizon_s=260.0, warmup_s=5.0, num_agents=8, num_vehicles=16)
    with contextlib.closing(EcoDrivingEnv(crowded, config=config)) as env:
        frames = play(env, 380, defer)
        tables, members = env.backend.simulation().episode.tables, env.backend.simulation().episode.members
    assert frames["next", "metrics", "episode", "vehicle_steps"].diff(dim=0).max() > 256
    approach, vehicles = frames["next", "metrics", "approach"][-1], tables.vehicles[members]
    unfinished = int(((vehicles["counted"] == 1) & (vehicles["crossed"] == 0)).sum())
    assert approach["entered"].sum() == approach["crossed"].sum() + unfinished


def test_a_vehicle_that_passes_its_approach_within_a_step_is_found() -> None:
    """At 25 m/s an approach of 8 m takes less than a step: such vehicles are first seen inside the junction."""
    roads = {"lane_count": 1, "phase_count": 1, "lane_length_m": 22.0, "speed_limit_mps": 25.0}
    context = crossing(**roads, green_s=60.0, red_s=15.0, inflow_vph_per_lane=400.0, approach="A")
    with contextlib.closing(EcoDrivingEnv(context, config=short(horizon_s=500.0), seed=3)) as env:
        region: set[str] = set()
        known: set[str] = set()
        state, simulator = env.reset(), env.backend
        edges = {lane.rsplit("_", 1)[0] for lane in env.road.lane_ids}
        for _ in range(env.config.control_steps - 1):
            _, state = env.step_and_maybe_reset(defer(state))
            region |= {name for edge in edges for name in simulator.session.on_edge(edge)}
            known |= set(simulator.simulation().row_of)
    assert len(region) > 50 and known == region
