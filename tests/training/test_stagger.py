"""Environments on the twin that begin at random phases of their first episodes."""

import contextlib

import torch

from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.base import EPISODES
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import RandomSchedule
from izoo.envs.mdp.frame import TOTALS
from izoo.training.batch_statistics import episode_stats
from izoo.training.collectors import BatchSource
from izoo.training.environments import random_phases

WORDS = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=65", "env.hold_s=2", "simulator=twin"),
    *("num_envs=4", "twin.threads=1", "algo.frames_per_batch=40"),
]


def test_phases_are_spread_over_the_episode() -> None:
    assert sorted(random_phases(4, 100, 1)) == [0, 25, 50, 75]
    assert sorted(random_phases(7, 3, 2)) == [0, 0, 0, 1, 1, 2, 2]
    assert random_phases(50, 100, 1) != random_phases(50, 100, 2)


def test_every_batch_sees_all_times_and_partial_episodes_are_not_scored() -> None:
    config = compose_config(TrainConfig, WORDS)
    schedule = RandomSchedule(config.contexts.build(), config.seed)
    with contextlib.closing(BatchSource(config, UncommandedDriver(), schedule)) as source:
        batches = [source.next().clone() for _ in range(4)]
    # A decision takes 4 steps, an episode 20 decisions.
    assert sorted((batches[0][TOTALS][:, 0, 0] / 4).tolist()) == [0, 5, 10, 15]
    ended = [int(batch["next", "done"].sum()) for batch in batches]
    assert ended == [2, 2, 2, 2], "they do not end together"
    numbers = torch.cat([batch["next", EPISODES][batch["next", "done"].squeeze(-1)][:, 0] for batch in batches])
    assert sorted(numbers.tolist()) == list(range(8))
    assert [int(episode_stats(batch, 4)["episodes"]) for batch in batches] == ended
    scored = ["emission_g_per_vehicle" in episode_stats(batch, 4) for batch in batches]
    assert scored == [False, False, True, True]
