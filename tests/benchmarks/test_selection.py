"""Which weights of a training run the benchmark tests."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from izoo.benchmarks.campaign import Campaign
from izoo.benchmarks.contestants import _selected, untrained
from izoo.benchmarks.generalization_options import GeneralizationConfig
from izoo.benchmarks.training_runs import trained_for_s
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.training import checkpoint
from izoo.training.learner import Learner


@pytest.mark.parametrize("validated", [True, False])
def test_the_best_weights_are_those_of_validation(
    validated: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    for frames in (100, 200):
        checkpoint.save(tmp_path / "run", frames, {"features": 1}, keep=2)
    first = checkpoint.listed(tmp_path / "run")[0]
    if validated:
        (checkpoint.folder_of(tmp_path / "run") / checkpoint.BEST).write_bytes(first.read_bytes())
    chosen = {}
    for select in ("last", "best"):
        config = GeneralizationConfig(protocol="systematicity", algos=("uncommanded",), select=select).resolved()
        chosen[select] = checkpoint.load(_selected(config, tmp_path / "run"))["frames"]
    assert chosen == {"last": 200, "best": 100 if validated else 200}
    assert ("too short" in capsys.readouterr().out) != validated


def test_an_untrained_entry_is_what_the_run_of_that_seed_begins_with() -> None:
    config = dataclasses.replace(TrainConfig(), seed=3)
    torch.manual_seed(3)
    begun = Learner(config, torch.device("cpu")).policy.state_dict()
    torch.manual_seed(0)
    entry, other = (untrained(c).state_dict() for c in (config, TrainConfig()))
    weights = [name for name in begun if hasattr(begun[name], "dim") and begun[name].dim() == 2]
    assert weights and all(torch.equal(begun[name], entry[name]) for name in weights)
    assert not all(torch.equal(begun[name], other[name]) for name in weights)


def test_every_training_seed_is_also_tested_as_it_begins(tmp_path: Path) -> None:
    """Else what seeds differ by before they learn would pass for what they learned differently."""
    config = GeneralizationConfig(protocol="systematicity", algos=("ppo", "glide"), seeds=3).resolved()
    benchmark = Campaign(config, tmp_path)
    assert {entry.name: len(entry.runs) for entry in benchmark.results.entries} == {
        **{"ppo": 3, "ppo_untrained": 3},
        **{"glide": 1, "uncommanded": 1, "constant_2.0": 1},
    }
    tested = [str(job) for job in benchmark.jobs() if job.kind == "evaluate"]
    assert tested[:3] == ["evaluate glide", "evaluate uncommanded", "evaluate constant_2.0"]
    assert tested[3:] == [f"evaluate {name}, seed {seed}" for seed in range(3) for name in ("ppo_untrained", "ppo")]
    places = {run.evaluation for entry in benchmark.results.entries for run in entry.runs}
    assert len(places) == 9, "two runs would share a folder"


def test_the_time_that_a_run_took_is_read_as_its_own_table_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    assert trained_for_s(tmp_path) == 0.0
    path.write_text("frames,seconds,return\n100,1.5,-3\n200,2.5,\n300,9")  # the last row was cut off
    assert trained_for_s(tmp_path) == 2.5
    for damage in (bytes(range(256)) * 8, b"frames,seconds\n100,soon\n", b"<html></html>\n1,2,3\n"):
        path.write_bytes(damage)
        with pytest.raises(IzooError, match=r"cannot read .*metrics\.csv: .*; restore it, or remove it"):
            trained_for_s(tmp_path)


def test_a_run_that_owes_a_validation_is_not_trained(tmp_path: Path) -> None:
    """Else a benchmark that is killed during the last validation would test other weights than one that is not."""
    trained = {}
    for select in ("last", "best"):
        config = GeneralizationConfig(protocol="systematicity", algos=("ppo",), select=select, frames=200).resolved()
        benchmark = Campaign(config, tmp_path / select)
        job = next(job for job in benchmark.jobs() if job.kind == "train")
        run_dir = benchmark.runs.run_dir(job.key)
        run_dir.mkdir(parents=True)
        last = checkpoint.save(run_dir, 200, {"features": 1}, keep=2)
        assert benchmark.runs.is_trained(job.key)
        candidate = checkpoint.make_candidate(last)
        trained[select] = benchmark.runs.is_trained(job.key)
        checkpoint.make_best(candidate)
        assert benchmark.runs.is_trained(job.key)
    assert trained == {"last": True, "best": False}
