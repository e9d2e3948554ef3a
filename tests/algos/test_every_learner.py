"""What holds of every learner: empty slots do not count, nor does their order; states restore the very next update."""

import copy
import io
import itertools
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType

from izoo.algos.learners import base
from izoo.algos.learners.ddpg import DDPG, DDPGConfig
from izoo.algos.learners.graph_ppo import GCRL, GCRLConfig
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.learners.ppo import PPO, PPOConfig
from izoo.algos.learners.td3 import TD3, TD3Config
from tests.algos.frames import FEATURES, HIGH, LOW, SPACE, act, alone, make_frames, reordered, shake, with_noise

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
    return algorithm(config(**{**small, **changes}), FEATURES, SPACE)


def update(algorithm: Any, batch: TensorDict, progress: float = 0.0, seed: int = 7) -> dict[str, float]:
    torch.manual_seed(seed)
    return algorithm.update(batch, progress)


def assert_same(one: Any, other: Any, atol: float = 0.0) -> None:
    for mine, theirs in zip(one.loss.parameters(), other.loss.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, atol=atol, rtol=0.0)


def values_alone(algorithm: Any, frames: TensorDict) -> torch.Tensor:
    """Values ``[N, T, A]``, one frame at a time, of its valid agents alone."""
    if isinstance(algorithm, (MAPPO, GCRL)):
        return alone(algorithm, frames[base.OBSERVATION], frames[base.MASK])
    with torch.no_grad():
        return algorithm.critic.module(frames[base.OBSERVATION]).squeeze(-1)


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
def test_advantages_equal_the_recursion_by_hand(name: str) -> None:
    algorithm = make(name)
    batch = act(algorithm, make_frames())
    rows, mask, config = algorithm.advantages(batch), batch[base.MASK], algorithm.config
    value, following = (values_alone(algorithm, part) for part in (batch, batch["next"]))
    done, terminated = (batch["next", "agents", key].squeeze(-1) for key in ("done", "terminated"))
    reward = batch["next", "agents", "reward"].squeeze(-1) * config.reward_scale
    advantage = torch.zeros_like(value)
    for n, a in itertools.product(range(value.shape[0]), range(value.shape[2])):
        running = 0.0
        for t in reversed(range(value.shape[1])):
            bootstrap = 0.0 if terminated[n, t, a] else float(following[n, t, a])
            delta = float(reward[n, t, a]) + config.gamma * bootstrap - float(value[n, t, a])
            running = delta + config.gamma * config.gae_lambda * (0.0 if done[n, t, a] else running)
            advantage[n, t, a] = running if mask[n, t, a] else 0.0
    torch.testing.assert_close(rows[base.VALUE_TARGET].squeeze(-1), (advantage + value)[mask], atol=1e-5, rtol=1e-5)
    valid = advantage[mask]
    expected = (valid - valid.mean()) / valid.std()
    torch.testing.assert_close(rows[base.ADVANTAGE].squeeze(-1), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
def test_losses_equal_a_hand_computation(name: str) -> None:
    algorithm = make(name, clip_epsilon=0.1, value_loss="l2", value_coeff=0.5, entropy_coeff=0.0, kl_coeff=0.0)
    batch = act(algorithm, make_frames())
    rows, mask = algorithm.advantages(batch), batch[base.MASK]
    shake(algorithm.loss)
    with torch.no_grad():
        losses = algorithm.loss(rows)
    now = act(algorithm, batch, kind=ExplorationType.DETERMINISTIC)
    loc, scale, action = now[base.LOC][mask], now[base.SCALE][mask], batch[base.ACTION][mask]
    squashed = (action - (HIGH + LOW) / 2) / ((HIGH - LOW) / 2)
    log_prob = -0.5 * ((torch.atanh(squashed) - loc) / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)
    log_prob = log_prob - torch.log((HIGH - LOW) / 2 * (1 - squashed**2))
    ratio = (log_prob.squeeze(-1) - batch[base.LOG_PROB][mask]).exp()
    advantage = rows[base.ADVANTAGE].squeeze(-1)
    clipped = torch.minimum(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage)
    error = (values_alone(algorithm, batch)[mask] - rows[base.VALUE_TARGET].squeeze(-1)) ** 2
    assert float((ratio.clamp(0.9, 1.1) != ratio).float().mean()) > 0.2, "the clipping must matter in this test"
    # TorchRL clips the log of the ratio to log(1 -+ epsilon), which is the same interval.
    torch.testing.assert_close(losses["loss_objective"], -clipped.mean(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(losses["loss_critic"], 0.5 * error.mean(), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("noise", [1e6, float("nan")])
@every
def test_padding_changes_nothing(name: str, noise: float) -> None:
    one, other = make(name), make(name)
    clean = act(one, make_frames())
    assert update(other, with_noise(clean, noise)) == pytest.approx(update(one, clean), rel=1e-6)
    assert_same(one, other, atol=1e-6)


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


@pytest.mark.slow
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


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
def test_slot_order_and_slot_count_change_nothing(name: str) -> None:
    """One gradient step over all rows is the same; off-policy rows are those of :mod:`tests.algos.test_losses`."""
    whole = {"rows_per_epoch": None, "minibatch_rows": 10_000, "epochs": 1}
    one, other = make(name, **whole), make(name, **whole)
    batch = act(one, make_frames())
    assert update(other, reordered(batch)) == pytest.approx(update(one, batch), rel=1e-3, abs=1e-5)
    assert_same(one, other, atol=1e-3)  # Adam turns rounding into steps where a gradient is 0 but for rounding
