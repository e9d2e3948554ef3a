"""The generalization benchmark on the real simulator, stopped in every way and gone on with."""

from __future__ import annotations

import io
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
from rich.console import Console

from izoo.benchmarks import campaign, generalization, training_runs
from izoo.benchmarks.outcome import outcome_tables
from izoo.errors import IzooError
from izoo.evaluation.table import read_csv
from izoo.files import claimed
from izoo.leaderboard import main as leaderboard
from izoo.reporting.material import collect
from izoo.reporting.results import evaluation_of, read_results
from izoo.training import checkpoint
from izoo.training.runs import owned

pytestmark = pytest.mark.slow

WORDS = [
    "protocol=systematicity",
    "algos=[ppo,uncommanded]",
    "seeds=1",
    "frames=750",
    "horizon_s=100",
    "test_limit=2",
    "num_workers=0",
    'train_options=["algo.frames_per_batch=150","checkpoint.every_batches=1","algo.epochs=1"]',
]
ENTRIES = {"ppo", "uncommanded", "constant_2.0", "ppo_untrained"}
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
    """A run in a process of its own notices that the benchmark is gone, and closes in good order."""
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


def assert_everything_is_there(folder: Path) -> None:
    results = read_results(folder)
    assert results.complete
    assert image.imread(folder / "learning_curves.png").shape[2] == 4
    assert results.entry("ppo").runs[0].frames == 750
    table = evaluation_of(folder, results.entry("ppo").runs[0])
    assert set(table["policy"]) == {"human", "uncommanded", "ppo"}
    assert table["context_hash"].nunique() == 2 and table.groupby("context_hash")["seed"].nunique().eq(3).all()
    frames = [line.split(",")[0] for line in (folder / "train/ppo/seed0/metrics.csv").read_text().splitlines()[1:]]
    assert [int(number) for number in frames] == list(range(150, 751, 150)), "a batch was lost or counted twice"
    assert results.aggregates["entries"]["ppo"]["n"]["approaches"] == 2
    assert "paper's form" in results.aggregates["entries"]["ppo"]["best_seed"]["label"]
    assert {pair["x"] for pair in results.aggregates["improvement"]} == ENTRIES


def test_everything_is_there(done: tuple[Path, Path]) -> None:
    assert_everything_is_there(done[0])


@pytest.mark.slow
@pytest.mark.parametrize("runs_at_once", [1, 2])
def test_a_benchmark_that_was_stopped_by_ctrl_c_and_then_killed_goes_on(tmp_path: Path, runs_at_once: int) -> None:
    folder, cache = tmp_path / "a", tmp_path / "cache"
    more = [f"runs_at_once={runs_at_once}", f"seeds={runs_at_once}"]
    process = start(folder, cache, *more)
    wait_for_frames(folder, 150, process)
    process.send_signal(signal.SIGINT)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and "the same command goes on where it stopped." in output, output
    stopped_at = read_results(folder).entry("ppo").runs[0]
    assert stopped_at.status == "training"
    process = start(folder, cache, *more)
    wait_for_frames(folder, int(checkpoint.listed(folder / "train/ppo/seed0")[-1].stem[5:]) + 150, process)
    process.kill()
    process.communicate()
    assert not read_results(folder).complete
    for seed in range(runs_at_once):
        wait_until_nobody_trains(folder / f"train/ppo/seed{seed}")
    assert generalization.main([*WORDS, *more, f"out={folder}", f"cache={cache}"]) == 0
    assert_everything_is_there(folder)
    assert [run.frames for run in read_results(folder).entry("ppo").runs] == [750] * runs_at_once
    said = [file.read_text() for file in sorted(folder.glob("train/ppo/*.log"))]
    assert len(said) == (runs_at_once if runs_at_once > 1 else 0) and all("Run folder: " in text for text in said)


