"""The options that say which simulator plays, in training and in validation."""

import dataclasses
from pathlib import Path

import pytest

from izoo import train
from izoo.results.cache import EpisodeCache, baseline_context
from izoo.results.playing import Setup
from izoo.results.rollout import evaluated
from izoo.results.selection import EpisodeSeeds, choose_contexts
from izoo.training import run_folder
from izoo.training.validation_rollout import VALIDATION_SEED, held_out

EASY = ["contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=60"]


@pytest.mark.slow
def test_a_run_on_the_twin_says_so_and_validates_where_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = tmp_path / "run"
    words = [*EASY, "simulator=twin", "num_envs=8", "twin.threads=2", "algo.hidden=[16]", "evaluation.contexts=0"]
    words += ["algo.frames_per_batch=400", "total_frames=800", "validation.every_batches=2", "validation.contexts=1"]
    words += ["validation.simulator=twin"]
    monkeypatch.setenv("IZOO_CACHE_DIR", str(tmp_path / "cache"))
    assert train.main([*words, f"run_dir={run_dir}"]) == 0
    config = run_folder.read_config(run_dir)
    assert (config.simulator, config.num_envs, config.twin.threads) == ("twin", 8, 2)
    assert len((run_dir / "validation.csv").read_text().splitlines()) == 2
    (context,) = choose_contexts(held_out(config.contexts), 1, VALIDATION_SEED)
    env = dataclasses.replace(evaluated(config.env), emit=())
    for seed in EpisodeSeeds(VALIDATION_SEED, config.validation.seeds).of(context):
        played = [
            EpisodeCache(None, Setup({}, env, simulator)).get("human", baseline_context(context), seed) is not None
            for simulator in ("sumo", "twin")
        ]
        assert played == [False, True]
