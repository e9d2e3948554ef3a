"""The PettingZoo view: PettingZoo's own tests, agents that enter and leave, the state, and what is refused."""

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from izoo.errors import IzooError
from tests.envs.worlds import crossing, short

pytest.importorskip("pettingzoo")
from pettingzoo.test import parallel_api_test, parallel_seed_test
from pettingzoo.utils.conversions import parallel_to_aec

from izoo.envs.mdp.frame import CONTEXT_VALUES
from izoo.envs.views.pettingzoo import VEHICLE_COLUMNS, EcoDrivingParallel, parallel_env

Frames = list[tuple[list[str], tuple[Any, ...]]]


@pytest.fixture(scope="module")
def env() -> Iterator[EcoDrivingParallel]:
    env = parallel_env(crossing(), short(horizon_s=80.0))
    yield env
    env.close()


def forward(env: EcoDrivingParallel) -> dict[str, np.ndarray]:
    return {agent: np.full(1, 2.0, np.float32) for agent in env.agents}


def play(env: EcoDrivingParallel, seed: int = 0) -> Frames:
    """Play an episode; return the agents before and the results of every step."""
    env.reset(seed=seed)
    frames = []
    while env.agents:
        agents = env.agents
        frames.append((agents, env.step(forward(env))))
    return frames


@pytest.mark.filterwarnings("ignore:unknown reset option", "ignore:No agents present")
def test_pettingzoos_own_tests(env: EcoDrivingParallel) -> None:
    parallel_api_test(env, 60)
    parallel_seed_test(functools.partial(parallel_env, crossing(), short(horizon_s=25.0)))
    with contextlib.closing(parallel_env(crossing(), short(lane_change=True), in_process=True)) as changing:
        parallel_api_test(changing, 30)


def test_agents_appear_and_leave(env: EcoDrivingParallel) -> None:
    frames = play(env)
    seen: set[str] = set()
    left: set[str] = set()
    for before, (observations, rewards, terminated, truncated, infos) in frames:
        assert not left & set(before)
        entered = observations.keys() - set(before)
        assert list(observations) == list(rewards) == list(terminated) == list(truncated) == list(infos)
        assert set(before) <= observations.keys()
        assert not entered & seen and not any(rewards[agent] for agent in entered)
        for agent in observations:
            assert observations[agent].any() != terminated[agent]
            assert not (terminated[agent] and truncated[agent])
        seen |= observations.keys()
        left |= {agent for agent, gone in terminated.items() if gone}
    assert len(left) >= 3 and len(seen) > len(frames[0][0]) + 5
    *_, truncated, _ = frames[-1][1]
    assert sum(truncated.values()) >= 3 and not any(any(frame[3].values()) for _, frame in frames[:-1])


def test_a_reset_gives_agents() -> None:
    """Also after episodes in which by chance no CV enters; PettingZoo's conversion divides by their number."""
    rare = crossing(inflow_vph_per_lane=100.0, adoption=0.05)
    with contextlib.closing(parallel_env(rare, short(horizon_s=40.0), simulator="twin")) as env:
        skipped = 0
        for seed in range(3):
            _, infos = env.reset(seed=seed)
            assert env.agents and set(infos) == set(env.agents)
            skipped += infos[env.agents[0]]["episode"]
            _, infos = env.reset(options={"context": rare, "episode_seed": 10 * seed})
            assert infos[env.agents[0]]["episode"] == -1 and infos[env.agents[0]]["episode_seed"] >= 10 * seed
        assert skipped > 0
        turns = parallel_to_aec(env)
        turns.reset(seed=0)
        assert turns.agent_selection in turns.agents
        with pytest.raises(IzooError, match=r"none can: the adoption of .* is 0"):
            env.reset(options={"context": rare.replace(adoption=0.0)})


@pytest.mark.filterwarnings("ignore:CVs beyond the")
def test_vehicles_beyond_max_vehicles_are_uncommanded() -> None:
    with contextlib.closing(parallel_env(crossing(), short(), max_vehicles=8, simulator="twin")) as env:
        frames = play(env)
        assert {agent for before, _ in frames for agent in before} <= set(env.possible_agents)
        assert len(env.possible_agents) == 8
    config = short(warmup_s=50.0, horizon_s=80.0)
    with (
        contextlib.closing(parallel_env(crossing(), config, simulator="twin", max_vehicles=1)) as env,
        pytest.raises(IzooError, match="beyond the 1 possible agents; raise max_vehicl"),
    ):
        env.reset(seed=0)


def test_agents_is_empty_only_at_the_end() -> None:
    """So that loops over ``while env.agents`` play the whole episode in light traffic too."""
    with contextlib.closing(
        parallel_env(crossing(inflow_vph_per_lane=100.0, adoption=0.3), short(horizon_s=200.0), in_process=True)
    ) as env:
        frames = play(env, seed=4)
        assert frames and env.session.over and env.session.time_s == 200.0
        assert len(frames) < env.config.control_steps
        assert env.step({}) == ({}, {}, {}, {}, {})
        assert env.metrics()["episode"]["steps"] == env.config.control_steps


def test_state_holds_every_vehicle(env: EcoDrivingParallel) -> None:
    env.reset(seed=2)
    for _ in range(60):
        env.step(forward(env))
    state, layout = env.state(), env.state_layout
    assert state.shape == env.state_space.shape and state.dtype == np.float32
    assert sum(part.stop - part.start for part in layout.values()) == len(state)
    vehicles = state[layout["vehicles"]].reshape(-1, len(VEHICLE_COLUMNS))
    column = {name: vehicles[:, index] for index, name in enumerate(VEHICLE_COLUMNS)}
    present, is_cv = column["present"] > 0, column["is_cv"] > 0
    assert {f"cv_{number:.0f}" for number in column["vehicle_number"][present & is_cv]} == set(env.agents)
    assert (present & ~is_cv).any() and not vehicles[~present].any()
    speed = column["speed_mps"][present & is_cv]
    own = env.observation_names.index("speed")
    observed = [env.session.frame["observation"][slot, own] * 15.0 for slot in env._slot.values()]
    np.testing.assert_allclose(sorted(observed), sorted(speed), rtol=1e-5)
    assert state[layout["context"]][CONTEXT_VALUES.index("adoption")] == 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda actions, agent: actions | {agent: np.zeros(2, np.float32)}, r"the action of cv_\d+ is .*shape \[1\]"),
        (lambda actions, agent: actions | {agent: np.array([1])}, "int64.*floating-point"),
        (lambda actions, agent: actions | {"cv_9999": np.zeros(1)}, "cv_9999 cannot act.*env.agents"),
        (lambda actions, agent: {}, r"actions lacks cv_\d+"),
    ],
)
def test_bad_actions_are_refused(env: EcoDrivingParallel, change: Any, message: str) -> None:
    env.reset(seed=1)
    with pytest.raises(IzooError, match=message):
        env.step(change(forward(env), env.agents[0]))
    env.step(forward(env) | {env.agents[0]: None})


def test_step_before_reset_is_refused() -> None:
    env = parallel_env(crossing(), short())
    for call in (lambda: env.step({}), env.state):
        with pytest.raises(IzooError, match=r"before reset\(\); call reset\(\) first"):
            call()
    env.reset(seed=1)
    with pytest.raises(IzooError, match="an episode that has ended"):
        env.metrics()
    env.close()
