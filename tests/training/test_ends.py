"""How a run ends that cannot go on, and who may train in a folder."""

import csv
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from izoo import files, train
from izoo.errors import IzooError
from izoo.training import checkpoint, loggers, loop, run_folder
from izoo.training.learner import Learner
from tests.training.toy import TOY


def frames_in(run_dir: Path) -> list[int]:
    with (run_dir / run_folder.METRICS_FILE).open(newline="") as file:
        return [int(row["frames"]) for row in csv.DictReader(file)]


def one_line(capsys: pytest.CaptureFixture[str], *parts: str) -> None:
    """Check that the error was one line of izoo with these parts."""
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("izoo")]
    assert len(lines) == 1 and all(part in lines[0] for part in parts), lines


@pytest.mark.slow
def test_a_run_is_trained_by_one_process_at_a_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = tmp_path / "run"
    assert train.main([*TOY, f"run_dir={run_dir}"]) == 0
    program = "import sys, pathlib; from izoo.training import run_folder\n"
    program += "with run_folder.owned(pathlib.Path(sys.argv[1])): print('mine', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, str(run_dir)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "mine\n"
        assert train.main([f"resume={run_dir}", "total_frames=150"]) == 2
        one_line(capsys, str(run_dir), "this run is being trained")
        other.communicate("")
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 0
    assert frames_in(run_dir) == [50, 100, 150]


@pytest.mark.parametrize(("existed", "others"), [(False, False), (True, False), (True, True)])
def test_a_start_that_fails_removes_only_its_own_files(
    existed: bool, others: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = tmp_path / "run"
    if existed:
        run_dir.mkdir()

    def refuse(*_: Any) -> None:
        if others:
            (run_dir / "notes.txt").write_text("theirs")
        raise IzooError("the first batch cannot be collected.")

    monkeypatch.setattr(loop, "BatchSource", refuse)
    assert train.main([*TOY, "logger=tensorboard", f"run_dir={run_dir}"]) == 2
    one_line(capsys, "cannot be collected")
    left = {str(path.relative_to(run_dir)) for path in run_dir.rglob("*")}
    assert left == ({"notes.txt"} if others else set()) and run_dir.exists() == existed


@pytest.mark.slow
@pytest.mark.parametrize("what", ["weights", "loss"])
def test_training_stops_where_its_numbers_are_not_finite(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last finite checkpoint stays, and is what a resumed run begins from."""
    run_dir, real, updates = tmp_path / "run", Learner.update, []

    def diverge(self: Learner, batch: Any, progress: float) -> dict[str, float]:
        stats = real(self, batch, progress)
        updates.append(progress)
        if len(updates) == 2:
            if what == "loss":
                return {**stats, "loss_objective": float("nan")}
            with torch.no_grad():
                next(iter(self.algorithm.policy.parameters())).view(-1)[0] = torch.nan
        return stats

    monkeypatch.setattr(Learner, "update", diverge)
    assert train.main([*TOY, "total_frames=200", f"run_dir={run_dir}"]) == 1
    one_line(capsys, "diverged after 50 frames", "step-000000000050.pt", "lr")
    assert [path.name for path in checkpoint.listed(run_dir)] == ["step-000000000050.pt"]
    weights = checkpoint.load(checkpoint.find(run_dir))["algorithm"]["policy"].values()
    assert all(value.isfinite().all() for value in weights if torch.is_tensor(value))
    monkeypatch.undo()
    assert train.main([f"resume={run_dir}"]) == 0


def full(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, suffix: str) -> None:
    """Let every file whose name ends so meet a full disk."""
    partial, real = tmp_path / "partial", files.partial_of

    def partial_of(path: Path) -> Path:
        if not path.name.endswith(suffix):
            return real(path)
        partial.unlink(missing_ok=True)
        partial.symlink_to("/dev/full")
        return partial

    monkeypatch.setattr(files, "partial_of", partial_of)


def test_a_full_disk_is_one_sentence_and_the_run_goes_on_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = tmp_path / "run"
    assert train.main([*TOY, f"run_dir={run_dir}"]) == 0
    full(monkeypatch, tmp_path, run_folder.CONFIG_FILE)
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 1
    one_line(capsys, "No space left on device", "step-000000000100.pt")
    assert run_folder.read_config(run_dir).total_frames == 100
    monkeypatch.undo()
    full(monkeypatch, tmp_path, ".pt")
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 1
    one_line(capsys, "last weights could not be saved", "step-000000000100.pt", f"resume={run_dir}")
    monkeypatch.undo()
    assert train.main([f"resume={run_dir}"]) == 0
    assert frames_in(run_dir) == [50, 100, 150]


class Logger:
    """A logger that takes so many numbers and then fails, also at its end."""

    def __init__(self, takes: int) -> None:
        self.takes, self.experiment = takes, self

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        self.takes -= 1
        self.finish()

    def finish(self) -> None:
        if self.takes < 0:
            raise ConnectionResetError("Connection lost")


def test_a_logger_that_fails_is_done_without(capsys: pytest.CaptureFixture[str]) -> None:
    good, bad, late = Logger(100), Logger(3), Logger(8)
    sinks: list[Any] = [bad, good, late]
    for frames in range(4):
        loggers.log_all(sinks, {"frames": frames, "return": 1.0, "reward": 2.0})
    late.takes = -1
    loggers.close_all(sinks)
    assert sinks == [good] and good.takes == 92
    assert capsys.readouterr().err.count("Logger has failed (Connection lost); the run goes on without it.") == 2
