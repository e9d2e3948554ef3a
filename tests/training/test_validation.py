"""Validation beside training, on real SUMO."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from izoo import evaluate, train
from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import PcgContexts
from izoo.conf.train_options import TrainConfig
from izoo.contexts.catalogue import Scenarios
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.results import read_table
from izoo.results.rollout import DRAIN_S
from izoo.training import checkpoint, run_folder, validation
from izoo.training.validation import Validator, shown_worse
from izoo.training.validation_rollout import CONTEXTS, held_out
from tests.training.toy import begun

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "contexts.lane_length_m=120", "env.horizon_s=75"),
    *("algo.frames_per_batch=200", "algo.minibatch_rows=64", "evaluation.contexts=0", "checkpoint.every_batches=5"),
    *("validation.every_batches=3", "validation.contexts=1", "validation.seeds=1", "algo.hidden=[16]"),
]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of five batches."""
    folder = tmp_path_factory.mktemp("runs") / "toy"
    assert train.main([*TOY, "collector=single", "total_frames=1000", f"run_dir={folder}"]) == 0
    return folder


def test_results_and_the_best_weights_are_kept(run_dir: Path) -> None:
    table = rows(run_dir / validation.VALIDATION_FILE)
    assert int(table[-1]["frames"]) == 1000, "the last weights are validated at the end"
    assert {int(row["frames"]) for row in table} <= {600, 1000}
    assert "co2_saved_low" not in table[0], "one intersection has no interval"
    assert {"delay_change_s", "co2_g", "delay_s", "unserved", "co2_saved_over_human", "slower"} <= set(table[0])
    saved = [float(row["co2_saved"]) for row in table]
    best = checkpoint.load(run_dir / "checkpoints" / "best.pt")
    highest = max(range(len(table)), key=lambda k: (saved[k], k))  # of equal ones the newest
    assert best["frames"] == int(table[highest]["frames"])
    assert [row["best"] for row in table].count("1") >= 1 and table[0]["best"] == "1"
    assert not checkpoint.candidates(run_dir)
    assert (run_dir / run_folder.CURVE_FILE).stat().st_size > 0


@pytest.mark.slow
def test_six_intersections_or_more_give_intervals(tmp_path: Path) -> None:
    replaced = ("validation.contexts", "validation.seeds", "env.horizon_s", "contexts.inflow_vph_per_lane")
    words = [word for word in TOY if not word.startswith(replaced)]
    words += ["validation.contexts=6", "validation.simulator=twin", "contexts.adoption=0.5", "env.horizon_s=120"]
    words += ["contexts.inflow_vph_per_lane=400..700"]
    assert train.main([*words, "collector=single", "total_frames=600", f"run_dir={tmp_path / 'run'}"]) == 0
    (row,) = rows(tmp_path / "run" / validation.VALIDATION_FILE)
    for name in ("co2_saved", "co2_saved_over_human", "delay_change_s"):
        assert float(row[f"{name}_low"]) < float(row[name]) < float(row[f"{name}_high"]), name


def test_validation_changes_nothing_in_training(run_dir: Path, tmp_path: Path) -> None:
    words = [*TOY, "collector=single", "validation.every_batches=0", "total_frames=1000"]
    assert train.main([*words, f"run_dir={tmp_path / 'run'}"]) == 0
    folders = run_dir, tmp_path / "run"
    with_it, without = (run_folder.load_algorithm(folder)[0].state_dict()["policy"] for folder in folders)
    assert all(torch.equal(with_it[key], without[key]) for key in with_it)
    assert not (tmp_path / "run" / validation.VALIDATION_FILE).exists()
    with pytest.raises(IzooError, match=r"checkpoint is 'best'; .* has 1000, last"):
        checkpoint.find(tmp_path / "run", "best")


def test_a_run_of_short_episodes_is_evaluated_in_full_ones(run_dir: Path) -> None:
    trained = run_folder.read_config(run_dir).env
    assert trained.horizon_s < EnvConfig().horizon_s
    full, whole = evaluate.COMMAND.compose([f"run={run_dir}"]), EnvConfig()
    changes = {"horizon_s": whole.horizon_s, "warmup_s": whole.warmup_s, "emit": whole.emit}
    assert full.env == dataclasses.replace(trained, **changes, drain_s=DRAIN_S)
    assert evaluate.COMMAND.compose([f"run={run_dir}", "env.horizon_s=77"]).env.horizon_s == 77.0


