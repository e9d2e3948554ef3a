"""The learner's device: batches cross to it in one place, and weights come back."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import train
from izoo.algos.actions.action_modes import ResidualAction
from izoo.algos.learners import base
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.graph_ppo import GCRLConfig
from izoo.algos.learners.mappo import MAPPOConfig
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.algos.learners.td3 import TD3Config
from izoo.conf.train_options import TrainConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.training.learner import Learner, learner_device, to_learner
from tests.algos import frames
from tests.conftest import Refused

CPU, OTHER = torch.device("cpu"), torch.device("cpu:0")
"""``cpu:0`` counts as another device, so that everything a GPU needs to be done is done, on a machine without one."""
FEATURES = len(observation_names(TrainConfig().env))
OFF: dict[str, Any] = {"hidden": (8,), "minibatch_rows": 16, "learning_starts": 1, "replay_rows": 200}
CONFIGS = {
    "ppo": TrainConfig(algo=PPOConfig(hidden=(8,), minibatch_rows=16)),
    "mappo": TrainConfig(algo=MAPPOConfig(hidden=(8, 8), minibatch_rows=16)),
    "gcrl": TrainConfig(algo=GCRLConfig(hidden=(8,), minibatch_rows=16)),
    "ddpg": TrainConfig(algo=DDPGConfig(**OFF)),
    "td3": TrainConfig(algo=TD3Config(**OFF)),
    "prioritised": TrainConfig(algo=DDPGConfig(**OFF, priority_alpha=0.6)),
    "residual": TrainConfig(algo=PPOConfig(hidden=(8,), minibatch_rows=16), action=ResidualAction()),
}


def collect(learner: Learner, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A batch as the learner's policy would have collected it."""
    monkeypatch.setattr(frames, "FEATURES", FEATURES)
    batch = frames.make_frames()
    torch.manual_seed(1)
    with torch.no_grad():
        return learner.policy(batch)


def make(name: str, device: torch.device) -> Learner:
    torch.manual_seed(0)
    config = CONFIGS[name]
    return Learner(make_algorithm(config.algo, config.action, config.env, device), config, device)


def test_exploration_goes_on_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Elsewhere a copy of the policy collects, and the noise is the copy's."""
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = make("ddpg", OTHER), make("ddpg", OTHER)
        collect(first, monkeypatch)
        noise = first.policy.noise.clone()
        assert noise.any()
        second.load_state_dict(copy.deepcopy(first.state_dict()))
        assert torch.equal(second.policy.noise, noise)
        assert torch.equal(collect(first, monkeypatch)[base.ACTION], collect(second, monkeypatch)[base.ACTION])


def weights(policy: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in policy.state_dict().items() if torch.is_tensor(value)}


@pytest.mark.parametrize("name", CONFIGS)
def test_learning_elsewhere_is_the_same_and_its_weights_come_back(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = make(name, CPU), make(name, OTHER)
    assert here.policy is here.algorithm.policy and there.policy is not there.algorithm.policy
    before = weights(there.policy)
    for learner in (here, there):
        batch = collect(learner, monkeypatch)
        torch.manual_seed(2)
        learner.update(batch, 0.25)
    after = weights(there.policy)
    assert any(not torch.equal(before[key], after[key]) for key in after), "learning changed nothing"
    for key, value in weights(here.policy).items():
        assert torch.equal(value, after[key]), key


@pytest.mark.parametrize("name", ["ppo", "ddpg"])
def test_what_was_learned_on_one_device_goes_on_on_another(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first = make(name, OTHER)
    first.update(collect(first, monkeypatch), 0.25)
    state = copy.deepcopy(first.state_dict())
    second = make(name, CPU)
    second.load_state_dict(state)
    assert torch.equal(torch.get_rng_state(), state["torch_rng"])
    expected = weights(first.policy)
    assert all(torch.equal(value, expected[key]) for key, value in weights(second.policy).items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("resumed", [False, True])
def test_gradient_steps_that_a_gpu_replays_learn_what_those_that_are_launched_do(
    monkeypatch: pytest.MonkeyPatch, resumed: bool
) -> None:
    found = []
    for replays in (True, False):
        learner = make("ppo", torch.device("cuda"))
        assert learner.algorithm._replayed is not None
        if not replays:
            learner.algorithm._replayed = None
        for progress in (0.0, 0.5):
            batch = collect(learner, monkeypatch)
            torch.manual_seed(2)
            stats = learner.update(batch, progress)
            assert stats["gradient_steps"] > 4 and stats["lr"] == pytest.approx(5e-4 * (1.0 - progress))
            if resumed:
                learner.load_state_dict(copy.deepcopy(learner.state_dict()))
        found.append((stats, weights(learner.policy)))
    (one, replayed), (other, launched) = found
    assert one == pytest.approx(other, rel=1e-3, abs=1e-5)
    for key, value in launched.items():
        torch.testing.assert_close(replayed[key], value, rtol=1e-4, atol=1e-6)


def test_batches_cross_whole_but_for_observations_of_empty_slots() -> None:
    batch = frames.make_frames()
    assert to_learner(batch, CPU) is batch
    moved = to_learner(batch, OTHER)
    assert set(moved.keys(True, True)) == set(batch.keys(True, True))
    for place in ((), ("next",)):
        mask, seen = batch.get((*place, "agents", "mask")), batch.get((*place, "agents", "observation"))
        assert torch.equal(moved.get((*place, "agents", "observation")), seen * mask.unsqueeze(-1))


def test_a_missing_gpu_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, refused: Refused) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(IzooError, match="PyTorch finds no GPU"):
        learner_device("cuda")
    assert learner_device("auto") == CPU
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert learner_device("auto") == torch.device("cuda")
    monkeypatch.undo()
    if not torch.cuda.is_available():
        refused(train.main, ["device=cuda", f"run_dir={tmp_path / 'run'}"], "choose device=cpu")
        assert not (tmp_path / "run").exists()
