"""What holds of every learner: empty slots do not count, nor does their order; states restore the very next update."""

from __future__ import annotations

import copy
import io
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.learners import base
from izoo.algos.learners.ddpg import DDPG
from izoo.algos.learners.ddpg_config import DDPGConfig, TD3Config
from izoo.algos.learners.graph_ppo import GCRL
from izoo.algos.learners.mappo import MAPPO
from izoo.algos.learners.ppo import PPO
from izoo.algos.learners.ppo_config import GCRLConfig, MAPPOConfig, PPOConfig
from izoo.algos.learners.td3 import TD3
from tests.algos.frames import FEATURES, HIGH, LOW, make_frames

ON: dict[str, Any] = {"hidden": (8, 8), "minibatch_rows": 7}
OFF: dict[str, Any] = {"hidden": (8,), "minibatch_rows": 16, "replay_rows": 40, "learning_starts": 0}
OFF |= {"rows_per_frame": None, "n_step": 1}
LEARNERS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "ppo": (PPO, PPOConfig, {**ON, "kl_coeff": 0.2}),
    "ppo-running": (PPO, PPOConfig, {**ON, "value_norm": "running"}),
    "ppo-popart": (PPO, PPOConfig, {**ON, "value_norm": "popart"}),
    "mappo": (MAPPO, MAPPOConfig, {**ON, "critic_queries": 2, "critic_embedding": 6, "kl_coeff": 0.2}),
    "gcrl": (GCRL, GCRLConfig, {**ON, "neighbours": 1, "range_m": 400.0, "heads": 2}),
    "ddpg": (DDPG, DDPGConfig, OFF),
    "ddpg-prioritised": (DDPG, DDPGConfig, {**OFF, "priority_alpha": 0.6}),
    "td3": (TD3, TD3Config, {**OFF, "updates_per_frame": 0.25}),
}
"""With an odd number of TD3's gradient steps per batch: whose turn it is belongs to the state."""
every = pytest.mark.parametrize("name", LEARNERS)


def make(name: str, **changes: object) -> Any:
    algorithm, config, small = LEARNERS[name]
    torch.manual_seed(3)
    return algorithm(config(**{**small, **changes}), FEATURES, LOW, HIGH)


def act(algorithm: Any, batch: TensorDict, seed: int = 1) -> TensorDict:
    torch.manual_seed(seed)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return algorithm.policy(batch.clone())


def update(algorithm: Any, batch: TensorDict, progress: float = 0.0, seed: int = 7) -> dict[str, float]:
    torch.manual_seed(seed)
    return algorithm.update(batch, progress)


def assert_same(one: Any, other: Any, atol: float = 0.0) -> None:
    for mine, theirs in zip(one.loss.parameters(), other.loss.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, atol=atol, rtol=0.0)


@pytest.mark.parametrize("noise", [1e6, float("nan")])
@every
def test_padding_changes_nothing(name: str, noise: float) -> None:
    one, other = make(name), make(name)
    clean = act(one, make_frames())
    noisy = clean.clone()
    for group in (noisy["agents"], noisy["next", "agents"]):
        for key in set(group.keys()) & {"observation", "action", "loc", "scale", "action_log_prob"}:
            group[key][~group["mask"]] = noise
    noisy["next", "agents", "reward"][~noisy[base.MASK]] = noise
    assert update(other, noisy) == pytest.approx(update(one, clean), rel=1e-6)
    assert_same(one, other, atol=1e-6)


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
def test_slot_order_and_slot_count_change_nothing(name: str) -> None:
    """One gradient step over all rows is the same; off-policy rows are those of :mod:`tests.algos.test_losses`."""
    whole = {"rows_per_epoch": None, "minibatch_rows": 10_000, "epochs": 1}
    one, other = make(name, **whole), make(name, **whole)
    batch, order = act(one, make_frames()), torch.tensor([2, 3, 0, 1])
    wide = TensorDict(batch_size=batch.batch_size)
    for place in ("agents", ("next", "agents")):
        group = batch[place]
        wide[place] = torch.cat([torch.zeros_like(group[..., :3]), group[..., order]], -1)
    assert update(other, wide) == pytest.approx(update(one, batch), rel=1e-3, abs=1e-5)
    assert_same(one, other, atol=1e-3)  # Adam turns rounding into steps where a gradient is 0 but for rounding


@every
def test_state_restores_the_very_next_updates(name: str) -> None:
    one, other = make(name), make(name)
    for seed in range(3):
        update(one, act(one, make_frames(seed=seed), seed), 0.1, seed)
    file = io.BytesIO()
    torch.save(copy.deepcopy(one.state_dict()), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    for seed in range(3, 6):
        batches = [act(algorithm, make_frames(seed=seed), seed) for algorithm in (one, other)]
        assert torch.equal(batches[0][base.ACTION], batches[1][base.ACTION])
        assert update(one, batches[0], 0.2, seed) == update(other, batches[1], 0.2, seed)
    assert_same(one, other)


@every
def test_an_empty_batch_is_no_update(name: str) -> None:
    algorithm = make(name)
    batch = act(algorithm, make_frames())
    batch[base.MASK][:] = False
    before = [parameter.clone() for parameter in algorithm.loss.parameters()]
    assert not [key for key in update(algorithm, batch) if key.startswith("loss")]
    for parameter, old in zip(algorithm.loss.parameters(), before, strict=True):
        torch.testing.assert_close(parameter, old)


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
def test_on_policy_updates_improve_a_bandit(name: str) -> None:
    """Reward is the acceleration itself: the mean action must rise."""
    algorithm = make(name, lr=1e-2, anneal_lr=False, gamma=0.0, epochs=2, minibatch_rows=64)
    means = []
    for round_ in range(10):
        batch = act(algorithm, make_frames(n=4, t=16, seed=round_), round_)
        batch["next", "agents", "reward"] = batch[base.ACTION].clone()
        means.append(float(batch[base.ACTION][batch[base.MASK]].mean()))
        algorithm.update(batch, 0.0)
    assert means[-1] > means[0] + 0.5


@pytest.mark.parametrize(("name", "actor_lr"), [("ddpg", 1e-3), ("td3", 2e-3)])
def test_off_policy_updates_improve_a_bandit(name: str, actor_lr: float) -> None:
    """Reward falls with the distance from 1 m/s^2: the actor must move there."""
    settings = {"gamma": 0.0, "reward_scale": 1.0, "critic_lr": 1e-2, "actor_lr": actor_lr, "tau": 0.005}
    sizes = {"replay_rows": 10_000, "minibatch_rows": 256, "hidden": (32,), "updates_per_frame": 0.1}
    algorithm = make(name, **settings, **sizes, saturation_coeff=1e-3)
    for round_ in range(14):
        batch = make_frames(n=8, t=60, seed=round_)
        batch[base.ACTION] = torch.rand(*batch[base.MASK].shape, 1) * (HIGH - LOW) + LOW
        batch["next", "agents", "reward"] = -(((batch[base.ACTION] - 1.0) / 3) ** 2)
        algorithm.update(batch, 0.0)
    batch = make_frames()
    with torch.no_grad():
        action = algorithm.actor.module(batch[base.OBSERVATION])[batch[base.MASK]]
    assert float((action - 1.0).abs().mean()) < 0.5
