"""The views and the TorchRL environment play the same episode: same context, seed and actions, same trajectories."""

from __future__ import annotations

import dataclasses
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import izoo.envs.views.gymnasium
import izoo.envs.views.pettingzoo
from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import SIMULATORS, EcoDrivingEnv, EnvConfig
from izoo.envs.mdp.columns import LANE_POSITION, NUMBER, REGION_LANE, SPEED
from izoo.envs.views.view_session import Host
from izoo.errors import IzooError
from tests.envs.worlds import choose_lanes, crossing, episode, short, steer, steer_and_change, steering

SEED = 9
CONFIG = short(horizon_s=80.0)
Positions = dict[float, dict[int, tuple[int, float, float]]]
"""Per time, of every vehicle: lane, position on it, speed."""


CHANGING = dataclasses.replace(CONFIG, lane_change=True)


@pytest.fixture(scope="module", params=SIMULATORS)
def simulator(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def expected(simulator: str) -> dict[str, Any]:
    return played(CONFIG, simulator)


@pytest.fixture(scope="module")
def expected_with_lanes(simulator: str) -> dict[str, Any]:
    return played(CHANGING, simulator)


def played(config: EnvConfig, simulator: str) -> dict[str, Any]:
    """Play the episode in the TorchRL environment."""
    env = EcoDrivingEnv(RoundRobinSchedule([crossing()], SEED), config=config, simulator=simulator)
    try:
        frames = episode(env, steer_and_change if config.lane_change else steer)
    finally:
        env.close()
    following = frames["next"]
    positions: Positions = {}
    for t, vehicles in enumerate(following["vehicles"].unbind(0)):
        present = vehicles["present"]
        names = ("vehicle_number", "region_lane", "lane_position_m", "speed_mps")
        columns = [vehicles[name][present].tolist() for name in names]
        positions[5.5 + 0.5 * t] = {number: state for number, *state in zip(*columns, strict=True)}  # type: ignore[misc]
    return {"frames": frames, "positions": positions}


def positions_now(host: Host) -> dict[int, list[float]]:
    floats, ints = host.frame["vehicle_floats"], host.frame["vehicle_ints"]
    present = host.frame["vehicle_flags"][:, 0].astype(bool)
    columns = (ints[:, NUMBER], ints[:, REGION_LANE], floats[:, LANE_POSITION], floats[:, SPEED])
    return {number: state for number, *state in zip(*(column[present].tolist() for column in columns), strict=True)}


def accelerations(observation: np.ndarray) -> np.ndarray:
    return steering(torch.from_numpy(observation)).numpy()


@pytest.mark.parametrize("in_process", [True, False])
def test_joint(expected: dict[str, Any], simulator: str, in_process: bool) -> None:
    options: dict[str, Any] = {"in_process": in_process, "simulator": simulator, "disable_env_checker": True}
    env = gymnasium.make("izoo/EcoDriving-v0", contexts=crossing(), config=CONFIG, **options)
    host = env.unwrapped.host  # type: ignore[attr-defined]
    try:
        observation, _ = env.reset(seed=SEED)
        for frame in expected["frames"].unbind(0):
            assert torch.equal(torch.from_numpy(observation["observation"]), frame["agents", "observation"])
            action = accelerations(observation["observation"]).squeeze(-1)
            observation, _, _, truncated, info = env.step(action)
            assert positions_now(host) == expected["positions"][info["time_s"]]
            reward = frame["next", "agents", "reward"].squeeze(-1)
            assert torch.equal(torch.from_numpy(info["reward"]), reward)
            ended = frame["next", "agents", "terminated"].squeeze(-1)
            assert info["agent_terminated"].tolist() == ended.tolist()
        assert truncated and info["metrics"]["episode"]["steps"] == CONFIG.control_steps
        crossed = expected["frames"]["next", "metrics", "approach", "crossed"][-1]
        assert info["metrics"]["approach"]["crossed"].tolist() == crossed.tolist()
    finally:
        env.close()


def test_pettingzoo(expected: dict[str, Any], simulator: str) -> None:
    pytest.importorskip("pettingzoo")
    from izoo.envs.views.pettingzoo import parallel_env

    env = parallel_env(crossing(), CONFIG, SEED, in_process=True, simulator=simulator)
    try:
        observations, _ = env.reset()
        while env.agents:
            actions = {agent: accelerations(observations[agent]) for agent in env.agents}
            observations, *_ = env.step(actions)
            assert positions_now(env.host) == expected["positions"][env.host.time_s]
        assert env.host.steps == CONFIG.control_steps
    finally:
        env.close()


def test_ego(expected: dict[str, Any], simulator: str) -> None:
    """With the ego and the others steered alike, through one ego after another."""
    env = izoo.envs.views.gymnasium.EcoDrivingEgo(
        crossing(), CONFIG, others=steer, in_process=True, simulator=simulator
    )
    try:
        observation, info = env.reset(seed=SEED)
        compared = 0
        while info["episode"] == 0:
            ended = False
            while not ended:
                observation, _, terminated, truncated, step = env.step(accelerations(observation))
                assert positions_now(env.host) == expected["positions"][step["time_s"]]
                ended, compared = terminated or truncated, compared + 1
            observation, info = env.reset()
        assert compared > 60
    finally:
        env.close()


# -- with lane changes -------------------------------------------------------------------------------------------------


def both(observation: np.ndarray) -> dict[str, Any]:
    """The action of one vehicle ``[F]``, or of all ``[A, F]``."""
    lanes = choose_lanes(torch.from_numpy(observation)).numpy()
    acceleration = accelerations(observation)
    if observation.ndim == 1:
        return {"acceleration": acceleration, "lane_change": np.int64(lanes)}
    return {"acceleration": acceleration.squeeze(-1), "lane_change": lanes}


def test_lane_changes_matter(expected: dict[str, Any], expected_with_lanes: dict[str, Any]) -> None:
    times = list(expected["positions"])
    differ = [expected["positions"][time] != expected_with_lanes["positions"][time] for time in times]
    assert sum(differ) > len(times) / 2


def test_joint_with_lane_changes(expected_with_lanes: dict[str, Any], simulator: str) -> None:
    env = izoo.envs.views.gymnasium.EcoDrivingJoint(crossing(), CHANGING, in_process=True, simulator=simulator)
    try:
        observation, _ = env.reset(seed=SEED)
        truncated = False
        while not truncated:
            action = both(observation["observation"])
            assert action in env.action_space
            observation, _, _, truncated, info = env.step(action)
            assert positions_now(env.host) == expected_with_lanes["positions"][info["time_s"]]
    finally:
        env.close()


def test_pettingzoo_with_lane_changes(expected_with_lanes: dict[str, Any], simulator: str) -> None:
    pytest.importorskip("pettingzoo")
    from izoo.envs.views.pettingzoo import parallel_env

    env = parallel_env(crossing(), CHANGING, SEED, in_process=True, simulator=simulator)
    try:
        observations, _ = env.reset()
        while env.agents:
            actions = {agent: both(observations[agent]) for agent in env.agents}
            assert all(action in env.action_space(agent) for agent, action in actions.items())
            observations, *_ = env.step(actions)
            assert positions_now(env.host) == expected_with_lanes["positions"][env.host.time_s]
        assert env.host.steps == CHANGING.control_steps
    finally:
        env.close()


def test_ego_with_lane_changes(expected_with_lanes: dict[str, Any], simulator: str) -> None:
    options: dict[str, Any] = {"others": steer_and_change, "in_process": True, "simulator": simulator}
    env = izoo.envs.views.gymnasium.EcoDrivingEgo(crossing(), CHANGING, **options)
    try:
        observation, info = env.reset(seed=SEED)
        compared = 0
        while info["episode"] == 0:
            ended = False
            while not ended:
                observation, _, terminated, truncated, step = env.step(both(observation))
                assert positions_now(env.host) == expected_with_lanes["positions"][step["time_s"]]
                ended, compared = terminated or truncated, compared + 1
            observation, info = env.reset()
        assert compared > 60
    finally:
        env.close()


@pytest.mark.parametrize("make", ["joint", "ego", "agents"])
def test_a_fresh_view_can_be_pickled(make: str, simulator: str) -> None:
    """As libraries do to start their workers; what comes out plays what the original does."""
    views = izoo.envs.views
    made: Any = {
        "joint": views.gymnasium.EcoDrivingJoint,
        "ego": views.gymnasium.EcoDrivingEgo,
        "agents": views.pettingzoo.parallel_env,
    }[make]
    env = made(crossing(), CONFIG, simulator=simulator)
    other = pickle.loads(pickle.dumps(env))
    try:
        first, second = env.reset(seed=4), other.reset(seed=4)
        assert str(first) == str(second)
        seen = 0
        for _ in range(30):
            for host in (env.host, other.host):
                host.step(host.commands())
            assert np.array_equal(env.host.frame["observation"], other.host.frame["observation"])
            seen += int(env.host.mask.sum())
        assert seen > 0
        with pytest.raises(IzooError, match=r"whose episode has begun cannot be copied or pickled; do so before reset"):
            pickle.dumps(env)
    finally:
        env.close()
        other.close()


def test_infos_of_agents_hold_numbers_alone() -> None:
    """Libraries put them into arrays."""
    env = izoo.envs.views.pettingzoo.parallel_env(crossing(), CONFIG, simulator="twin")
    try:
        _, infos = env.reset(seed=1)
        after = env.step(dict.fromkeys(env.agents))[-1]
        for info in (*infos.values(), *after.values()):
            assert all(isinstance(value, (int, float, np.ndarray)) for value in info.values())
        assert env.plan() == {"context": crossing().name, "episode": 0, "episode_seed": env.host.episode_seed}
    finally:
        env.close()
