"""The views and the TorchRL environment play the same episode: same context, seed and actions, same trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import izoo.envs
from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import EcoDrivingEnv
from izoo.envs.host import Host
from izoo.envs.layout import LANE_POSITION, NUMBER, REGION_LANE, SPEED
from tests.envs.worlds import crossing, episode, short, steer, steering

SEED = 9
CONFIG = short(horizon_s=80.0)
Positions = dict[float, dict[int, tuple[int, float, float]]]
"""Per time, of every vehicle: lane, position on it, speed."""


@pytest.fixture(scope="module")
def expected() -> Iterator[dict[str, Any]]:
    env = EcoDrivingEnv(RoundRobinSchedule([crossing()], SEED), config=CONFIG)
    try:
        frames = episode(env)
    finally:
        env.close()
    following = frames["next"]
    positions: Positions = {}
    for t, vehicles in enumerate(following["vehicles"].unbind(0)):
        present = vehicles["present"]
        names = ("vehicle_number", "region_lane", "lane_position_m", "speed_mps")
        columns = [vehicles[name][present].tolist() for name in names]
        positions[5.5 + 0.5 * t] = {number: state for number, *state in zip(*columns, strict=True)}  # type: ignore[misc]
    yield {"frames": frames, "positions": positions}


def positions_now(host: Host) -> dict[int, list[float]]:
    floats, ints = host.frame["vehicle_floats"], host.frame["vehicle_ints"]
    present = host.frame["vehicle_flags"][:, 0].astype(bool)
    columns = (ints[:, NUMBER], ints[:, REGION_LANE], floats[:, LANE_POSITION], floats[:, SPEED])
    return {number: state for number, *state in zip(*(column[present].tolist() for column in columns), strict=True)}


def accelerations(observation: np.ndarray) -> np.ndarray:
    return steering(torch.from_numpy(observation)).numpy()


@pytest.mark.parametrize("in_process", [True, False])
def test_joint(expected: dict[str, Any], in_process: bool) -> None:
    env = gymnasium.make(
        "izoo/EcoDriving-v0", contexts=crossing(), config=CONFIG, in_process=in_process, disable_env_checker=True
    )
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


def test_pettingzoo(expected: dict[str, Any]) -> None:
    pytest.importorskip("pettingzoo")
    from izoo.envs.pettingzoo import parallel_env

    env = parallel_env(crossing(), CONFIG, SEED, in_process=True)
    try:
        observations, _ = env.reset()
        while env.agents:
            actions = {agent: accelerations(observations[agent]) for agent in env.agents}
            observations, *_ = env.step(actions)
            assert positions_now(env.host) == expected["positions"][env.host.time_s]
        assert env.host.steps == CONFIG.control_steps
    finally:
        env.close()


def test_ego(expected: dict[str, Any]) -> None:
    """With the ego and the others steered alike, through one ego after another."""
    env = izoo.envs.gymnasium.EcoDrivingEgo(crossing(), CONFIG, others=steer, in_process=True)
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
