"""Episodes side by side on the twin are those that are played one after the other."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from izoo.algos.learners.base import MASK
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.errors import IzooError
from izoo.results import evaluate_policy, rollout
from izoo.results.playing import EpisodeFailed
from izoo.results.rollout import Play
from izoo.results.selection import EpisodeSeeds
from tests.results.odd_policies import Bound, Tiring

SHORT = EnvConfig(hold_s=2.0, horizon_s=90.0, warmup_s=20.0, drain_s=300.0)
CONTEXTS = [
    procedural_context(lane_count=lanes, inflow_vph_per_lane=600, approach=approach, adoption=0.5, lane_length_m=150.0)
    for lanes, approach in ((1, "A"), (2, "all"), (3, "C"))
]


def evaluated(executor: str | None, cache: Path, policy: object = "glide", threads: int = 0) -> pd.DataFrame:
    return evaluate_policy(
        policy,  # type: ignore[arg-type]
        CONTEXTS,
        EpisodeSeeds(5, 2),
        SHORT,
        workers=threads,
        progress=False,
        name="driver",
        cache=cache / f"{executor}{threads}",
        executor=executor,
        simulator="twin",
    )


def test_side_by_side_or_one_after_the_other_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They end at different times, and the others go on."""
    monkeypatch.setattr(rollout, "SIDE_BY_SIDE", 4)  # six episodes of each driver: a full block and a part of one
    alone = evaluated("processes", tmp_path)
    for threads in (0, 2):
        beside = evaluated(None, tmp_path, threads=threads)
        pd.testing.assert_frame_equal(beside, alone)
    assert set(beside["policy"]) == {"human", "uncommanded", "driver"} and len(beside) == 3 * 2 * (1 + 4 + 1)
    assert beside.groupby("policy")["cohort_region_co2_g"].sum().nunique() == 3
    assert beside["episode_steps"].nunique() > 2 and (beside["cohort_left"] == beside["cohort"]).all()


def test_nothing_passes_from_one_block_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "SIDE_BY_SIDE", 1)
    tables = [evaluated(executor, tmp_path, Tiring()) for executor in ("processes", "batch")]
    pd.testing.assert_frame_equal(*tables)


def test_recorded_rewards_are_those_of_each_episode_and_kept(tmp_path: Path) -> None:
    plays = [Play("uncommanded", 0, context, seed) for context in CONTEXTS for seed in (1, 2)]
    options = {"simulator": "twin", "record": ("team_reward",), "progress": False}
    batch = list(rollout.rollout(plays, {}, SHORT, side_by_side=6, cache=tmp_path, **options))
    alone = list(rollout.rollout(plays, {}, SHORT, executor="processes", workers=0, cache=tmp_path / "2", **options))
    cached = list(rollout.rollout(plays, {}, SHORT, cache=tmp_path, **options))
    for one, other, third in zip(batch, alone, cached, strict=True):
        assert one.play == other.play and one.rows == other.rows == third.rows
        decisions = -(-one.rows[0]["episode_steps"] // SHORT.hold_steps)
        assert abs(len(one.series["team_reward"]) - decisions) <= 1, "the horizon ends a decision"
        np.testing.assert_array_equal(one.series["team_reward"], other.series["team_reward"])
        np.testing.assert_array_equal(one.series["team_reward"], third.series["team_reward"])


def test_a_policy_is_bound_to_the_environments_that_it_drives(tmp_path: Path) -> None:
    table = evaluated("batch", tmp_path, Bound())
    assert (table.loc[table["policy"] == "driver", "agent_steps"] > 0).any()


def test_what_it_cannot_play_is_refused_and_what_fails_is_named(tmp_path: Path) -> None:
    with pytest.raises(IzooError, match=r"simulator=sumo cannot; choose simulator=twin"):
        evaluate_policy("glide", CONTEXTS[:1], [1], SHORT, executor="batch", progress=False, cache=tmp_path)
    with pytest.raises(IzooError, match=r"draws random numbers; choose executor=processes"):
        evaluated("batch", tmp_path, "random")

    def fails(tensordict: torch.Tensor) -> torch.Tensor:
        raise ValueError(f"no idea for {tensordict[MASK].shape}")

    with pytest.raises(EpisodeFailed, match=r"driver, .* played with it: ValueError: no idea for .*executor=processes"):
        evaluated("batch", tmp_path, fails)
