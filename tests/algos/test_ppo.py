"""PPO: advantages and losses against hand computations, and indifference to padding and slot order."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.learners import base
from izoo.algos.learners.ppo import PPO, PPOConfig
from izoo.algos.losses.losses import MaskedPPOLoss
from izoo.algos.networks.gaussian import SamplingPolicy
from izoo.errors import IzooError

LOW, HIGH, FEATURES = -4.5, 2.6, 5


def make_batch(n: int = 2, t: int = 6, a: int = 4, seed: int = 0) -> TensorDict:
    """A batch with empty slots, an agent that leaves, and one that takes its slot later."""
    generator = torch.Generator().manual_seed(seed)
    shape = (n, t, a)
    mask = torch.ones(shape, dtype=torch.bool)
    mask[:, :, 3] = False
    mask[0, 3:5, 1] = False
    terminated = torch.zeros(*shape, 1, dtype=torch.bool)
    terminated[0, 2, 1] = True
    truncated = torch.zeros_like(terminated)
    truncated[1, 3] = mask[1, 3].unsqueeze(-1)
    draw = lambda *tail: torch.randn(*shape, *tail, generator=generator)  # noqa: E731
    agents = {"observation": draw(FEATURES), "mask": mask}
    successor = {
        "observation": draw(FEATURES),
        "reward": draw(1),
        "done": terminated | truncated,
        "terminated": terminated,
        "truncated": truncated,
    }
    for step in range(t - 1):  # a slot's next observation is its observation one step later, unless its life ends
        goes_on = ~successor["done"][:, step]
        following = torch.where(goes_on, agents["observation"][:, step + 1], successor["observation"][:, step])
        successor["observation"][:, step] = following
    return TensorDict(
        {"agents": TensorDict(agents, shape), "next": TensorDict({"agents": TensorDict(successor, shape)}, shape[:2])},
        shape[:2],
    )


def make_ppo(**changes: object) -> PPO:
    torch.manual_seed(3)
    return PPO(PPOConfig(**{"hidden": (8,), "minibatch_rows": 7, **changes}), FEATURES, LOW, HIGH)  # type: ignore[arg-type]


def act(ppo: PPO, batch: TensorDict, seed: int = 1) -> TensorDict:
    torch.manual_seed(seed)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return ppo.policy(batch)


def hand_advantages(ppo: PPO, batch: TensorDict) -> torch.Tensor:
    """The textbook recursion, slot by slot, in plain Python."""
    gamma, lam, scale = ppo.config.gamma, ppo.config.gae_lambda, ppo.config.reward_scale
    with torch.no_grad():
        value = ppo.critic.module(batch["agents", "observation"]).squeeze(-1)
        following = ppo.critic.module(batch["next", "agents", "observation"]).squeeze(-1)
    done, terminated = (batch["next", "agents", key].squeeze(-1) for key in ("done", "terminated"))
    reward = batch["next", "agents", "reward"].squeeze(-1) * scale
    advantage = torch.zeros_like(value)
    for n in range(value.shape[0]):
        for a in range(value.shape[2]):
            running = 0.0
            for t in reversed(range(value.shape[1])):
                bootstrap = 0.0 if terminated[n, t, a] else float(following[n, t, a])
                delta = float(reward[n, t, a]) + gamma * bootstrap - float(value[n, t, a])
                running = delta + gamma * lam * (0.0 if done[n, t, a] else running)
                advantage[n, t, a] = running
    return advantage


def test_advantages_equal_the_recursion_by_hand() -> None:
    ppo, batch = make_ppo(), make_batch()
    rows = ppo.advantages(act(ppo, batch))
    mask = batch[base.MASK]
    by_hand = hand_advantages(ppo, batch)
    with torch.no_grad():
        value = ppo.critic.module(batch[base.OBSERVATION]).squeeze(-1)
    torch.testing.assert_close(rows[base.VALUE_TARGET].squeeze(-1), (by_hand + value)[mask], atol=1e-5, rtol=1e-5)
    valid = by_hand[mask]
    expected = (valid - valid.mean()) / valid.std()
    torch.testing.assert_close(rows[base.ADVANTAGE].squeeze(-1), expected, atol=1e-5, rtol=1e-5)


def test_losses_equal_a_hand_computation() -> None:
    ppo = make_ppo(clip_epsilon=0.1, value_loss="l2", value_coeff=0.5, entropy_coeff=0.0)
    rows = ppo.advantages(act(ppo, make_batch()))
    with torch.no_grad():
        for parameter in ppo.loss.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(5)))
        losses = ppo.loss(rows)
        loc, scale = ppo.actor[0].module(rows[base.OBSERVATION])
        squashed = (rows[base.ACTION] - (HIGH + LOW) / 2) / ((HIGH - LOW) / 2)
        raw = torch.atanh(squashed)
        log_prob = -0.5 * ((raw - loc) / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - torch.log((HIGH - LOW) / 2 * (1 - squashed**2))
        ratio = (log_prob.squeeze(-1) - rows[base.LOG_PROB]).exp()
        advantage = rows[base.ADVANTAGE].squeeze(-1)
        clipped = torch.minimum(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage)
        value = ppo.critic.module(rows[base.OBSERVATION])
    assert float((ratio.clamp(0.9, 1.1) != ratio).float().mean()) > 0.2, "the clipping must matter in this test"
    # TorchRL clips the log of the ratio to log(1 -+ epsilon), which is the same interval.
    torch.testing.assert_close(losses["loss_objective"], -clipped.mean(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(losses["loss_critic"], 0.5 * ((value - rows[base.VALUE_TARGET]) ** 2).mean())


def test_fast_policy_is_the_actors_distribution() -> None:
    ppo, batch = make_ppo(), make_batch()
    acted, mask = act(ppo, batch.clone()), batch[base.MASK]
    distribution = ppo.actor.get_dist(batch.clone())
    action = acted[base.ACTION]
    assert float(action.min()) > LOW and float(action.max()) < HIGH
    log_prob = distribution.log_prob(action)
    torch.testing.assert_close(acted[base.LOG_PROB][mask], log_prob[mask], atol=1e-4, rtol=1e-4)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        fast, slow = ppo.policy(batch.clone())[base.ACTION], ppo.actor(batch.clone())[base.ACTION]
    torch.testing.assert_close(fast[mask], slow[mask])


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(128, 128), (9,), (5, 16, 3)])
def test_compiled_policy_equals_the_modules(activation: str, hidden: tuple[int, ...]) -> None:
    ppo, batch = make_ppo(hidden=hidden, activation=activation), make_batch()
    observation, mask = batch[base.OBSERVATION], batch[base.MASK]
    with torch.no_grad():
        for parameter in ppo.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(7)))
        noise = torch.randn(mask.shape, generator=torch.Generator().manual_seed(8))
        compiled = ppo.policy.sample(observation, mask, noise)
        by_modules = SamplingPolicy.sample(ppo.policy, observation, mask, noise)
    with torch.enable_grad():
        assert ppo.policy.sample(observation, mask, noise).requires_grad
    torch.testing.assert_close(compiled[:, mask], by_modules[:, mask], atol=2e-5, rtol=2e-5)
    assert (compiled[:, ~mask] == torch.tensor([[0.0], [1.0], [0.0], [0.0]])).all()


def test_compiled_policy_does_not_depend_on_who_else_is_there() -> None:
    ppo, batch = make_ppo(hidden=(128, 128)), make_batch()
    observation, mask = batch[base.OBSERVATION], batch[base.MASK]
    noise = torch.randn(mask.shape, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        together = ppo.policy.sample(observation, mask, noise)
        for place in mask.nonzero().tolist():
            alone = torch.zeros_like(mask)
            alone[tuple(place)] = True
            result = ppo.policy.sample(observation, alone, noise)
            assert torch.equal(result[:, alone], together[:, alone])


def test_untrained_policy_is_mild() -> None:
    ppo = make_ppo(initial_accel_mps2=0.5)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        batch = make_batch()
        action = ppo.policy(batch)[base.ACTION][batch[base.MASK]]
    assert float((action - 0.5).abs().max()) < 0.2


@pytest.mark.parametrize("noise", [1e6, float("nan")])
def test_padding_changes_nothing(noise: float) -> None:
    clean_ppo, noisy_ppo = make_ppo(rows_per_epoch=None), make_ppo(rows_per_epoch=None)
    clean = act(clean_ppo, make_batch())
    noisy = clean.clone()
    empty = ~noisy[base.MASK]
    for key in ("observation", "action", "loc", "scale", "action_log_prob"):
        noisy["agents", key][empty] = noise
    noisy["next", "agents", "observation"][empty] = noise
    noisy["next", "agents", "reward"][empty] = noise
    torch.manual_seed(7)
    expected = clean_ppo.update(clean, 0.0)
    torch.manual_seed(7)
    assert noisy_ppo.update(noisy, 0.0) == pytest.approx(expected, rel=1e-6)
    for one, other in zip(clean_ppo.loss.parameters(), noisy_ppo.loss.parameters(), strict=True):
        torch.testing.assert_close(one, other)


def test_slot_order_changes_nothing() -> None:
    """Permuting the slots permutes the rows, so one gradient step over all of them is the same."""
    whole = {"rows_per_epoch": None, "minibatch_rows": 10_000, "epochs": 1}
    one, other = make_ppo(**whole), make_ppo(**whole)
    batch = act(one, make_batch())
    order = torch.tensor([2, 3, 0, 1])
    permuted = batch.clone()
    permuted["agents"] = batch["agents"][:, :, order]
    permuted["next", "agents"] = batch["next", "agents"][:, :, order]
    assert other.update(permuted, 0.0) == pytest.approx(one.update(batch, 0.0), rel=1e-3, abs=1e-5)


def test_kl_penalty_and_value_clip_act_as_in_rllib() -> None:
    ppo = make_ppo(kl_coeff=0.2, kl_target=0.01, value_error_clip=1e-6, value_loss="l2", value_coeff=1.0)
    rows = ppo.advantages(act(ppo, make_batch()))
    assert float(ppo.loss(rows)["loss_kl"].detach()) == pytest.approx(0.0, abs=1e-6)
    with torch.no_grad():
        ppo.actor[0].module[0][-1].bias += 0.5  # type: ignore[index]
    losses = ppo.loss(rows)
    loc, scale = ppo.actor[0].module(rows[base.OBSERVATION])
    old_loc, old_scale = rows[base.LOC], rows[base.SCALE]
    by_hand = (scale / old_scale).log() + (old_scale**2 + (old_loc - loc) ** 2) / (2 * scale**2) - 0.5
    torch.testing.assert_close(losses["loss_kl"], 0.2 * by_hand.mean(), rtol=1e-4, atol=1e-6)
    assert float(losses["loss_critic"].detach()) <= 1e-6
    ppo._adapt_kl_weight(1.0)
    assert float(ppo.loss.kl_weight) == pytest.approx(0.3)
    ppo._adapt_kl_weight(0.0)
    assert float(ppo.loss.kl_weight) == pytest.approx(0.15)


def test_state_restores_the_very_next_update() -> None:
    one, other = make_ppo(), make_ppo()
    batch = act(one, make_batch())
    one.update(batch, 0.0)
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    torch.manual_seed(11)
    expected = one.update(batch, 0.1)
    torch.manual_seed(11)
    assert other.update(batch, 0.1) == expected


def test_an_empty_batch_is_no_update() -> None:
    ppo = make_ppo()
    batch = act(ppo, make_batch())
    batch[base.MASK][:] = False
    before = [parameter.clone() for parameter in ppo.loss.parameters()]
    assert ppo.update(batch, 0.0) == {}
    for parameter, old in zip(ppo.loss.parameters(), before, strict=True):
        torch.testing.assert_close(parameter, old)


def test_update_improves_a_bandit() -> None:
    """Reward is the acceleration itself: the mean action must rise."""
    ppo = make_ppo(lr=1e-2, anneal_lr=False, gamma=0.0)
    start = None
    for round_ in range(8):
        batch = act(ppo, make_batch(n=4, t=16, seed=round_), seed=round_)
        batch["next", "agents", "reward"] = batch[base.ACTION].clone()
        mean = float(batch[base.ACTION][batch[base.MASK]].mean())
        start = mean if start is None else start
        ppo.update(batch, 0.0)
    assert mean > start + 0.5


def test_bad_hyper_parameters_are_refused() -> None:
    for changes in ({"gamma": 1.5}, {"hidden": ()}, {"activation": "sin"}, {"lr": -1.0}, {"epochs": 0}):
        with pytest.raises(IzooError):
            PPOConfig(**changes)  # type: ignore[arg-type]
    outside = [("clip_epsilon", 1.0), ("initial_spread", 0.01), ("initial_spread", 90.0), ("kl_target", 0.0)]
    outside += [(name, -0.1) for name in ("value_coeff", "entropy_coeff", "kl_coeff")]
    outside += [(name, 0.0) for name in ("max_grad_norm", "value_error_clip")]
    for name, value in outside:
        with pytest.raises(IzooError, match=f"algo.{name} is {value}; it must lie in"):
            PPOConfig(**{name: value})  # type: ignore[arg-type]
    with pytest.raises(IzooError, match="initial_accel"):
        make_ppo(initial_accel_mps2=3.0)


def test_loss_reads_per_agent_keys() -> None:
    ppo = make_ppo()
    assert isinstance(ppo.loss, MaskedPPOLoss)
    assert ppo.loss.tensor_keys.advantage == base.ADVANTAGE
    assert ppo.loss.tensor_keys.sample_log_prob == base.LOG_PROB


def test_a_batch_that_has_moved_the_policy_far_enough_is_left() -> None:
    patient, wary = (make_ppo(lr=0.05, anneal_lr=False, epochs=6, target_kl=kl) for kl in (None, 1e-3))
    batch = act(patient, make_batch())
    everything, some = (ppo.update(batch, 0.0)["gradient_steps"] for ppo in (patient, wary))
    assert 1.0 <= some < everything


def test_how_far_a_policy_has_moved_is_never_less_than_nothing() -> None:
    """The mean of minus the log-ratios, which TorchRL logs, is below 0 in many minibatches."""
    ppo = make_ppo(lr=0.01, anneal_lr=False, epochs=3)
    rows = ppo.advantages(act(ppo, make_batch()))
    with torch.no_grad():
        for parameter in ppo.policy.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
        estimates = [float(ppo.loss(rows[part])["kl_approx"]) for part in torch.randperm(len(rows)).split(8)]
    assert len(estimates) > 3 and min(estimates) >= 0.0 and sum(estimates) > 0.0


def test_separate_clips_bound_each_network_by_itself() -> None:
    ppo = make_ppo(separate_clips=True, max_grad_norm=0.1, epochs=1, rows_per_epoch=None, minibatch_rows=1000)
    batch = act(ppo, make_batch())
    batch["next", "agents", "reward"] *= 1e4  # large value errors
    stats = ppo.update(batch, 0.0)
    assert stats["critic_grad_norm"] > 0.1 and stats["actor_grad_norm"] > 0.0
    for parameters in (ppo.loss.actor_network_params, ppo.loss.critic_network_params):
        norm = torch.stack([p.grad.norm() for p in parameters.values(True, True)]).norm()
        assert float(norm) <= 0.1001
    assert float(torch.stack([p.grad.norm() for p in ppo.policy.parameters()]).norm()) > min(
        0.099, 0.99 * stats["actor_grad_norm"]
    ), "the actor keeps what it is allowed"
