"""Processes that collect into one batch: each row is what one environment with its own generator would yield."""

import copy
import dataclasses
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.conf.train_options import CollectorConfig, TrainConfig
from izoo.contexts.source import as_schedule
from izoo.envs import EnvConfig
from izoo.errors import IzooError
from izoo.training import collectors
from izoo.training.collectors import BatchSource
from izoo.training.process_collector import worker_env
from tests.envs.worlds import crossing

STEPS = 50  # episodes take 70 steps, so that one ends within the second batch
CONFIG = TrainConfig(
    algo=PPOConfig(hidden=(8,), frames_per_batch=2 * STEPS),
    collector=CollectorConfig(name="multisync"),
    env=EnvConfig(emit=("context",), horizon_s=60.0, num_agents=16),
    num_workers=2,
)
SCHEDULE = as_schedule(crossing(), 0)


@pytest.fixture(autouse=True)
def start_method() -> Iterator[None]:
    """TorchRL chooses one for the whole process."""
    before = multiprocessing.get_start_method(allow_none=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture
def policy() -> TensorDictModuleBase:
    torch.manual_seed(0)
    return make_algorithm(CONFIG.algo, CONFIG.action, CONFIG.env).policy


def learn(policy: TensorDictModuleBase) -> None:
    """Change the weights in place, as an optimiser does."""
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.5)


def alone(worker: int, policy: TensorDictModuleBase) -> list[TensorDict]:
    """Collect what a worker should, in this process: two batches ``[STEPS]``, of old and new weights."""
    env = worker_env(CONFIG, SCHEDULE, (), worker)
    collector = collectors.in_process(env, policy, STEPS)
    try:
        first = next(iter(collector)).clone()
        learn(policy)
        return [first, next(iter(collector)).clone()]
    finally:
        collector.shutdown()


@pytest.mark.slow
def test_environments_that_do_not_begin_say_why_in_one_sentence(
    policy: TensorDictModuleBase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is the one of the process, which has ended; without TorchRL's traceback after it."""
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, num_approaches=1))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(IzooError, match=r"env\.num_approaches is 1; set it to 4 or more\.$"):
        BatchSource(config, policy, SCHEDULE)
    assert not multiprocessing.active_children()
    assert not list(tmp_path.glob("izoo-steps-*"))


@pytest.mark.slow
def test_rows_are_those_of_single_environments(policy: TensorDictModuleBase) -> None:
    expected = [alone(worker, copy.deepcopy(policy)) for worker in range(2)]
    before = torch.get_rng_state()
    source = BatchSource(CONFIG, policy, SCHEDULE)
    assert torch.equal(torch.get_rng_state(), before)
    try:
        first = source.next()
        batches = [first.clone()]
        learn(policy)
        source.synchronise(policy)
        second = source.next()
        batches.append(second)
        assert batches[1]["next", "done"].any() and not torch.equal(*(b["agents", "action"] for b in batches))
        for turn, batch in enumerate(batches):
            assert batch.shape == (2, STEPS)
            for worker in range(2):
                one = expected[worker][turn]
                keys = set(one.keys(True, True))
                assert keys == set(batch.keys(True, True))
                for key in keys:
                    torch.testing.assert_close(batch[key][worker], one[key], rtol=0.0, atol=0.0, msg=str(key))
    finally:
        source.close()


@pytest.mark.slow
@pytest.mark.parametrize("between_batches", [True, False])
def test_a_process_that_dies_is_noticed(between_batches: bool, policy: TensorDictModuleBase) -> None:
    source = BatchSource(CONFIG, policy, SCHEDULE)
    process = source._collector.procs[1]  # type: ignore[union-attr]
    try:
        batch = source.next()
        batch.set(("agents", "advantage"), torch.zeros(2, STEPS, 16))  # algorithms may use it as their own
        assert ("agents", "advantage") not in source.next().keys(True)
        if between_batches:
            os.kill(process.pid, signal.SIGKILL)
            process.join()
        else:
            threading.Timer(0.01, os.kill, (process.pid, signal.SIGKILL)).start()
        begin = time.monotonic()
        with pytest.raises(RuntimeError, match=r"process 1 of 2 that collect has ended \(exit code -9\)"):
            for _ in range(100):
                source.next()
        assert time.monotonic() - begin < 10.0
    finally:
        source.close()
