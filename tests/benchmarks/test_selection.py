"""Which weights of a training run the benchmark tests, and which jobs it has."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from izoo.benchmarks.campaign.generalization_options import GeneralizationConfig
from izoo.benchmarks.campaign.jobs import Campaign
from izoo.benchmarks.campaign.policies import selected, untrained
from izoo.conf.train_options import TrainConfig
from izoo.training import checkpoint
from izoo.training.learner import Learner


@pytest.mark.parametrize("validated", [True, False])
def test_the_best_weights_are_those_of_validation(validated: bool, tmp_path: Path) -> None:
    for frames in (100, 200):
        checkpoint.save(tmp_path, frames, {"features": 1}, keep=2)
    first = checkpoint.listed(tmp_path)[0]
    if validated:
        (checkpoint.folder_of(tmp_path) / checkpoint.BEST).write_bytes(first.read_bytes())
    chosen = {select: checkpoint.load(selected(tmp_path, select))["frames"] for select in ("last", "best")}
    assert chosen == {"last": 200, "best": 100 if validated else 200}


def test_an_untrained_entry_is_what_the_run_of_that_seed_begins_with() -> None:
    config = dataclasses.replace(TrainConfig(), seed=3)
    torch.manual_seed(3)
    begun = Learner(config, torch.device("cpu")).policy.state_dict()
    torch.manual_seed(0)
    entry, other = (untrained(c).state_dict() for c in (config, TrainConfig()))
    weights = [name for name in begun if hasattr(begun[name], "dim") and begun[name].dim() == 2]
    assert weights and all(torch.equal(begun[name], entry[name]) for name in weights)
    assert not all(torch.equal(begun[name], other[name]) for name in weights)


def campaign(folder: Path, *algos: str, **options: object) -> Campaign:
    config = GeneralizationConfig(protocol="systematicity", algos=algos, **options)  # type: ignore[arg-type]
    return Campaign(config.resolved(), folder)


def test_every_training_seed_is_also_tested_as_it_begins(tmp_path: Path) -> None:
    """Otherwise differences between seeds before training would pass for differences in what they learned."""
    tested = [str(job) for job in campaign(tmp_path, "ppo", "glide", seeds=3).jobs() if job.kind == "evaluate"]
    scripted = ("human", "uncommanded", "glide", "constant_2.0", "cap_0.6")
    assert tested[:5] == [f"evaluate {name}" for name in scripted]
    assert tested[5:] == [f"evaluate {name}, seed {seed}" for seed in range(3) for name in ("ppo_untrained", "ppo")]


def test_a_run_that_owes_a_validation_is_not_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a benchmark that is killed during the last validation would test other weights."""
    monkeypatch.setattr("izoo.benchmarks.campaign.training_runs._check", lambda *_: None)
    trained = {}
    for select in ("last", "best"):
        runs, key = campaign(tmp_path / select, "ppo", select=select, frames=200, seeds=1).runs, ("ppo", 0)
        runs.run_dir(key).mkdir(parents=True)
        last = checkpoint.save(runs.run_dir(key), 200, {"features": 1}, keep=2)
        assert runs.is_trained(key)
        candidate = checkpoint.make_candidate(last)
        trained[select] = runs.is_trained(key)
        checkpoint.make_best(candidate)
        assert runs.is_trained(key)
    assert trained == {"last": True, "best": False}
