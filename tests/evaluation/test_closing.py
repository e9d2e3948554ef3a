"""The demand closes in every evaluation: nobody who was due goes missing, and nobody counts twice."""

from __future__ import annotations

import contextlib

import pytest
import torch

from izoo.contexts.context import Context
from izoo.envs.env import EcoDrivingEnv
from izoo.errors import IzooError
from izoo.evaluation.playing import check_closed, run_episode
from izoo.evaluation.policies import as_candidate
from tests.evaluation.conftest import SHORT

SUMS = {"due": 20, "dropped": 1, "waiting": 2, "outside": 3, "early": 4, "entered": 10, "crossed": 7, "unfinished": 3}


def test_a_count_that_closes_passes() -> None:
    check_closed(SUMS, "here")


@pytest.mark.parametrize("name", SUMS)
def test_a_vehicle_more_or_less_anywhere_is_an_error(name: str) -> None:
    for change in (-1, 1):
        with pytest.raises(IzooError, match=r"the demand does not close \(here\)"):
            check_closed({**SUMS, name: SUMS[name] + change}, "here")


def test_an_episode_whose_count_does_not_close_gives_no_rows(easy: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = as_candidate("uncommanded", SHORT).policy
    with contextlib.closing(EcoDrivingEnv(easy, config=SHORT)) as env:
        (row,) = run_episode(env, policy, "uncommanded", easy, 3)
        assert row["due"] > row["entered"] > 0
        metrics = env.reader.metrics

        def one_lost() -> torch.Tensor:
            found = metrics()
            found["approach", "crossed"] = found["approach", "crossed"] - 1
            return found

        monkeypatch.setattr(env.reader, "metrics", one_lost)
        with pytest.raises(IzooError, match="vehicles entered, but crossed"):
            run_episode(env, policy, "uncommanded", easy, 3)
