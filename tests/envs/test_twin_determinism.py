"""The same episode on the twin for any number of environments and threads, with every surrogate."""

from __future__ import annotations

import contextlib

import pytest
import torch

from izoo.envs import TwinEnv
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.twin.runtime.batched_emissions import GROUP
from tests.envs.conftest import MakeTwin
from tests.envs.test_determinism import by_episode, schedule
from tests.envs.worlds import play, short, steer

EPISODES = 4
NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
GOLDEN = "dc986a0f8ed211e7"
"""Digest of a fixed episode on the twin."""


@pytest.fixture(scope="module")
def expected() -> dict[int, str]:
    """Digest of every numbered episode, played by a single environment."""
    with contextlib.closing(TwinEnv(1, schedule(), config=short(), threads=1)) as env:
        digests = by_episode(play(env, EPISODES * env.config.control_steps))
    assert len(set(digests.values())) == EPISODES
    return digests


@pytest.mark.parametrize(("num_envs", "threads"), [(2, 1), (4, 1), (4, 2), (4, 3)])
def test_same_for_any_number_of_environments_and_threads(
    make_twin: MakeTwin, expected: dict[int, str], num_envs: int, threads: int
) -> None:
    env = make_twin(num_envs, schedule(), threads=threads)
    assert by_episode(play(env, EPISODES // num_envs * env.config.control_steps)) == expected


def test_same_whatever_was_played_before(make_twin: MakeTwin, expected: dict[int, str]) -> None:
    """Episodes in another order, begun anew in the middle."""
    env = make_twin(2, schedule())
    env.reset()
    state = env.reset(episode=[3, 1])
    for _ in range(7):
        _, state = env.step_and_maybe_reset(steer(state))
    frames = play(env, env.config.control_steps, start=env.reset(episode=[2, 0]))
    assert by_episode(frames) == {number: expected[number] for number in (0, 2)}


def test_golden(expected: dict[int, str]) -> None:
    """A change here changes what a seed means on the twin: say so in the release notes."""
    assert expected[0] == GOLDEN


@pytest.mark.parametrize("hold_s", [None, 2.0])
@pytest.mark.parametrize("other", ["compiled", pytest.param("cuda", marks=NEEDS_GPU)])
def test_the_surrogates_agree(make_twin: MakeTwin, hold_s: float | None, other: str) -> None:
    """With torch all environments take a step together, with compiled code a few play a decision to the end."""
    config = short(hold_s=hold_s, emit=EMIT_GROUPS)
    parts = [
        play(make_twin(3, surrogate=name, config=config), config.decisions + 5)["next"] for name in ("torch", other)
    ]
    for key in (("vehicles", "emission_g"), ("agents", "reward"), ("metrics", "approach", "emission_g")):
        assert torch.allclose(parts[0][key], parts[1][key], rtol=1e-4, atol=1e-4), key
    for key in (("agents", "observation"), ("agents", "mask"), ("vehicles", "speed_mps"), ("agents", "vehicle")):
        assert torch.equal(parts[0][key], parts[1][key]), key
    assert parts[0]["done"].any() and parts[0]["vehicles", "emission_g"].sum() > 1.0


@pytest.mark.parametrize(("num_envs", "threads"), [(GROUP + 3, 1), (3 * GROUP, 2)])
def test_the_compiled_surrogate_groups_environments_without_a_trace(
    make_twin: MakeTwin, num_envs: int, threads: int
) -> None:
    """Those of a group are in other phases of their episodes, and have played as many decisions to get there."""
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
