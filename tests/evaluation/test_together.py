"""Episodes side by side on the twin are those that are played one after the other."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
import torch

from izoo.algos.base import MASK
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.errors import IzooError
from izoo.evaluation import together
from izoo.evaluation.processes import EpisodeFailed
from izoo.evaluation.runner import evaluate_policy
from izoo.evaluation.selection import EpisodeSeeds
from tests.evaluation.odd_policies import Tiring

SHORT = EnvConfig(hold_s=2.0, horizon_s=90.0, warmup_s=20.0)
CONTEXTS = [
    procedural_context(lane_count=lanes, inflow_vph_per_lane=600, approach=approach, adoption=0.5, lane_length_m=150.0)
    for lanes, approach in ((1, "A"), (2, "all"), (3, "C"))
]


def evaluated(executor: str, cache: Path, policy: object = "glide", threads: int = 0) -> pd.DataFrame:
    return evaluate_policy(
        policy,  # type: ignore[arg-type]
        CONTEXTS,
        EpisodeSeeds(5, 2),
        SHORT,
        num_workers=threads,
        progress=False,
        name="driver",
        cache=cache / f"{executor}{threads}",
        executor=executor,
        simulator="twin",
    )


def test_side_by_side_or_one_after_the_other_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together, "MOST", 4)  # six episodes of each driver: a full block and a part of one
    alone = evaluated("processes", tmp_path)
    order = ["policy", "context_hash", "seed", "approach"]
    for threads in (0, 2):
        beside = evaluated("together", tmp_path, threads=threads)
        pd.testing.assert_frame_equal(*(table.sort_values(order, ignore_index=True) for table in (beside, alone)))
    assert set(beside["policy"]) == {"human", "uncommanded", "driver"} and len(beside) == 3 * 2 * (1 + 4 + 1)
    means = beside.groupby("policy")["emission_g"].sum()
    assert means.nunique() == 3


def test_nothing_passes_from_one_block_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together, "MOST", 1)
    tables = [evaluated(executor, tmp_path, Tiring()) for executor in ("processes", "together")]
    order = ["policy", "context_hash", "seed", "approach"]
    pd.testing.assert_frame_equal(*(table.sort_values(order, ignore_index=True) for table in tables))


def test_what_it_cannot_play_is_refused_and_what_fails_is_named(tmp_path: Path) -> None:
    with pytest.raises(IzooError, match=r"but simulator is sumo; choose simulator=twin"):
        evaluate_policy("glide", CONTEXTS[:1], [1], SHORT, executor="together", progress=False, cache=tmp_path)
    with pytest.raises(IzooError, match=r"draws random numbers; choose executor=processes"):
        evaluated("together", tmp_path, "random")

    def fails(tensordict: torch.Tensor) -> torch.Tensor:
        raise ValueError(f"no idea for {tensordict[MASK].shape}")

    with pytest.raises(EpisodeFailed, match=r"driver, .* beside it: ValueError: no idea for .*\[6, 64\]"):
        evaluated("together", tmp_path, fails)
