"""Algorithms by name: what the registry offers can be chosen and built."""

import dataclasses
from pathlib import Path

import pytest
import torch

from izoo import train
from izoo.algos.learners.registry import ALGORITHMS, choices, make_algorithm, preset
from izoo.cli.compose import compose_config
from izoo.conf.mapping import from_mapping
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.training import run_folder


@pytest.mark.parametrize("choice", choices())
def test_every_choice_composes_and_builds(choice: str) -> None:
    config = compose_config(TrainConfig, [f"algo={choice}"])
    assert config.algo == preset(choice)
    small = {"hidden": (8,)} if hasattr(config.algo, "hidden") else {}
    algo = dataclasses.replace(config.algo, **small)  # type: ignore[arg-type]
    assert make_algorithm(algo, config.action, config.env).policy is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ALGORITHMS if name not in ("cmaes", "glide_search")])
def test_algorithms_learn_whatever_the_default_type_of_numbers_is(name: str, tmp_path: Path) -> None:
    """They compute in that of the observations."""
    words = ["contexts=pcg_easy", "env.horizon_s=75", "evaluation.contexts=0", "validation.every_batches=0"]
    words += ["simulator=twin", "num_envs=2", "twin.threads=1", "total_frames=200", "algo.frames_per_batch=100"]
    words += [f"algo={name}", "algo.hidden=[8]", f"run_dir={tmp_path / 'run'}"]
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert train.main(words) == 0
        state = run_folder.load_algorithm(tmp_path / "run")[0].policy.state_dict()
    finally:
        torch.set_default_dtype(before)
    assert {tensor.dtype for tensor in state.values() if tensor.is_floating_point()} == {torch.float32}


def test_unknown_names_are_refused_by_the_legal_ones() -> None:
    with pytest.raises(IzooError, match="Did you mean 'ppo'"):
        preset("pppo")
    with pytest.raises(IzooError, match="unknown algo 'sarsa'"):
        from_mapping(TrainConfig, {"algo": {"name": "sarsa"}})
    with pytest.raises(IzooError, match="group of options"):
        from_mapping(TrainConfig, {"algo": "ppo"})
