"""Training runs in processes of their own: real ones, on the twin."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from izoo.benchmarks.campaign.parallel_training import ParallelRuns
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.training import checkpoint, run_folder
from izoo.training.loggers import MetricsTable

WORDS = [
    *("contexts=pcg_easy", "env.horizon_s=100", "simulator=twin", "num_envs=2", "twin.surrogate=compiled"),
    *("twin.compare_every=0", "evaluation.contexts=0", "validation.every_batches=0", "algo.hidden=[16]"),
    *("algo.frames_per_batch=100", "algo.epochs=1", "checkpoint.every_batches=1"),
]
PATIENCE_S = 120.0


def order(folder: Path, name: str, frames: int, *more: str) -> tuple[TrainConfig, Path]:
    run_dir = folder / name
    words = [*WORDS, f"total_frames={frames}", f"run_dir={run_dir}", *more]
    return compose_config(TrainConfig, words), folder / f"{name}.log"


def wait_until(true: Callable[[], object], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, what
        time.sleep(0.05)


@pytest.mark.slow
def test_a_run_that_fails_says_why_and_the_others_close_in_good_order(tmp_path: Path) -> None:
    long = tmp_path / "long"
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "something").touch()
    failed = pytest.raises(IzooError, match=r"run failed: .*taken.* is not empty.* \(all that it said: .*taken\.log\)")
    with failed, ParallelRuns(2) as beside:
        beside.begin("long", *order(tmp_path, "long", 10**8))
        wait_until(lambda: MetricsTable.read(long / run_folder.METRICS_FILE).rows, "the first batch")
        beside.begin("taken", *order(tmp_path, "taken", 200))
        wait_until(lambda: beside.is_done("taken"), "the run that cannot begin")
    assert "go on with: python -m izoo.train resume=" in (tmp_path / "long.log").read_text()
    learned, _ = MetricsTable.read(long / run_folder.METRICS_FILE).series("seconds")
    assert int(checkpoint.listed(long)[-1].stem.rpartition("-")[2]) == learned[-1]
