"""TD3: its three changes to DDPG against hand computations, indifference to padding, and exact restoring."""

import copy

import torch

from izoo.algos.learners import base
from izoo.algos.learners.replay import ERROR, NEXT_OBSERVATION, NEXT_REWARD, NEXT_TERMINATED, STEPS, transitions
from izoo.algos.learners.td3 import TD3, TD3Config
from tests.algos.frames import FEATURES, HIGH, LOW, SPACE, shake
from tests.algos.test_ddpg import SMALL, make_batch


def make_td3(**changes: object) -> TD3:
    torch.manual_seed(3)
    return TD3(TD3Config(**{**SMALL, **changes}), FEATURES, SPACE)  # type: ignore[arg-type]


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
    shake(td3.loss)
    with torch.no_grad():
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
