"""TD3: its three changes to DDPG against hand computations, indifference to padding, and exact restoring."""

from __future__ import annotations

import copy
import io

import pytest
import torch

from izoo.algos.learners import base
from izoo.algos.learners.replay import ERROR, NEXT_OBSERVATION, NEXT_REWARD, NEXT_TERMINATED, STEPS, transitions
from izoo.algos.learners.td3 import TD3, TD3Config
from izoo.cli.compose import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from tests.algos.frames import FEATURES, HIGH, LOW
from tests.algos.test_ddpg import SMALL, explore, make_batch


def make_td3(**changes: object) -> TD3:
    torch.manual_seed(3)
    return TD3(TD3Config(**{**SMALL, **changes}), FEATURES, LOW, HIGH)  # type: ignore[arg-type]


def critics(td3: TD3) -> list[torch.nn.Module]:
    """Copies of the critics as the loss holds them now."""
    copies = []
    for number in range(2):
        module = copy.deepcopy(td3.loss.qvalue_network)
        td3.loss.qvalue_network_params[number].data.clone().to_module(module)
        copies.append(module.module)
    return copies


def test_losses_equal_a_hand_computation() -> None:
    td3 = make_td3(gamma=0.9, n_step=2, target_noise=0.3, target_noise_clip=0.4)
    rows = transitions(make_batch(), 3.0, 2, 0.9)
    target_actor, target_critics = copy.deepcopy(td3.actor.module), critics(td3)
    with torch.no_grad():
        for parameter in td3.loss.parameters():  # so that the targets differ from the networks
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(5)))
        torch.manual_seed(11)
        losses = td3.loss(rows)
        torch.manual_seed(11)
        half = (HIGH - LOW) / 2
        noise = (torch.randn_like(rows[base.ACTION]) * 0.3 * half).clamp(-0.4 * half, 0.4 * half)
        assert float((noise.abs() == 0.4 * half).float().mean()) > 0.05, "the clip must matter in this test"
        observation, successor = rows[base.OBSERVATION], rows[NEXT_OBSERVATION]
        smoothed = (target_actor(successor) + noise).clamp(LOW, HIGH)
        following = torch.stack([critic(successor, smoothed) for critic in target_critics])
        assert (following[0] < following[1]).any() and (following[1] < following[0]).any()
        alive = (~rows[NEXT_TERMINATED]).float()
        target = rows[NEXT_REWARD] + 0.9 ** rows[STEPS] * alive * following.min(0)[0]
        own = critics(td3)
        error = torch.stack([critic(observation, rows[base.ACTION]) - target for critic in own])
        huber = torch.where(error.abs() < 1, 0.5 * error**2, error.abs() - 0.5)
        value = own[0](observation, td3.actor.module(observation))
    torch.testing.assert_close(losses["loss_qvalue"], huber.sum(0).mean())
    torch.testing.assert_close(losses["loss_actor"], -value.mean())
    torch.testing.assert_close(rows[ERROR], (error**2).max(0)[0].squeeze(-1))


def test_the_actor_and_the_targets_move_every_second_time_and_the_critics_always() -> None:
    td3 = make_td3(policy_delay=2, tau=0.1)
    rows = transitions(make_batch())
    groups = {
        "actor": td3.parameters["actor"],
        "critic": td3.parameters["critic"],
        "targets": list(td3.loss.target_qvalue_network_params.values(True, True)),
    }
    first, second = (part.unbind(0) for part in td3.parameters["critic"][:2])
    assert not torch.equal(*first) or not torch.equal(*second), "the critics begin differently"
    for step in range(1, 5):
        before = {name: [p.clone() for p in group] for name, group in groups.items()}
        logged = td3.gradient_step(rows)
        moved = {
            name: any(not torch.equal(a, b) for a, b in zip(before[name], group, strict=True))
            for name, group in groups.items()
        }
        assert moved == {"actor": step % 2 == 0, "critic": True, "targets": step % 2 == 0}
        assert ("loss_actor" in logged) == (step % 2 == 0)


@pytest.mark.parametrize("noise", [1e6, float("nan")])
def test_padding_changes_nothing(noise: float) -> None:
    one, other = make_td3(updates_per_frame=0.5), make_td3(updates_per_frame=0.5)
    clean = make_batch()
    noisy = clean.clone()
    empty = ~noisy[base.MASK]
    for key in (base.OBSERVATION, base.ACTION, NEXT_REWARD):
        noisy[key][empty] = noise
    noisy[NEXT_OBSERVATION][empty | noisy[NEXT_TERMINATED].squeeze(-1)] = noise
    torch.manual_seed(7)
    expected = one.update(clean, 0.0)
    torch.manual_seed(7)
    assert other.update(noisy, 0.0) == pytest.approx(expected, rel=1e-6)
    for left, right in zip(one.loss.parameters(), other.loss.parameters(), strict=True):
        torch.testing.assert_close(left, right)


def test_slot_order_changes_nothing() -> None:
    batch, order = make_batch(), torch.tensor([2, 3, 0, 1])
    permuted = batch.clone()
    permuted["agents"] = batch["agents"][:, :, order]
    permuted["next", "agents"] = batch["next", "agents"][:, :, order]
    logged = [
        make_td3(policy_delay=1, target_noise=0.0).gradient_step(transitions(one, 1.0, 3, 0.9))
        for one in (batch, permuted)
    ]
    for key, value in logged[0].items():
        torch.testing.assert_close(logged[1][key], value)


def test_state_restores_the_very_next_updates() -> None:
    """An odd number of gradient steps has been made: whose turn it is belongs to the state."""
    one, other = make_td3(updates_per_frame=0.25), make_td3(updates_per_frame=0.25)
    for seed in range(3):
        explore(one, make_batch())
        one.update(make_batch(seed), 0.1)
    assert one.gradient_steps % 2
    file = io.BytesIO()
    torch.save(one.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    for seed in range(3, 6):
        torch.manual_seed(seed)
        expected = one.update(make_batch(seed), 0.2)
        torch.manual_seed(seed)
        assert other.update(make_batch(seed), 0.2) == expected
    for left, right in zip(one.loss.state_dict().values(), other.loss.state_dict().values(), strict=True):
        torch.testing.assert_close(left, right, atol=0.0, rtol=0.0)


def test_update_improves_a_bandit() -> None:
    """Reward falls with the distance from 1 m/s^2: the actor must move there."""
    settings = {"gamma": 0.0, "n_step": 1, "reward_scale": 1.0, "critic_lr": 1e-2, "actor_lr": 2e-3, "tau": 0.005}
    sizes = {"replay_rows": 10_000, "minibatch_rows": 256, "hidden": (32,), "updates_per_frame": 0.1}
    td3 = make_td3(**settings, **sizes, saturation_coeff=1e-3)
    for round_ in range(14):
        batch = make_batch(round_, n=8, t=60)
        batch[NEXT_REWARD] = -(((batch[base.ACTION] - 1.0) / 3) ** 2)
        td3.update(batch, 0.0)
    batch = make_batch()
    with torch.no_grad():
        action = td3.actor.module(batch[base.OBSERVATION])[batch[base.MASK]]
    assert float((action - 1.0).abs().mean()) < 0.5


def test_options() -> None:
    assert compose_config(TrainConfig, ["algo=td3"]).algo == TD3Config()
    for changes in ({"policy_delay": 0}, {"target_noise": -0.1}, {"stores": "asked"}):
        with pytest.raises(IzooError):
            TD3Config(**changes)  # type: ignore[arg-type]
