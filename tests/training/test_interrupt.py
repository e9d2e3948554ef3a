"""Ctrl-C and SIGTERM: a run is saved, its worker processes do not notice, and the exit code says so."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from izoo import train
from izoo.training import checkpoint
from izoo.training.learner import Learner
from izoo.training.loggers import MetricsTable
from izoo.training.loop import Session
from izoo.training.run_folder import METRICS_FILE
from tests.training.toy import TOY, begun


@pytest.mark.slow
@pytest.mark.parametrize("collector", ["single", "parallel", "multisync"])
def test_sigterm_saves_the_run(collector: str, tmp_path: Path) -> None:
    """Sent twice and to every process of the run, as job schedulers do.

    The workers on SUMO ignore the signal; the processes of TorchRL's collector end, and the run is saved anyway.
    """
    run_dir = tmp_path / "run"
    words = [word for word in TOY if not word.startswith(("collector", "total_frames", "checkpoint"))]
    words += [f"collector={collector}", "total_frames=100000000", "checkpoint.every_batches=100000"]
    process = begun(run_dir, words, lambda: MetricsTable.read(run_dir / METRICS_FILE).rows)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    for pid in (*map(int, children), process.pid, process.pid):
        os.kill(pid, signal.SIGTERM)
    output, error = process.communicate(timeout=100)
    assert process.returncode == 130 and "Traceback" not in error, error
    assert error.strip().endswith("izoo train: stopped.") and "go on with: python -m izoo.train resume=" in output
    learned = int(MetricsTable.read(run_dir / METRICS_FILE).rows[-1]["frames"])
    assert checkpoint.load(checkpoint.find(run_dir))["frames"] == learned
    assert train.main([f"resume={run_dir}", f"total_frames={learned + 50}"]) == 0


def test_a_signal_in_the_last_batch_is_not_swallowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A benchmark would begin its next job; the run itself is whole. Schedulers may send SIGTERM twice."""
    run_dir, real = tmp_path / "run", Learner.update

    def press(self: Learner, batch: Any, progress: float) -> dict[str, float]:
        for number in (signal.SIGTERM, signal.SIGTERM) if progress > 0 else ():
            os.kill(os.getpid(), number)
        return real(self, batch, progress)

    monkeypatch.setattr(Learner, "update", press)
    assert train.main([*TOY, f"run_dir={run_dir}"]) == 130
    assert checkpoint.load(checkpoint.find(run_dir))["frames"] == 100
    monkeypatch.undo()
    assert train.main([f"resume={run_dir}"]) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_first_batch_leaves_nothing(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Session._learn

    def press(self: Session, interrupt: Any) -> None:
        os.kill(os.getpid(), number)
        real(self, interrupt)

    monkeypatch.setattr(Session, "_learn", press)
    assert train.main([*TOY, f"run_dir={tmp_path / 'run'}"]) == 130
    assert not (tmp_path / "run").exists()
