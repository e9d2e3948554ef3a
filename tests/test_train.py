"""The train command end to end at toy size, on real SUMO."""

import csv
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import files, train
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.results import read_table
from izoo.results.store import read_manifest
from izoo.training import checkpoint, loop, run_folder
from izoo.training.loggers import MetricsTable
from tests.conftest import Refused
from tests.training.toy import begun

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "env.horizon_s=75", "algo.hidden=[16]"),
    *("algo.frames_per_batch=200", "algo.minibatch_rows=64", "evaluation.contexts=0", "checkpoint.every_batches=1"),
]


def rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / run_folder.METRICS_FILE).open(newline="") as file:
        return list(csv.DictReader(file))


def weights(run_dir: Path) -> dict[str, torch.Tensor]:
    return run_folder.load_algorithm(run_dir)[0].state_dict()["policy"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three batches with two workers and a brief evaluation."""
    run_dir = tmp_path_factory.mktemp("runs") / "toy"
    words = [*TOY, "total_frames=600", f"run_dir={run_dir}", "checkpoint.keep=2", "evaluation.contexts=1"]
    words += ["evaluation.seeds=1", "logger=tensorboard"]
    assert train.main(words) == 0
    return run_dir


def test_a_run_leaves_what_it_promises(finished: Path) -> None:
    assert run_folder.read_config(finished).total_frames == 600
    table = rows(finished)
    assert [int(row["frames"]) for row in table] == [200, 400, 600]
    assert all(float(row["reward"]) != 0 for row in table[1:])
    assert any(row["return"] for row in table), "episodes of 100 steps end within batches of 100 steps per worker"
    assert (finished / run_folder.CURVE_FILE).read_bytes().startswith(b"\x89PNG")
    assert list((finished / "tensorboard").rglob("events.*"))
    assert [path.name for path in checkpoint.listed(finished)] == ["step-000000000400.pt", "step-000000000600.pt"]
    assert not [path for path in finished.rglob("*") if files.is_partial(path)]
    table, manifest = read_table(finished / "evaluations" / "last"), read_manifest(finished / "evaluations" / "last")
    assert set(table["policy"]) == {"human", "uncommanded", "ppo"} and manifest.complete
    record = manifest.policies["ppo"][0]
    assert (record.algo, record.frames) == ("ppo", 600) and record.weights
    assert (finished / "evaluations" / "last" / (record.source or "")).resolve() == checkpoint.find(finished).resolve()


def test_the_policy_of_a_run_can_be_used(finished: Path) -> None:
    policy = run_folder.load_algorithm(finished)[0].policy.eval()
    features = len(observation_names(run_folder.read_config(finished).env))
    agents = {"observation": torch.randn(7, features), "mask": torch.ones(7, dtype=torch.bool)}
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = policy(TensorDict({"agents": TensorDict(agents, [7])}, []))["agents", "action"]
    assert action.shape == (7, 1)
    assert float(action.min()) >= -4.5 and float(action.max()) <= 2.6


def test_an_occupied_run_folder_is_refused(finished: Path, refused: Refused) -> None:
    before = sorted(finished.rglob("*"))
    refused(train.main, [*TOY, f"run_dir={finished}"], "resume=")
    assert sorted(finished.rglob("*")) == before


@pytest.mark.slow
def test_same_seed_same_weights_and_another_seed_others(finished: Path, tmp_path: Path) -> None:
    for name, seed in (("again", 0), ("other", 1)):
        assert train.main([*TOY, "total_frames=600", f"seed={seed}", f"run_dir={tmp_path / name}"]) == 0
    first, again, other = (weights(folder) for folder in (finished, tmp_path / "again", tmp_path / "other"))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not all(torch.equal(first[key], other[key]) for key in first)


def test_resume_goes_on_where_the_run_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    run_dir = tmp_path / "run"
    assert train.main([*TOY, "collector=single", "total_frames=400", f"run_dir={run_dir}"]) == 0
    assert train.main([f"resume={run_dir}", "total_frames=800"]) == 0
    assert [int(row["frames"]) for row in rows(run_dir)] == [200, 400, 600, 800]
    assert run_folder.read_config(run_dir).total_frames == 800
    assert run_folder.read_config(run_dir).contexts.preset == "easy"
    refused(train.main, [f"resume={run_dir}", "algo.lr=1e-3"], "algo.lr")
    said = "has 800 frames already, more than total_frames=400"
    refused(train.main, [f"resume={run_dir}", "total_frames=400"], said)
    assert run_folder.read_config(run_dir).total_frames == 800
    # Its last batch went beyond its frames: the run is done, and that is no mistake.
    run_folder.write_config(run_dir, dataclasses.replace(run_folder.read_config(run_dir), total_frames=700))
    assert train.main([f"resume={run_dir}"]) == 0
    assert "All 800 frames are there" in capsys.readouterr().out
    # From an earlier checkpoint: what came later is forgotten, and the table written again.
    assert train.main([f"resume={checkpoint.listed(run_dir)[0]}", "total_frames=600"]) == 0
    assert [int(row["frames"]) for row in rows(run_dir)] == [200, 400, 600]
    assert checkpoint.frames_of(checkpoint.listed(run_dir)[-1]) == 600


def test_ctrl_c_once_finishes_in_good_order(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    words = [*TOY, "total_frames=100000000", "checkpoint.every_batches=3"]
    process = begun(run_dir, words, lambda: checkpoint.listed(run_dir))
    os.killpg(process.pid, signal.SIGINT)  # a terminal reaches the whole group, workers included
    output, error = process.communicate(timeout=120)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert f"of 100,000,000 frames; go on with: python -m izoo.train resume={run_dir}" in output
    state = checkpoint.load(checkpoint.find(run_dir))
    assert state["frames"] == int(rows(run_dir)[-1]["frames"])


@pytest.mark.slow
def test_ctrl_c_ends_a_sweep_with_its_present_run(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "izoo.train", "-m", "seed=0,1", *TOY, "total_frames=100000000"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None and not list(tmp_path.rglob("step-*.pt")):
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    output, error = process.communicate(timeout=120)
    assert process.returncode == 130 and "Traceback" not in error
    assert len(list(tmp_path.rglob("metrics.csv"))) == 1 and "Stopped at" in output


def test_the_table_grows_columns_and_leaves_unknown_numbers_empty(tmp_path: Path) -> None:
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append({"frames": 10, "reward": 0.5})
    table.append({"frames": 20, "reward": 0.25, "return": -3.0})
    table.append({"frames": 30, "reward": 0.125})
    again = MetricsTable(tmp_path / "metrics.csv", last_frames=20)
    assert again.series("return") == ([20], [-3.0])
    assert again.series("reward") == ([10, 20], [0.5, 0.25])


@pytest.mark.slow
def test_logger_wandb_is_offline_and_silent(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    command = [sys.executable, "-m", "izoo.train", *TOY, "total_frames=200", "logger=wandb", f"run_dir={run_dir}"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("WANDB")}
    done = subprocess.run(
        command, env={**environment, "HOME": str(tmp_path)}, capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert "wandb" not in (done.stdout + done.stderr).replace(str(run_dir), "")
    assert list((run_dir / "wandb").glob("offline-run-*"))


def test_total_frames_are_rounded_up_to_whole_batches_of_all_workers() -> None:
    config = compose_config(TrainConfig, ["num_workers=3", "algo.frames_per_batch=100"])
    assert config.batch_frames == 102


def test_a_resumed_run_keeps_its_own_options_in_python_too(tmp_path: Path) -> None:
    run_folder.write_config(tmp_path, compose_config(TrainConfig, TOY))
    kept = (tmp_path / "config.yaml").read_text()
    own = run_folder.resumed(tmp_path)
    with pytest.raises(IzooError, match=r"run_folder\.resumed .* was begun with other settings \(seed 0 -> 1\)"):
        loop.train(dataclasses.replace(own, seed=own.seed + 1))
    assert (tmp_path / "config.yaml").read_text() == kept


def test_checkpoints_hold_no_code(tmp_path: Path) -> None:
    path = tmp_path / "checkpoints" / "step-000000000001.pt"
    path.parent.mkdir()
    torch.save({"format": checkpoint.FORMAT, "evil": Path("x")}, path)
    with pytest.raises(IzooError):
        checkpoint.load(path)
