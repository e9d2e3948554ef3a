"""Searches learn from what teams are paid, so their batches hold no observations; and they learn the same without."""

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from izoo import train
from izoo.algos.learners.base import ACTION, MASK, OBSERVATION, REWARD
from izoo.algos.learners.cmaes import CMAES
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.training import checkpoint
from izoo.training.learner import Learner

WORDS = (
    *("contexts=pcg", "contexts.adoption=1.0", "env.horizon_s=60", "env.warmup_s=20"),
    *("env.hold_s=2", "env.num_agents=16", "env.reward=fuel_team", "simulator=twin", "num_envs=8", "twin.threads=1"),
    *("algo.population=4", "total_frames=320", "evaluation.contexts=0", "validation.every_batches=0"),
)
SEARCHES = {
    "glide_search": (
        *("algo=glide_search", "action=direct", "env.neighbours=[leader,follower]", "twin.compare_every=0"),
        "env.observed=[adoption,green_s,red_s,lane_count,lane_length_m,speed_limit_mps]",
    ),
    "cmaes": ("algo=cmaes", "action=advise", "twin.compare_every=2"),
}


@pytest.mark.parametrize("name", ["glide_search", pytest.param("cmaes", marks=pytest.mark.slow)])
def test_a_search_keeps_no_observations_and_finds_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IZOO_CACHE_DIR", str(tmp_path / "cache"))
    batches: list[TensorDictBase] = []
    update = CMAES.update

    def looked_at(self: CMAES, batch: TensorDictBase, progress: float) -> dict[str, float]:
        batches.append(batch)
        return update(self, batch, progress)

    monkeypatch.setattr(CMAES, "update", looked_at)
    found: dict[str, Any] = {}
    for kept in ("lean", "whole"):
        if kept == "whole":
            monkeypatch.setattr(Learner, "reads", None)
        batches.clear()
        assert train.main([*WORDS, *SEARCHES[name], f"run_dir={tmp_path / kept}"]) == 0
        state = checkpoint.load(checkpoint.find(tmp_path / kept))
        found[kept] = state["algorithm"]
        own = [line.split(",") for line in (tmp_path / kept / "metrics.csv").read_text().splitlines()]
        timed = {k for k, column in enumerate(own[0]) if column.endswith("_s")} | {own[0].index("seconds")}
        found[f"{kept} rows"] = [[value for k, value in enumerate(row) if k not in timed] for row in own]
        assert len(batches) == 2
        keys = set(batches[-1].keys(True, True))
        assert {MASK, ("next", TEAM_REWARD), ("next", "done"), ("next", *REWARD)} <= keys
        assert (OBSERVATION in keys, ("next", *OBSERVATION) in keys) == (kept == "whole",) * 2
        assert (ACTION in keys) == (kept == "whole" or name == "cmaes")
        found[f"{kept} bytes"] = sum(value.nbytes for value in batches[-1].values(True, True))
    told = found["lean"]["returns"]  # NaN where no context is of a kind
    torch.testing.assert_close(told, found["whole"]["returns"], rtol=0.0, atol=0.0, equal_nan=True)
    assert len(told) == 2 and told.nan_to_num().std() > 0.0
    for key, tensor in found["lean"]["policy"].items():
        assert torch.equal(tensor, found["whole"]["policy"][key])
    assert found["lean rows"] == found["whole rows"]
    assert found["lean bytes"] < 0.4 * found["whole bytes"]
