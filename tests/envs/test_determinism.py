"""A context and a seed determine an episode, for any number of processes, environments and threads, and any history."""

import contextlib
import functools
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, RandomSchedule
from izoo.envs import EcoDrivingEnv, SumoParallelEnv, TwinEnv
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.twin.runtime.batched_emissions import GROUP
from tests.envs.conftest import Make, MakeTwin
from tests.envs.worlds import crossing, digest, play, play_on, short, steer

SEED, EPISODES = 5, 4
NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@functools.cache
def play_alone(context: Context, seed: int = SEED) -> str:
    with contextlib.closing(EcoDrivingEnv(context, config=short())) as env:
        start = env.reset(context=context, seed=seed)
        return digest(play(env, env.config.control_steps, steer, start))


def test_another_seed_gives_another_episode() -> None:
    assert play_alone(crossing(), SEED + 1) != play_alone(crossing())


def test_same_after_other_episodes_on_sumo() -> None:
    """libsumo is re-used from episode to episode."""
    with contextlib.closing(EcoDrivingEnv(crossing(), config=short())) as env:
        for other in (crossing(lane_count=1, phase_count=1), crossing(adoption=1.0)):
            play(env, 40, steer, env.reset(context=other, seed=1))
        again = digest(play(env, env.config.control_steps, steer, env.reset(context=crossing(), seed=SEED)))
    assert again == play_alone(crossing())


def schedule() -> RandomSchedule:
    return RandomSchedule(ContextList([crossing(), crossing(lane_count=1, adoption=1.0)]), SEED)


def by_episode(frames: TensorDict) -> dict[int, str]:
    """Return the digest of every whole episode in ``[N, T]`` frames."""
    length = short().control_steps
    found = {}
    for row in frames.unbind(0):
        for begin in range(0, row.shape[0] - length + 1, length):
            part = row[begin : begin + length]
            numbers = part["context", "episode"].unique()
            assert len(numbers) == 1 and part["next", "done"][-1].all() and not part["next", "done"][:-1].any()
            found[int(numbers)] = digest(part)
    return found


@functools.cache
def expected(simulator: str) -> dict[int, str]:
    """Digest of every numbered episode, played by a single environment."""
    make = functools.partial(TwinEnv, 1, threads=1) if simulator == "twin" else functools.partial(SumoParallelEnv, 1)
    with contextlib.closing(make(contexts=schedule(), config=short())) as env:
        digests = by_episode(play(env, EPISODES * env.config.control_steps))
    assert len(set(digests.values())) == EPISODES
    return digests


@pytest.mark.parametrize(
    ("workers", "changes"),
    [(2, {"recycle_episodes": 1}), pytest.param(4, {}, marks=pytest.mark.slow)],
)
def test_same_for_any_number_of_workers(make: Make, workers: int, changes: dict[str, Any]) -> None:
    """Also before and after a worker process has been replaced on schedule."""
    env = make("sumo", workers, schedule(), config=short(**changes))
    processes = set()
    frames, state = [], env.reset()
    for _ in range(EPISODES // workers):
        processes |= {worker.process.pid for worker in env.backend._workers if worker is not None}
        part, state = play_on(env, env.config.control_steps, steer, state)
        frames.append(part)
    assert by_episode(torch.cat(frames, -1)) == expected("sumo")
    assert len(processes) == (EPISODES if changes else workers)


@pytest.mark.parametrize(("num_envs", "threads"), [(2, 1), (4, 2), (4, 3)])
def test_same_for_any_number_of_environments_and_threads(make_twin: MakeTwin, num_envs: int, threads: int) -> None:
    env = make_twin(num_envs, schedule(), threads=threads)
    found = by_episode(play(env, EPISODES // num_envs * env.config.control_steps))
    assert found == expected("twin")


def test_same_after_other_episodes_on_the_twin(make_twin: MakeTwin) -> None:
    """Episodes in another order, begun anew in the middle."""
    env = make_twin(2, schedule())
    env.reset()
    play(env, 7, start=env.reset(episode=[3, 1]))
    frames = play(env, env.config.control_steps, start=env.reset(episode=[2, 0]))
    assert by_episode(frames) == {number: expected("twin")[number] for number in (0, 2)}


@pytest.mark.parametrize("hold_s", [None, 2.0])
@pytest.mark.parametrize("other", ["compiled", pytest.param("cuda", marks=NEEDS_GPU)])
def test_the_surrogates_agree(make_twin: MakeTwin, hold_s: float | None, other: str) -> None:
    config = short(hold_s=hold_s, emit=EMIT_GROUPS)
    envs = (make_twin(3, surrogate=name, config=config) for name in ("torch", other))
    parts = [play(env, config.decisions + 5)["next"] for env in envs]
    for key in (("vehicles", "emission_g"), ("agents", "reward"), ("metrics", "approach", "emission_g")):
        assert torch.allclose(parts[0][key], parts[1][key], rtol=1e-4, atol=1e-4), key
    for key in (("agents", "observation"), ("agents", "mask"), ("vehicles", "speed_mps"), ("agents", "vehicle")):
        assert torch.equal(parts[0][key], parts[1][key]), key
    assert parts[0]["done"].any() and parts[0]["vehicles", "emission_g"].sum() > 1.0


@pytest.mark.parametrize(("num_envs", "threads"), [(GROUP + 3, 1), pytest.param(3 * GROUP, 2, marks=pytest.mark.slow)])
def test_environments_of_a_group_do_not_affect_each_other(make_twin: MakeTwin, num_envs: int, threads: int) -> None:
    """With the compiled surrogate, in different phases of their episodes."""
    config, phases = short(hold_s=2.0), [7 * index % 11 for index in range(num_envs)]
    envs = [make_twin(num_envs, schedule(), threads=threads, surrogate="compiled", config=config)]
    envs += [make_twin(1, schedule(), surrogate="compiled", config=config) for _ in range(num_envs)]
    together, alone = envs[0], envs[1:]
    together.reset(episode=[index % EPISODES for index in range(num_envs)])
    state = together.advance(phases)
    states = []
    for index, env in enumerate(alone):
        env.reset(episode=index % EPISODES)
        states.append(env.advance([phases[index]]))
    assert config.decisions - max(phases) > 3
    for _ in range(config.decisions - max(phases)):
        following = together.step_lean(steer(state))
        for index, env in enumerate(alone):
            one = env.step_lean(steer(states[index]))
            for key, value in one.items(True, True):
                assert torch.equal(following.get(key)[index], value[0]), (index, key)
            states[index] = one.exclude(("agents", "reward"))
        state = following.exclude(("agents", "reward"))
    assert following["done"].any() and not following["done"].all()
