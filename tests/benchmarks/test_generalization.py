"""The generalization benchmark: real training and tests, stopped in every way and gone on with."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from matplotlib import image

from izoo.benchmarks import generalization
from izoo.benchmarks.campaign import jobs, training_runs
from izoo.errors import IzooError
from izoo.files import claimed
from izoo.leaderboard import main as leaderboard
from izoo.report.report_data import collect
from izoo.results import read_table
from izoo.results.store import read_manifest
from izoo.training import checkpoint
from izoo.training.run_folder import owned

pytestmark = pytest.mark.slow

WORDS = [
    "protocol=systematicity",
    "algos=[ppo,uncommanded]",
    "seeds=1",
    "frames=750",
    "horizon_s=100",
    "test_limit=2",
    "train_contexts=2",
    "num_workers=0",
    "simulator=twin",
    "num_envs=2",
    'train_options=["algo.frames_per_batch=150","checkpoint.every_batches=1","algo.epochs=1"]',
]
ENTRIES = {"human", "uncommanded", "constant_2.0", "cap_0.6", "ppo_untrained", "ppo"}
"""What is asked for, and what stands beside it."""


def start(folder: Path, cache: Path, *more: str) -> subprocess.Popen[str]:
    places = [f"out={folder}", f"cache={cache}"]
    command = [sys.executable, "-m", "izoo.benchmarks.generalization", *WORDS, *places, *more]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def wait_for_frames(folder: Path, frames: int, process: subprocess.Popen[str]) -> None:
    """Wait until the run has a checkpoint of so many frames."""
    run = folder / "train" / "ppo" / "seed0"
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None:
        found = checkpoint.listed(run)
        if found and int(found[-1].stem.partition("-")[2]) >= frames:
            return
        time.sleep(0.02)
    process.kill()
    pytest.fail(f"no checkpoint of {frames} frames: {process.communicate()[0]}")


def wait_until_nobody_trains(run_dir: Path) -> None:
    """A run in a process of its own notices that the benchmark is gone, and saves its state."""
    end = time.monotonic() + 60
    while True:
        try:
            with owned(run_dir):
                return
        except IzooError:
            assert time.monotonic() < end
            time.sleep(0.1)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A finished benchmark and its cache."""
    folder, cache = tmp_path_factory.mktemp("results") / "a", tmp_path_factory.mktemp("baselines")
    assert generalization.main([*WORDS, f"out={folder}", f"cache={cache}"]) == 0
    return folder, cache


def assert_everything_is_there(folder: Path, seeds: int = 1) -> None:
    assert read_manifest(folder).complete
    assert image.imread(folder / "learning_curves.png").shape[2] == 4
    table = read_table(folder)
    assert set(table["policy"]) == ENTRIES
    played = table.groupby(["policy", "train_seed", "context_hash"])["seed"].nunique()
    assert played.eq(3).all() and len(played) == 4 * (4 + 2 * seeds), "2 test contexts, and 2 of the training"
    frames = [line.split(",")[0] for line in (folder / "train/ppo/seed0/metrics.csv").read_text().splitlines()[1:]]
    assert [int(number) for number in frames] == list(range(150, 751, 150)), "a batch was lost or counted twice"
    (summary,) = json.loads((folder / "summary.json").read_text())
    assert summary["entries"]["ppo"]["train_seeds"] == seeds and summary["task"] == "systematicity (grid), 100 s"
    assert set(summary["gaps"]) == ENTRIES - {"human", "uncommanded"} and summary["n"]["contexts"] == 2
    written = {path.stem for path in (folder / "leaderboard").glob("*.json")}
    assert written == ENTRIES - {"human", "uncommanded"}


def test_everything_is_there(done: tuple[Path, Path]) -> None:
    assert_everything_is_there(done[0])
    record = read_manifest(done[0]).policies["ppo"][0]
    assert (record.kind, record.algo, record.frames) == ("trained", "ppo", 750) and record.weights
    assert (done[0] / str(record.source)).is_file()
    assert leaderboard(["validate", str(done[0] / "leaderboard" / "ppo.json")]) == 0
    found = collect(done[0])
    (evaluation,) = found.evaluations
    assert set(evaluation.summary["gaps"]) == ENTRIES - {"human", "uncommanded"}
    assert set(evaluation.policies) == ENTRIES - {"human"} and list(found.curves) == ["ppo"]


