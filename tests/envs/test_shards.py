"""Environments of several that share one schedule, as in other processes: together they play each episode once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest

from izoo.envs import EcoDrivingEnv, SumoParallelEnv, TwinEnv
from izoo.envs.env import EcoDrivingBase
from izoo.errors import IzooError
from tests.envs.worlds import crossing, short

MAKERS = {
    "sumo": lambda count, **shards: SumoParallelEnv(count, crossing(), config=short(), **shards),
    "twin": lambda count, **shards: TwinEnv(count, crossing(), config=short(), **shards),
}


def episodes(env: EcoDrivingBase, resets: int) -> list[tuple[int, int]]:
    """Episode and seed of each environment in each of so many resets."""
    with contextlib.closing(env):
        contexts = [env.reset()["context"] for _ in range(resets)]
    return [
        pair for c in contexts for pair in zip(c["episode"].view(-1).tolist(), c["seed"].view(-1).tolist(), strict=True)
    ]


@pytest.mark.parametrize("simulator", [pytest.param("sumo", marks=pytest.mark.slow), "twin"])
def test_shards_share_the_episodes(simulator: str) -> None:
    make: Callable[..., EcoDrivingBase] = MAKERS[simulator]
    whole = episodes(make(4), resets=2)
    parts = [episodes(make(2, shard=shard, num_shards=2), resets=2) for shard in range(2)]
    assert [episode for episode, _ in parts[1]] == [2, 3, 6, 7]
    assert sorted(parts[0] + parts[1]) == sorted(whole)


def test_a_single_environment_says_which_it_is_as_well() -> None:
    with pytest.raises(IzooError, match=r"num_workers is 4, and .*; give worker=k, too"):
        EcoDrivingEnv(crossing(), config=short(), num_workers=4)


WRONG = ({"shard": 2, "num_shards": 2}, {"shard": -1}, {"num_shards": 0}, {"num_shards": 2}, {"shard": 1.5})


@pytest.mark.parametrize("simulator", MAKERS)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_shard_that_is_not_there_is_refused(simulator: str, wrong: dict[str, int]) -> None:
    with pytest.raises(IzooError, match=next(iter(wrong)) if len(wrong) == 1 else "shard"):
        MAKERS[simulator](2, **wrong)
