"""Training runs in processes of their own: real ones, on the twin."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from izoo.benchmarks.campaign.parallel_training import ParallelRuns, shares
from izoo.cli.compose import compose_config
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


def test_the_cores_are_shared_out() -> None:
    mine = os.sched_getaffinity(0)
    for count in (1, len(mine)):
        parts = shares(count)
        assert len(parts) == count and set().union(*parts) == mine
        assert sum(map(len, parts)) == len(mine)
    many = shares(3 * len(mine))
    assert len(many) == 3 * len(mine) and all(len(part) == 1 for part in many) and set().union(*many) == mine


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


@pytest.mark.slow
def test_who_is_asked_to_stop_and_then_loses_its_parent_still_closes_in_good_order(tmp_path: Path) -> None:
    """A second request would stop it at once."""
    words = [f"import sys; sys.path[:] = {sys.path!r}"]
    words += ["from tests.benchmarks.test_parallel_training import stopped; from pathlib import Path"]
    words += [f"stopped(Path({str(tmp_path)!r}))"]
    parent = subprocess.Popen([sys.executable, "-c", "; ".join(words)])
    wait_until(lambda: (tmp_path / "asked").exists(), "the request")
    parent.kill()
    parent.wait()
    wait_until(lambda: "izoo train: stopped." in (tmp_path / "long.log").read_text(), "the end")
    learned, _ = MetricsTable.read(tmp_path / "long" / run_folder.METRICS_FILE).series("seconds")
    assert int(checkpoint.listed(tmp_path / "long")[-1].stem.rpartition("-")[2]) == learned[-1]


def stopped(folder: Path) -> None:
    """Begin a run, and ask it to stop once it has learned something."""
    with ParallelRuns(1) as beside:
        beside.begin("long", *order(folder, "long", 10**8, "checkpoint.every_batches=1000"))
        wait_until(lambda: MetricsTable.read(folder / "long" / run_folder.METRICS_FILE).rows, "the first batch")
        beside.going[0].dismiss()
        (folder / "asked").touch()
        time.sleep(PATIENCE_S)
