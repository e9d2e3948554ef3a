"""A context and a seed determine an episode, whatever process, worker, start method or history plays it."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import MultiSyncCollector

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, RandomSchedule
from izoo.envs import EcoDrivingEnv, SumoParallelEnv
from izoo.envs.sumo.session import SUMO_VERSION
from tests.envs.worlds import crossing, digest, play, play_on, short, steer, steering

SEED = 5
GOLDEN: dict[str, dict[str, str]] = {
    "1.28.0": {
        "procedural": "39de9d2b5b6247aa",
        "procedural electric": "92521e5af192b1f4",
        "dataset approach": "a3d6348d5a0ab612",
        "dataset intersection": "baf1454ea4124d6d",
    }
}
"""Digests of fixed episodes per SUMO version. A change here changes what a seed means: say so in the release notes."""


def own_context(name: str) -> Context:
    return crossing(engine="electric" if "electric" in name else "combustion")


@functools.cache
def play_alone(context: Context, seed: int = SEED) -> str:
    with contextlib.closing(EcoDrivingEnv(context, config=short())) as env:
        start = env.reset(context=context, seed=seed)
        return digest(play(env, env.config.control_steps, steer, start))


@pytest.mark.parametrize("name", ["procedural", "procedural electric"])
def test_golden(name: str) -> None:
    assert play_alone(own_context(name)) == GOLDEN[SUMO_VERSION][name]


@pytest.mark.parametrize("name", ["dataset approach", "dataset intersection"])
def test_golden_on_measured_intersections(dataset: ContextList, name: str) -> None:
    context = max(dataset, key=lambda context: context.flow_vph_per_lane(context.approach or "A"))
    if "intersection" in name:
        context = context.replace(approach=None)
    assert play_alone(context) == GOLDEN[SUMO_VERSION][name]


def test_another_seed_is_another_episode() -> None:
    """The digest can differ."""
    assert play_alone(crossing(), SEED + 1) != play_alone(crossing())


@pytest.mark.slow
def test_same_in_another_process() -> None:
    program = "from tests.envs.test_determinism import *; print(play_alone(crossing()))"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert output.stdout.split()[-1] == play_alone(crossing())


def test_same_whatever_was_played_before() -> None:
    """libsumo is re-used from episode to episode: nothing of another context may linger."""
    alone = play_alone(crossing())
    with contextlib.closing(EcoDrivingEnv(crossing(), config=short())) as env:
        for other in (crossing(lane_count=1, phase_count=1), crossing(adoption=1.0)):
            play(env, 40, steer, env.reset(context=other, seed=1))
        again = digest(play(env, env.config.control_steps, steer, env.reset(context=crossing(), seed=SEED)))
    assert again == alone


# -- several workers ---------------------------------------------------------------------------------------------------

EPISODES = 4


def schedule() -> RandomSchedule:
    return RandomSchedule(ContextList([crossing(), crossing(lane_count=1, adoption=1.0)]), SEED)


@pytest.fixture(scope="module")
def expected() -> dict[int, str]:
    """Digest of every numbered episode, played by a single environment."""
    with contextlib.closing(EcoDrivingEnv(schedule(), config=short())) as env:
        digests = by_episode(play(env, EPISODES * env.config.control_steps).unsqueeze(0))
    assert len(set(digests.values())) == EPISODES
    return digests


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


@pytest.mark.parametrize(
    ("workers", "changes"),
    [(2, {"recycle_episodes": 1}), *(pytest.param(count, {}, marks=pytest.mark.slow) for count in (1, 4))],
)
def test_same_for_any_number_of_workers(expected: dict[int, str], workers: int, changes: dict[str, Any]) -> None:
    """And before and after a worker process has been replaced on schedule."""
    with contextlib.closing(SumoParallelEnv(workers, schedule(), config=short(**changes))) as env:
        processes = set()
        frames, state = [], env.reset()
        for _ in range(EPISODES // workers):
            processes |= {worker.process.pid for worker in env.backend._workers if worker is not None}
            part, state = play_on(env, env.config.control_steps, steer, state)
            frames.append(part)
    assert by_episode(torch.cat(frames, -1)) == expected
    assert len(processes) == (EPISODES if changes else workers)


def make_env(worker: int) -> EcoDrivingEnv:
    torch.set_num_threads(1)
    return EcoDrivingEnv(schedule(), config=short(), worker=worker, num_workers=2)


@pytest.fixture
def start_method(request: pytest.FixtureRequest) -> Iterator[str]:
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method(request.param, force=True)
    yield request.param
    multiprocessing.set_start_method(before, force=True)


@pytest.mark.parametrize("start_method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)], indirect=True)
def test_same_in_collector_processes(expected: dict[int, str], start_method: str) -> None:
    policy = TensorDictModule(steering, in_keys=[("agents", "observation")], out_keys=[("agents", "action")])
    steps = short().control_steps
    collector = MultiSyncCollector(
        [functools.partial(make_env, worker) for worker in range(2)],
        policy,
        frames_per_batch=2 * steps,
        total_frames=EPISODES * steps,
        cat_results="stack",
    )
    try:
        found: dict[int, str] = {}
        for batch in collector:
            found |= by_episode(batch)
    finally:
        collector.shutdown()
    assert found == expected