def test_a_checkpoint_is_evaluated_by_its_name(run_dir: Path, tmp_path: Path) -> None:
    words = ["num_workers=0", "seeds=3", "num_contexts=1", "env.horizon_s=90", f"out={tmp_path / 'out'}"]
    assert evaluate.main([f"run={run_dir}", "checkpoint=best", *words]) == 0
    assert "toy-best" in set(read_table(tmp_path / "out")["policy"])
    assert checkpoint.find(run_dir, "1000") == checkpoint.find(run_dir)
    with pytest.raises(IzooError, match=r"checkpoint is '77'; .* has 600, 1000, best, last"):
        checkpoint.find(run_dir, "77")
    with pytest.raises(IzooError, match=r"config\.yaml is a file that does not lie among a run's checkpoints"):
        checkpoint.find(run_dir / "config.yaml")


def test_a_run_that_is_resumed_further_back_forgets_a_later_best(tmp_path: Path) -> None:
    for frames, kept in ((200, True), (300, False)):
        checkpoint.make_best(checkpoint.make_candidate(checkpoint.save(tmp_path, frames, {"algorithm": {}}, keep=1)))
        Validator(TrainConfig(), tmp_path, frames=250)
        assert (checkpoint.best_of(tmp_path) is not None) == kept


@pytest.mark.slow
def test_a_failed_validation_is_reported_once_and_training_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    validator = Validator(TrainConfig(), tmp_path)
    path = checkpoint.save(tmp_path, 100, {"algorithm": {}}, keep=1)
    validator.submit(path)  # the folder has no config.yaml
    assert validator.busy
    validator.submit(path)  # weights that are being validated are not submitted again
    deadline = time.monotonic() + 120
    while validator.busy and time.monotonic() < deadline:
        assert validator.poll() == {}
        time.sleep(0.05)
    assert not validator.busy
    error = capsys.readouterr().err
    assert error.count("validation of candidate-000000000100.pt failed") == 1 and "training goes on" in error
    assert "config.yaml" in error
    assert not checkpoint.candidates(tmp_path) and checkpoint.listed(tmp_path) == [path]


def test_weights_whose_commands_are_nan_are_never_the_best(tmp_path: Path) -> None:
    """Their saving is that of the simulator's own driver."""
    validator = Validator(TrainConfig(), tmp_path)
    assert validator._is_best({"co2_saved": 0.1, "nan_share": 0.0})
    assert not validator._is_best({"co2_saved": 0.9, "nan_share": 0.01})
    assert not validator._is_best({"nan_share": 0.0}), "no saving was measured"


