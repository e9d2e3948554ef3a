"""Batches from the twin do not depend on how many threads act, step and record; torch gets its threads back."""

import contextlib

import pytest
import torch
from tensordict import TensorDictBase

from izoo.algos.learners.registry import make_algorithm
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import RandomSchedule
from izoo.training.collectors import BatchSource

WORDS = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=65", "simulator=twin"),
    *("num_envs=5", "algo.frames_per_batch=200", "twin.surrogate=compiled"),
]


def batches(algo: str, threads: int) -> list[TensorDictBase]:
    """Four batches of forty steps of five environments; episodes end within them."""
    config = compose_config(TrainConfig, [*WORDS, f"algo={algo}", f"twin.threads={threads}", "twin.stagger=false"])
    schedule = RandomSchedule(config.contexts.build(), config.seed)
    torch.manual_seed(0)
    policy = make_algorithm(config.algo, config.action, config.env).policy
    with contextlib.closing(BatchSource(config, policy, schedule)) as source:
        return [source.next().clone() for _ in range(4)]


@pytest.mark.parametrize("algo", ["ppo", "ddpg"])
def test_batches_are_the_same_on_any_number_of_threads(algo: str) -> None:
    one, three = batches(algo, 1), batches(algo, 3)
    assert sum(int(batch["next", "done"].sum()) for batch in one) >= 5
    for batch, other in zip(one, three, strict=True):
        assert batch.batch_size == torch.Size([5, 40]) and batch["agents", "mask"].any()
        assert set(batch.keys(True, True)) == set(other.keys(True, True))
        assert all(torch.equal(batch[key], other[key]) for key in batch.keys(True, True))
        onward = batch["agents", "observation"][:, 1:], batch["next", "agents", "observation"][:, :-1]
        going_on = ~batch["next", "done"][:, :-1, 0]
        assert torch.equal(onward[0][going_on], onward[1][going_on])