@pytest.mark.parametrize("runs_at_once", [1, 2])
def test_a_benchmark_that_was_stopped_by_ctrl_c_and_then_killed_goes_on(tmp_path: Path, runs_at_once: int) -> None:
    folder, cache = tmp_path / "a", tmp_path / "cache"
    more = [f"runs_at_once={runs_at_once}", f"seeds={runs_at_once}"]
    process = start(folder, cache, *more)
    wait_for_frames(folder, 150, process)
    process.send_signal(signal.SIGINT)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and "the same command goes on where it stopped." in output, output
    process = start(folder, cache, *more)
    wait_for_frames(folder, int(checkpoint.listed(folder / "train/ppo/seed0")[-1].stem[5:]) + 150, process)
    process.kill()
    process.communicate()
    assert not read_manifest(folder).complete
    for seed in range(runs_at_once):
        wait_until_nobody_trains(folder / f"train/ppo/seed{seed}")
    assert generalization.main([*WORDS, *more, f"out={folder}", f"cache={cache}"]) == 0
    assert_everything_is_there(folder, runs_at_once)
    said = [file.read_text() for file in sorted(folder.glob("train/ppo/*.log"))]
    assert len(said) == (runs_at_once if runs_at_once > 1 else 0) and all("Run folder: " in text for text in said)