def test_everything_on_the_twin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*WORDS, "simulator=twin", "num_envs=2", f"out={tmp_path / 'a'}", f"cache={tmp_path / 'cache'}"]
    assert generalization.main(words) == 0
    assert "on the twin" in capsys.readouterr().out
    assert "\nsimulator: twin\n" in (tmp_path / "a/train/ppo/seed0/config.yaml").read_text()
    for submission in (tmp_path / "a/leaderboard").glob("*.json"):
        assert json.loads(submission.read_text())["simulator"] == "twin"
    assert generalization.main([*words, "simulator=sumo", "train_simulator=twin"]) == 2
    assert "other settings (simulator" in capsys.readouterr().err


def test_a_second_start_does_nothing(done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    folder, cache = done
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/*/*/*.csv")}
    assert generalization.main([*WORDS, f"out={folder}", f"cache={cache}"]) == 0
    assert "5 of 5 jobs are done already" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/*/*/*.csv")} == before


def test_every_line_of_the_table_says_what_it_is_over_uncommanded(done: tuple[Path, Path]) -> None:
    results = read_results(done[0])
    text = io.StringIO()
    Console(file=text, width=80).print(outcome_tables(results))
    for words in ("ppo_untrained", "constant_2.0", "uncommanded", "whole region", "demand served", "fewer than 6"):
        assert words in text.getvalue()
    assert "…" not in text.getvalue(), "a terminal of 80 columns is too narrow"
    for name, content in results.aggregates["entries"].items():
        assert ("over_uncommanded" in content["all"]) == (name != "uncommanded")
        assert 0.0 < content["all"]["served"]["policy"]["value"] <= 1.0
    table = evaluation_of(done[0], results.entry("ppo_untrained").runs[0])
    assert set(table["policy"]) == {"human", "uncommanded", "ppo_untrained"}


def test_on_human_vehicles_nobody_gains_without_a_command(tmp_path: Path, done: tuple[Path, Path]) -> None:
    words = [word.replace("ppo", "glide") for word in WORDS if not word.startswith(("frames", "train_options"))]
    assert generalization.main([*words, "human_vehicles=true", f"out={tmp_path / 'a'}", f"cache={done[1]}"]) == 0
    results = read_results(tmp_path / "a")
    beside = {name: content["human_vehicles"] for name, content in results.aggregates["entries"].items()}
    assert beside["uncommanded"]["all"]["ungated"]["mean"]["value"] == 0.0
    assert beside["glide"]["all"]["ungated"]["mean"] == beside["glide"]["all"]["over_uncommanded"]["mean"]
    names = {entry.name for entry in collect(tmp_path / "a").entries}
    assert names == {"glide", "uncommanded", "glide, human vehicles", "uncommanded, human vehicles"}


def test_the_leaderboard_files_are_in_order_but_for_what_is_missing(
    done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert leaderboard(["validate", str(done[0] / "leaderboard" / "ppo.json")]) == 1
    marks = [line for line in capsys.readouterr().out.splitlines() if "mark:" in line]
    assert marks == ["  mark: 126 of 128 test contexts are missing"]


def refused(folder: Path, cache: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """Start the benchmark, expect exit code 2, and return what it said."""
    words = [word for word in WORDS if word.partition("=")[0] not in {other.partition("=")[0] for other in more}]
    assert generalization.main([*words, *more, f"out={folder}", f"cache={cache}"]) == 2
    return capsys.readouterr().err


@pytest.fixture
def copy(done: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the benchmark that a test may spoil; its run folders know their new place from the command."""
    return Path(shutil.copytree(done[0], tmp_path / "copy"))


def test_other_settings_are_refused(copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(copy, done[1], capsys, "horizon_s=101")
    assert "horizon_s 100.0 -> 101.0" in said and "other" in said
    assert "test_limit 2 -> 3" in refused(copy, done[1], capsys, "test_limit=3")
    assert "algos" in refused(copy, done[1], capsys, "algos=[ppo]")


def test_a_folder_without_settings_is_refused(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "settings.yaml").unlink()
    assert "not empty" in refused(copy, done[1], capsys)
    (copy / "settings.yaml").write_text("protocol: [systema")
    assert "damaged" in refused(copy, done[1], capsys)


def test_a_run_with_other_options_is_refused(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
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
    shutil.rmtree(copy / "evaluation/ppo")
    said = refused(copy, done[1], capsys)
    assert str(features) in said and str(features + 1) in said and "observ" in said


def test_what_is_half_written_is_made_again(copy: Path, done: tuple[Path, Path]) -> None:
    before = read_csv(copy / "evaluation/ppo/seed0/evaluation.csv")
    lines = (copy / "evaluation/ppo/seed0/evaluation.csv").read_text().splitlines(keepends=True)
    kept = [line for line in lines[1:] if not line.startswith("ppo")]
    (copy / "evaluation/ppo/seed0/evaluation.csv").write_text("".join([lines[0], *kept]))
    (copy / "results.json").write_text('{"format": "izoo-res')
    assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 0
    after = read_csv(copy / "evaluation/ppo/seed0/evaluation.csv")
    assert after.equals(before)
    assert json.loads((copy / "results.json").read_text())["complete"]


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
    results = read_results(other)
    assert results.complete and results.title == "systematicity (sample)"
    assert results.entry("ppo").runs[0].frames == 750
    shutil.rmtree(copy)  # the folder stands alone
    assert generalization.main([*elsewhere(done[0]), f"out={other}", f"cache={done[1]}"]) == 0
    assert "0 training runs taken over" in capsys.readouterr().out


def test_a_run_that_is_not_finished_there_is_trained_here(
    copy: Path, done: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    checkpoint.listed(copy / "train/ppo/seed0")[-1].unlink()
    monkeypatch.setattr(training_runs, "train", stop)
    assert generalization.main([*elsewhere(copy), f"out={tmp_path / 'other'}", f"cache={done[1]}"]) == 130
    assert "still to be trained: ppo seed 0.\n" in capsys.readouterr().out


def test_what_was_trained_otherwise_is_not_taken_over(
    copy: Path, done: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [f"out={tmp_path / 'other'}", f"cache={done[1]}"]
    assert generalization.main([*elsewhere(copy, 'train_options=["algo.epochs=2"]'), *out]) == 2
    assert "algo.epochs 1 -> 2" in capsys.readouterr().err
    assert generalization.main([*elsewhere(tmp_path), *out]) == 2
    assert "settings.yaml" in capsys.readouterr().err
    settings = (copy / "settings.yaml").read_text()
    (copy / "settings.yaml").write_text(settings.replace("drivers: ", "drivers: 0"))
    assert generalization.main([*elsewhere(copy), *out]) == 2
    assert "versions" in capsys.readouterr().err
    assert generalization.main([*elsewhere(tmp_path / "none"), *out]) == 2
    assert "none" in capsys.readouterr().err


def test_aggregates_and_leaderboard_files_never_lag_behind_the_runs(
    copy: Path, done: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill while summing up leaves no aggregates, and those before it, of fewer runs, are gone."""
    whole = read_results(copy).aggregates
    shutil.rmtree(copy / "evaluation/uncommanded")
    shutil.rmtree(copy / "leaderboard")
    for where in ("sum_up", "write_submissions"):
        with monkeypatch.context() as patched:
            patched.setattr(campaign, where, stop)
            assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 130
        results = read_results(copy)
        assert results.complete and results.aggregates == {}
    assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 0
    assert read_results(copy).aggregates == whole
    assert {path.stem for path in (copy / "leaderboard").glob("*.json")} == ENTRIES


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


def test_an_evaluation_does_not_outlive_the_weights_that_it_tested(
    copy: Path, done: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(copy / "train/ppo/seed0")
    monkeypatch.setattr(campaign.Campaign, "_evaluate", stop)
    assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 130
    assert generalization.main([*WORDS, f"out={copy}", f"cache={done[1]}"]) == 130, "nothing was left to evaluate"
    assert read_results(copy).entry("ppo").runs[0].status == "trained"


def test_two_processes_do_not_share_a_folder(
    copy: Path, done: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:

    with claimed(copy):
        assert f"{os.sep}copy" in (said := refused(copy, done[1], capsys)) and "another process" in said
