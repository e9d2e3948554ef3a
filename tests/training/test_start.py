"""A run that begins with the policy of another."""

import shutil
from pathlib import Path

import pytest
import torch

from izoo import collect, train
from izoo.conf.train_options import CollectConfig
from izoo.training import checkpoint, run_folder
from izoo.training.offline import make_policy
from tests.conftest import Refused

TOY = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=100", "simulator=twin", "num_envs=2"),
    *("twin.threads=1", "twin.compare_every=0", "action=advise", "algo.hidden=[16]", "algo.frames_per_batch=100"),
    *("algo.minibatch_rows=64", "evaluation.contexts=0", "validation.every_batches=0", "total_frames=100"),
]


def weights(run_dir: Path) -> dict[str, torch.Tensor]:
    return checkpoint.load(checkpoint.find(run_dir))["algorithm"]["policy"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("start") / "first"
    assert train.main([*TOY, "algo=ppo", "algo.lr=0.01", "seed=1", f"run_dir={run_dir}"]) == 0
    return run_dir


def test_it_begins_there_with_whatever_value_function(trained: Path, tmp_path: Path) -> None:
    """At a learning rate of next to nothing the policy stays what it was; without ``start`` it is another."""
    team = ["algo=mappo", "env.reward=fuel_team", "algo.credit=team", "algo.lr=1e-12", "algo.value_norm=running"]
    begun, anew = tmp_path / "begun", tmp_path / "anew"
    assert train.main([*TOY, *team, f"start={trained}", f"run_dir={begun}"]) == 0
    assert train.main([*TOY, *team, f"run_dir={anew}"]) == 0
    for name, leaf in weights(trained).items():
        torch.testing.assert_close(weights(begun)[name], leaf)
    assert not all(torch.allclose(weights(anew)[name], leaf) for name, leaf in weights(trained).items())
    assert run_folder.read_config(begun).start == str(trained)


def test_a_run_that_stopped_before_its_first_checkpoint_begins_there_again(trained: Path, tmp_path: Path) -> None:
    """As after the loss of the process: the options are there, and a part of the table."""
    run_dir = tmp_path / "run"
    assert train.main([*TOY, "algo=ppo", "algo.lr=1e-12", f"start={trained}", f"run_dir={run_dir}"]) == 0
    shutil.rmtree(run_dir / "checkpoints")
    assert train.main([f"resume={run_dir}"]) == 0
    for name, leaf in weights(trained).items():
        torch.testing.assert_close(weights(run_dir)[name], leaf)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["algo.hidden=[8]"], "other options (algo.hidden: [16])"),
        (["algo.activation=relu"], "other options (algo.activation: tanh); give the same here"),
        (["env.hold_s=2"], "other options (seconds of a decision: 0.5)"),
        (["algo=gcrl"], "a run of algo=ppo, whose policy has other networks than that of algo=gcrl"),
        (["env.observed=[speed_limit_mps]"], "other options (observes"),
        (["action.depth=0.5"], "other options (action"),
        (["algo=ddpg"], "choose algo=ppo, mappo or gcrl"),
    ],
)
def test_what_does_not_fit_is_refused_and_leaves_nothing(
    trained: Path, tmp_path: Path, words: list[str], message: str, refused: Refused
) -> None:
    toy = [word for word in TOY if word.partition("=")[0] not in {given.partition("=")[0] for given in words}]
    if words == ["algo=ddpg"]:
        toy = [word for word in toy if not word.startswith("algo.minibatch")]
    said = refused(train.main, [*toy, *words, f"start={trained}", f"run_dir={tmp_path / 'runs' / 'run'}"])
    assert message.lower() in said.lower()
    assert not (tmp_path / "runs").exists()


def test_a_policy_collects_with_its_own_length_of_a_decision(trained: Path, tmp_path: Path, refused: Refused) -> None:
    words = ["contexts=pcg_easy", f"policy={trained}", "frames=10", f"out={tmp_path / 'data'}", "env.hold_s=2"]
    refused(collect.main, words, "decides every 0.5 s, and env every 2 s; set env.hold_s=0.5.")
    assert not (tmp_path / "data").exists()


def test_what_collects_is_the_policy_and_not_its_search(tmp_path: Path) -> None:
    search = ["algo=cmaes", "algo.population=4", "num_envs=4"]
    words = [word for word in TOY if not word.startswith(("algo.", "num_envs"))]
    run_dir = tmp_path / "run"
    assert train.main([*words, *search, f"run_dir={run_dir}"]) == 0
    config = CollectConfig(policy=str(run_dir), env=run_folder.read_config(run_dir).env)
    assert not make_policy(config).training
