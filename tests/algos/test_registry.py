"""Algorithms by name: what the registry offers can be chosen and built, and a line gives a further one a name."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from izoo import train
from izoo.algos.learners import registry
from izoo.algos.learners.registry import ALGORITHMS, Home, choices, make_algorithm, preset
from izoo.cli.option_command import compose_config
from izoo.conf.choices import groups
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.options import from_mapping
from izoo.training import run_folder

NEW = '''
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule

from izoo.algos.learners.registry import AlgoConfig


@dataclass(frozen=True)
class CalmConfig(AlgoConfig):
    """Options of an algorithm that learns nothing.

    Attributes:
        name: the algorithm.
        frames_per_batch: environment steps between two updates.
        accel_mps2: what every vehicle is told.
    """

    name: str = "calm"
    frames_per_batch: int = 100
    accel_mps2: float = 0.25

    @classmethod
    def slow(cls):
        return cls(accel_mps2=0.1)


class Calm:
    options = CalmConfig

    def __init__(self, config, features, space, device="cpu"):
        self.accel = torch.nn.Parameter(torch.tensor(config.accel_mps2))
        act = lambda observation: self.accel.detach().expand(*observation.shape[:-1], 1).clone()
        self.policy = TensorDictModule(act, [("agents", "observation")], [("agents", "action")])

    def update(self, batch, progress):
        return {}

    def state_dict(self):
        return {"accel": self.accel.detach()}

    def load_state_dict(self, state):
        self.accel.data.copy_(state["accel"])
'''


@pytest.fixture
def calm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A further algorithm: one file, and one line of the registry."""
    (tmp_path / "calm_algorithm.py").write_text(NEW)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(ALGORITHMS, "calm", Home("calm_algorithm:Calm", ("slow",)))
    groups.cache_clear()
    yield
    groups.cache_clear()


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


@pytest.mark.usefixtures("calm")
def test_an_algorithm_is_one_file_and_one_line(tmp_path: Path) -> None:
    assert {"calm", "calm_slow"} <= set(registry.choices())
    config = compose_config(TrainConfig, ["algo=calm_slow", "algo.frames_per_batch=50"])
    assert (config.algo.name, config.algo.frames_per_batch) == ("calm", 50)
    assert getattr(config.algo, "accel_mps2") == 0.1  # noqa: B009
    with pytest.raises(IzooError, match="It is an option of algo=calm and algo=calm_slow"):
        compose_config(TrainConfig, ["algo.accel_mps2=1"])
    run_folder.write_config(tmp_path, config)
    assert run_folder.read_config(tmp_path) == config
    assert make_algorithm(config.algo, config.action, config.env).update(None, 0.0) == {}  # type: ignore[arg-type]
