"""Every preset that learns by gradients does so from real episodes, with all its hyper-parameters but the sizes."""

import dataclasses
import math
from pathlib import Path

import pytest

from izoo import train
from izoo.algos.learners.registry import choices, preset
from izoo.training import run_folder
from izoo.training.loggers import MetricsTable

SMALLER = {"frames_per_batch": 160, "learning_starts": 0, "random_frames": 0, "epochs": 1}
OPTIONS = {choice: {field.name for field in dataclasses.fields(preset(choice))} for choice in choices()}
WORDS = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=60", "env.warmup_s=20", "env.hold_s=2"),
    *("simulator=twin", "num_envs=4", "twin.threads=1", "twin.compare_every=0"),
    *("total_frames=160", "evaluation.contexts=0"),
]


LEARNING = [choice for choice, options in OPTIONS.items() if "frames_per_batch" in options]
QUICK = ("ppo_vehicle", "mappo", "gcrl_paper", "ddpg", "td3")
"""One of each learner; the slow tests have the others."""


@pytest.mark.parametrize(
    "choice", [pytest.param(choice, marks=() if choice in QUICK else pytest.mark.slow) for choice in LEARNING]
)
def test_every_preset_learns_from_a_batch(choice: str, tmp_path: Path) -> None:
    """So does ``gcrl_paper``, whose graph has no bound of distance: rows must be finite all the same."""
    run_dir = tmp_path / "run"
    smaller = [f"algo.{name}={value}" for name, value in SMALLER.items() if name in OPTIONS[choice]]
    assert train.main([*WORDS, f"algo={choice}", *smaller, f"run_dir={run_dir}"]) == 0
    (row,) = MetricsTable.read(run_dir / run_folder.METRICS_FILE).rows
    losses = {name: float(value) for name, value in row.items() if name.startswith("loss_")}
    assert len(losses) >= 2, "of the policy and of the values"
    assert all(map(math.isfinite, losses.values()))
    assert 0.0 < float(row["decisions"]) <= 160.0 * float(row["agents"]) + 1e-3, "whatever learns"