def test_a_second_start_does_nothing_and_more_is_added(
    done: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, cache = Path(shutil.copytree(done[0], tmp_path / "copy")), done[1]
    before = (copy / "rows.csv").read_bytes()
    assert generalization.main([*WORDS, f"out={copy}", f"cache={cache}"]) == 0
    assert "7 of 7 jobs are done already" in capsys.readouterr().out
    assert (copy / "rows.csv").read_bytes() == before
    more = [word.replace("test_limit=2", "test_limit=3") for word in WORDS]
    assert generalization.main([*more, "human_vehicles=true", f"out={copy}", f"cache={cache}"]) == 0
    assert (copy / "rows.csv").read_bytes().startswith(before)
    here, humans = json.loads((copy / "summary.json").read_text())
    assert here["n"]["contexts"] == humans["n"]["contexts"] == 3
    assert humans["task"] == f"{here['task']}, human vehicles"
    level = humans["entries"]["uncommanded"]["against"]["human"]["all"]["figures"]["co2_saved"]
    assert level["value"] == 0.0, "with the vehicles of human drivers, uncommanded is human driving"


def test_tests_in_sumo_of_what_the_twin_trained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [word for word in WORDS if not word.startswith(("simulator", "test_limit"))]
    words += ["simulator=sumo", "train_simulator=twin", "test_limit=1", f"out={tmp_path}/a", f"cache={tmp_path}/cache"]
    assert generalization.main(words) == 0
    assert set(read_table(tmp_path / "a")["simulator"]) == {"sumo"}
    said = capsys.readouterr().out.rstrip().splitlines()
    assert "played on SUMO" in " ".join(said) and said[-1].endswith(".")


def refused(folder: Path, cache: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """Start the benchmark, expect exit code 2, and return what it said."""
    words = [word for word in WORDS if word.partition("=")[0] not in {other.partition("=")[0] for other in more}]
    assert generalization.main([*words, *more, f"out={folder}", f"cache={cache}"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


@pytest.fixture
def copy(done: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the benchmark that a test may spoil."""
    return Path(shutil.copytree(done[0], tmp_path / "copy"))


def test_what_does_not_belong_to_the_benchmark_is_refused(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "horizon_s 100.0 -> 101.0" in refused(copy, done[1], capsys, "horizon_s=101")
    assert "algos" in refused(copy, done[1], capsys, "algos=[ppo]")
    with claimed(copy):
        assert f"{os.sep}copy" in (said := refused(copy, done[1], capsys)) and "another process" in said
    config = copy / "train/ppo/seed0/config.yaml"
    config.write_text(config.read_text().replace("beta: -3.0", "beta: -1.0"))
    assert "env.reward.beta -1.0 -> -3.0" in refused(copy, done[1], capsys)


def test_a_checkpoint_of_another_observation_is_refused(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    newest = checkpoint.listed(copy / "train/ppo/seed0")[-1]
    state = torch.load(newest, weights_only=True)
    features = state["features"]
    torch.save({**state, "features": features + 1}, newest)
    said = refused(copy, done[1], capsys)
    assert str(features) in said and str(features + 1) in said and "observ" in said


def test_an_evaluation_does_not_outlive_the_weights_that_it_tested(copy: Path, done: tuple[Path, Path]) -> None:
    before = read_table(copy)
    newest = checkpoint.listed(copy / "train/ppo/seed0")[-1]
    other = checkpoint.listed(copy / "train/ppo/seed0")[-2]
    shutil.copy(other, newest)  # as if it had been trained otherwise
    assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 0
    after = read_table(copy)
    same = after["policy"] != "ppo"
    assert after[same].equals(before[same]) and not after[~same].equals(before[~same]) and len(after) == len(before)


def stop(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def elsewhere(source: Path, *more: str) -> list[str]:
    """Words of a benchmark that is tested elsewhere with the policies of ``source``."""
    kept = [word for word in WORDS if word.partition("=")[0] not in {other.partition("=")[0] for other in more}]
    return [*kept, "test_set=sample", f"trained_in={source}", *more]


def test_policies_of_another_benchmark_are_tested_without_training_them_again(
    copy: Path, done: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    other = tmp_path / "other"
    with monkeypatch.context() as patched:
        patched.setattr(training_runs, "train", stop)
        assert generalization.main([*elsewhere(copy), f"out={other}", f"cache={done[1]}"]) == 0
    assert f"1 training run taken over from {copy}.\n" in capsys.readouterr().out
    assert read_manifest(other).task == "systematicity (sample), 100 s"
    shutil.rmtree(copy)  # the folder stands alone
    assert generalization.main([*elsewhere(done[0]), f"out={other}", f"cache={done[1]}"]) == 0
    assert "0 training runs taken over" in capsys.readouterr().out


def test_what_was_trained_otherwise_or_not_to_its_end_is_not_taken_over(
    copy: Path, done: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = [f"out={tmp_path / 'other'}", f"cache={done[1]}"]
    assert generalization.main([*elsewhere(copy, 'train_options=["algo.epochs=2"]'), *out]) == 2
    assert "algo.epochs 1 -> 2" in capsys.readouterr().err
    out[0] = f"out={tmp_path / 'another'}"
    assert generalization.main([*elsewhere(tmp_path), *out]) == 2
    assert "manifest.json" in capsys.readouterr().err
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "model_version": -1}))
    assert generalization.main([*elsewhere(copy), *out]) == 2
    assert "model version -1" in capsys.readouterr().err
    (copy / "manifest.json").write_text(json.dumps(manifest))
    checkpoint.listed(copy / "train/ppo/seed0")[-1].unlink()
    monkeypatch.setattr(training_runs, "train", stop)
    monkeypatch.setattr(jobs, "play_missing", lambda *_, **__: None)
    assert generalization.main([*elsewhere(copy), *out]) == 130
    assert "still to be trained: ppo seed 0.\n" in capsys.readouterr().out


def test_a_run_whose_process_still_lives_is_waited_for(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """As where the benchmark was killed before the first checkpoint of a run in a process of its own."""
    run_dir = copy / "train" / "ppo" / "seed0"
    for file in checkpoint.listed(run_dir):
        file.unlink()
    with owned(run_dir):
        assert "this run is being trained; wait for its end" in refused(copy, done[1], capsys)
    assert (run_dir / "metrics.csv").exists()