@pytest.mark.slow
def test_ctrl_c_does_not_wait_for_validation(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = [word for word in TOY if not word.startswith("validation")]
    words += ["total_frames=100000000", "validation.every_batches=1", "validation.seeds=1000"]
    process = begun(folder, words, lambda: checkpoint.candidates(folder))
    os.kill(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert checkpoint.candidates(folder), "a resumed run validates these weights again"


def test_validation_uses_held_out_intersections_where_there_are_any() -> None:
    source = held_out(CityContexts(split="train"))
    assert isinstance(source, Scenarios)
    names = {source[k].intersection.name for k in range(0, len(source), 7)}
    trained = CityContexts(split="train").build()
    assert names.isdisjoint({trained[k].intersection.name for k in range(0, len(trained), 7)})  # type: ignore[index]
    assert held_out(PcgContexts(preset="easy")) is not None


def told_apart(places: int, validations: int, loss: float, runs: int) -> float:
    """Share of runs whose last weights are shown to be worse than the best of as many validations before them.

    Savings of two policies differ by 4 points from intersection to intersection, as those of glide and uncommanded
    driving do; all but the last weights are equally good.
    """
    generator, apart = np.random.default_rng(2), 0
    for _ in range(runs):
        shared = generator.normal(0.08, 0.08, places)
        found = [shared + generator.normal(0.0, 0.04 / np.sqrt(2.0), places) for _ in range(validations + 1)]
        best = max((_saved(one) for one in found[:-1]), key=lambda one: sum(value[1] for value in one.values()))
        apart += shown_worse(_saved(found[-1] - loss), best, validations)
    return apart / runs


@pytest.mark.parametrize("places", [4, 8, 16])
@pytest.mark.parametrize("validations", [1, 5, 20])
def test_two_equal_policies_are_told_apart_in_fewer_than_a_tenth_of_runs(places: int, validations: int) -> None:
    assert told_apart(places, validations, 0.0, 400) < 0.1


def _saved(values: np.ndarray) -> dict[str, list[object]]:
    return {f"{k} A": [f"town/{k}", 0.0 if k % 4 == 3 else float(value)] for k, value in enumerate(values)}


def test_the_best_is_the_newest_that_is_not_shown_to_be_worse_than_the_highest(tmp_path: Path) -> None:
    (tmp_path / validation.VALIDATION_FILE).write_text("frames,co2_saved,best\n100,0.1,1.0\n200,0.06,1.0\n")
    (tmp_path / "validation").mkdir()
    for frames, shift in ((100, 0.1), (200, 0.06)):
        content = {"co2_saved": shift, CONTEXTS: _saved(np.arange(8) / 100 + shift)}
        (tmp_path / f"validation/step-{frames:012d}.json").write_text(json.dumps(content))
    checkpoint.make_best(checkpoint.make_candidate(checkpoint.save(tmp_path, 200, {"algorithm": {}}, keep=1)))
    validator = Validator(TrainConfig(), tmp_path, frames=200)
    noise = np.tile([0.05, -0.06, 0.02, 0.0], 2)
    assert validator._is_best({"co2_saved": 0.09}, _saved(np.arange(8) / 100 + 0.09 + noise))
    worse = _saved(np.arange(8) / 100 + 0.055 + 0.01 * noise)  # as good as the last, but not as the highest
    assert not validator._is_best({"co2_saved": 0.055}, worse)


def test_weights_that_are_shown_to_be_slower_give_way_to_others(tmp_path: Path) -> None:
    """They are the best only until others come, and nothing is compared with what they save."""
    path = tmp_path / validation.VALIDATION_FILE
    slower, faster = {"co2_saved": 9.0, "slower": 1.0}, {"co2_saved": 1.0, "slower": 0.0}
    validator = Validator(TrainConfig(), tmp_path)
    assert validator._is_best(slower), "the first ones"
    path.write_text("frames,co2_saved,slower,best\n100,9.0,1,1\n")
    checkpoint.make_best(checkpoint.make_candidate(checkpoint.save(tmp_path, 100, {"algorithm": {}}, keep=1)))
    validator = Validator(TrainConfig(), tmp_path, frames=100)
    assert validator._is_best(faster) and not validator._is_best(slower)
    path.write_text("frames,co2_saved,slower,best\n50,9.0,1,1\n100,1.0,0,1\n")
    validator = Validator(TrainConfig(), tmp_path, frames=100)
    assert validator._is_best({**faster, "co2_saved": 1.5}) and not validator._is_best({**faster, "co2_saved": 0.5})


@pytest.mark.slow
def test_processes_import_what_the_run_does(tmp_path: Path) -> None:
    """All of them: those that simulate, that play the last comparison, and that validate. None looks into the current
    folder or where ``PYTHONPATH`` leads, if the run does not.
    """
    for name in ("json.py", "sitecustomize.py", "izoo.py"):
        (tmp_path / name).write_text(f"open({str(tmp_path / 'ran')!r}, 'w'); raise SystemExit('a decoy')")
    words = [word for word in TOY if not word.startswith("evaluation")]
    words += ["collector=parallel", "num_workers=2", "total_frames=600", f"run_dir={tmp_path / 'run'}"]
    words += ["evaluation.contexts=1", "evaluation.seeds=1"]
    command = [sys.executable, "-I", "-c", f"from izoo import train; raise SystemExit(train.main({words!r}))"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "failed" not in done.stderr, done.stderr
    assert not (tmp_path / "ran").exists()
    assert len(rows(tmp_path / "run" / validation.VALIDATION_FILE)) == 1
