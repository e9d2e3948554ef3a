"""The views and the TorchRL environment play the same episode: same context, seed and actions, same trajectories."""

import contextlib
import pickle
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import izoo.envs.views.gymnasium
from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import SIMULATORS, EcoDrivingEnv, EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.views.view_session import ViewSession
from izoo.errors import IzooError
from tests.envs.worlds import choose_lanes, crossing, episode, short, steer, steer_and_change, steering

SEED = 9
Positions = dict[int, list[float]]
"""Of every vehicle: lane, position on it, speed."""


class Expected(NamedTuple):
    """An episode of the TorchRL environment."""

    simulator: str
    config: EnvConfig
    frames: TensorDict
    positions: dict[float, Positions]


@pytest.fixture(scope="module", params=[(name, lanes) for name in SIMULATORS for lanes in (False, True)])
def expected(request: pytest.FixtureRequest) -> Expected:
    simulator, lane_change = request.param
    config = short(lane_change=lane_change)
    schedule = RoundRobinSchedule([crossing()], SEED)
    with contextlib.closing(EcoDrivingEnv(schedule, config=config, simulator=simulator)) as env:
        frames = episode(env, steer_and_change if lane_change else steer)
    positions: dict[float, Positions] = {}
    for t, vehicles in enumerate(frames["next", "vehicles"].unbind(0)):
        names = ("vehicle_number", "region_lane", "lane_position_m", "speed_mps")
        columns = [vehicles[name][vehicles["present"]].tolist() for name in names]
        positions[5.5 + 0.5 * t] = {number: state for number, *state in zip(*columns, strict=True)}
    return Expected(simulator, config, frames, positions)


def positions_now(session: ViewSession) -> Positions:
    floats, ints = session.frame["vehicle_floats"], session.frame["vehicle_ints"]
    present = session.frame["vehicle_flags"][:, 0].astype(bool)
    whole = [ints[:, VEHICLE_INTS.index(name)] for name in ("vehicle_number", "region_lane")]
    columns = (*whole, *(floats[:, VEHICLE_FLOATS.index(name)] for name in ("lane_position_m", "speed_mps")))
    return {number: state for number, *state in zip(*(column[present].tolist() for column in columns), strict=True)}


def steered(observation: np.ndarray, config: EnvConfig) -> Any:
    """The action of one vehicle ``[F]``, or of all ``[A, F]``."""
    seen = torch.from_numpy(observation)
    acceleration, lanes = steering(seen).numpy(), choose_lanes(seen).numpy()
    acceleration = acceleration if observation.ndim == 1 else acceleration.squeeze(-1)
    if not config.lane_change:
        return acceleration
    return {"acceleration": acceleration, "lane_change": np.int64(lanes) if observation.ndim == 1 else lanes}


@pytest.mark.parametrize("in_process", [True, False])
def test_joint(expected: Expected, in_process: bool) -> None:
    options: dict[str, Any] = {"in_process": in_process, "simulator": expected.simulator, "disable_env_checker": True}
    made = gymnasium.make("izoo/EcoDriving-v0", contexts=crossing(), config=expected.config, **options)
    with contextlib.closing(made) as env:
        session = env.unwrapped.session  # type: ignore[attr-defined]
        observation, _ = env.reset(seed=SEED)
        for frame in expected.frames.unbind(0):
            assert torch.equal(torch.from_numpy(observation["observation"]), frame["agents", "observation"])
            action = steered(observation["observation"], expected.config)
            assert not expected.config.lane_change or action in env.action_space
            observation, _, _, truncated, info = env.step(action)
            assert positions_now(session) == expected.positions[info["time_s"]]
            assert torch.equal(torch.from_numpy(info["reward"]), frame["next", "agents", "reward"].squeeze(-1))
            ended = frame["next", "agents", "terminated"].squeeze(-1)
            assert info["agent_terminated"].tolist() == ended.tolist()
        assert truncated and info["metrics"]["episode"]["steps"] == expected.config.control_steps
        crossed = expected.frames["next", "metrics", "approach", "crossed"][-1]
        assert info["metrics"]["approach"]["crossed"].tolist() == crossed.tolist()


def test_pettingzoo(expected: Expected) -> None:
    views = pytest.importorskip("izoo.envs.views.pettingzoo")
    made = views.parallel_env(crossing(), expected.config, SEED, in_process=True, simulator=expected.simulator)
    with contextlib.closing(made) as env:
        observations, _ = env.reset()
        while env.agents:
            actions = {agent: steered(observations[agent], expected.config) for agent in env.agents}
            assert all(action in env.action_space(agent) for agent, action in actions.items())
            observations, *_ = env.step(actions)
            assert positions_now(env.session) == expected.positions[env.session.time_s]
        assert env.session.steps == expected.config.control_steps


def test_ego(expected: Expected) -> None:
    """With the ego and the others steered alike, through one ego after another."""
    others = steer_and_change if expected.config.lane_change else steer
    options: dict[str, Any] = {"others": others, "in_process": True, "simulator": expected.simulator}
    with contextlib.closing(izoo.envs.views.gymnasium.EcoDrivingEgo(crossing(), expected.config, **options)) as env:
        observation, info = env.reset(seed=SEED)
        compared = 0
        while info["episode"] == 0:
            ended = False
            while not ended:
                observation, _, terminated, truncated, step = env.step(steered(observation, expected.config))
                assert positions_now(env.session) == expected.positions[step["time_s"]]
                ended, compared = terminated or truncated, compared + 1
            observation, info = env.reset()
        assert compared > 50


@pytest.mark.parametrize(
    ("place", "simulator"),
    [("gymnasium.EcoDrivingJoint", name) for name in SIMULATORS]
    + [("gymnasium.EcoDrivingEgo", "twin"), ("pettingzoo.parallel_env", "twin")],
)
def test_a_fresh_view_can_be_pickled(place: str, simulator: str) -> None:
    """As libraries do to start their workers; the copy plays what the original does."""
    module, _, name = place.partition(".")
    env = getattr(pytest.importorskip(f"izoo.envs.views.{module}"), name)(crossing(), short(), simulator=simulator)
    with contextlib.closing(env), contextlib.closing(pickle.loads(pickle.dumps(env))) as other:
        assert str(env.reset(seed=4)) == str(other.reset(seed=4))
        seen = 0
        for _ in range(30):
            for session in (env.session, other.session):
                session.step(session.commands())
            assert np.array_equal(env.session.frame["observation"], other.session.frame["observation"])
            seen += int(env.session.mask.sum())
        assert seen > 0
        with pytest.raises(IzooError, match=r"whose episode has begun cannot be copied or pickled; do so before reset"):
            pickle.dumps(env)


def test_infos_of_agents_hold_numbers_alone() -> None:
    """Libraries put them into arrays."""
    views = pytest.importorskip("izoo.envs.views.pettingzoo")
    with contextlib.closing(views.parallel_env(crossing(), short(horizon_s=80.0), simulator="twin")) as env:
        _, infos = env.reset(seed=1)
        after = env.step(dict.fromkeys(env.agents))[-1]
        for info in (*infos.values(), *after.values()):
            assert all(isinstance(value, (int, float, np.ndarray)) for value in info.values())
        assert env.plan() == {"context": crossing().name, "episode": 0, "episode_seed": env.session.episode_seed}
