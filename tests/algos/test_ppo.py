"""PPO: advantages and losses against hand computations, and indifference to padding and slot order."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners import base
from izoo.algos.learners.graph_ppo import GCRL, GCRLConfig
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.learners.ppo import PPO, PPOConfig
from izoo.algos.networks.gaussian import SamplingPolicy
from tests.algos.frames import FEATURES, HIGH, LOW, SPACE, act, make_frames, shake


def make_ppo(**changes: object) -> PPO:
    torch.manual_seed(3)
    return PPO(PPOConfig(**{"hidden": (8,), "minibatch_rows": 7, **changes}), FEATURES, SPACE)  # type: ignore[arg-type]


@pytest.mark.parametrize(("algorithm", "config"), [(PPO, PPOConfig), (MAPPO, MAPPOConfig), (GCRL, GCRLConfig)])
def test_observations_are_standardised_as_in_the_first_batch(algorithm: type[PPO], config: type[PPOConfig]) -> None:
    torch.manual_seed(3)
    options = config(hidden=(8,), standardise=True, epochs=1, lr=1e-12)
    ppo, batch = algorithm(options, FEATURES, SPACE), make_frames()
    batch[base.OBSERVATION].mul_(0.01).add_(3.0)[..., 1] = 7.0
    rows = batch[base.OBSERVATION][batch[base.MASK]]
    ppo.update(act(ppo, batch), 0.0)
    modules = [m for m in (*ppo.policy.modules(), *ppo.critic.modules()) if isinstance(m, base.Standardise)]
    assert len(modules) == 2
    for module in modules:
        seen = module(rows)
        torch.testing.assert_close(seen.mean(0), torch.zeros(FEATURES), atol=1e-3, rtol=0.0)
        assert seen.std(0)[[0, 2, 3, 4]].numpy() == pytest.approx(1.0, abs=0.02)
    later = make_frames(seed=1)
    ppo.update(act(ppo, later), 0.5)
    torch.testing.assert_close(modules[0].mean, rows.mean(0))
    other = algorithm(options, FEATURES, SPACE)
    other.load_state_dict(ppo.state_dict())
    torch.testing.assert_close(act(other, later)[base.ACTION], act(ppo, later)[base.ACTION])


def test_fast_policy_is_the_actors_distribution() -> None:
    ppo, batch = make_ppo(), make_frames()
    acted, mask = act(ppo, batch), batch[base.MASK]
    distribution = ppo.actor.get_dist(batch.clone())
    action = acted[base.ACTION]
    assert float(action.min()) > LOW and float(action.max()) < HIGH
    log_prob = distribution.log_prob(action)
    torch.testing.assert_close(acted[base.LOG_PROB][mask], log_prob[mask], atol=1e-4, rtol=1e-4)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        fast, slow = ppo.policy(batch.clone())[base.ACTION], ppo.actor(batch.clone())[base.ACTION]
    torch.testing.assert_close(fast[mask], slow[mask])


@pytest.mark.parametrize("size", [1, 2])
def test_vehicles_of_an_episode_explore_together(size: int) -> None:
    """What is common lasts for an episode and follows from its number; each action keeps its distribution."""
    space, frame = ActionSpace(LOW, HIGH, size=size), make_frames()[:, 0]
    mask = frame[base.MASK]

    def noise(ppo: PPO, *episodes: int) -> torch.Tensor:
        seen = frame.clone().set(base.EPISODES, torch.tensor([[episode, -1, 7] for episode in episodes]))
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            acted = ppo.policy(seen)
        log_prob = ppo.actor.get_dist(frame.clone()).log_prob(acted[base.ACTION])
        torch.testing.assert_close(acted[base.LOG_PROB][mask], log_prob[mask], atol=1e-2, rtol=1e-3)
        raw = torch.atanh((acted[base.ACTION] - space.middle) / space.half_width)
        return (raw - acted[base.LOC]) / acted[base.SCALE]

    def make(share: float) -> PPO:
        torch.manual_seed(3)
        return PPO(PPOConfig(hidden=(8,), common_noise=share), FEATURES, space)

    ppo = make(1.0)
    first = noise(ppo, 10, 11)
    for row, there in zip(first, mask, strict=True):
        torch.testing.assert_close(row[there], row[there][:1].expand_as(row[there]), atol=1e-3, rtol=1e-3)
    assert (first[0, 0] - first[1, 0]).abs().min() > 0.01
    torch.testing.assert_close(noise(ppo, 10, 12)[0, 0], first[0, 0], atol=1e-3, rtol=1e-3)
    assert (noise(ppo, 13, 12)[0, 0] - first[0, 0]).abs().min() > 0.01
    torch.testing.assert_close(noise(make(1.0), 10, 11)[mask], first[mask], atol=1e-3, rtol=1e-3)

    mixed = make(0.75)
    own = torch.stack([noise(mixed, 10, 11)[mask] for _ in range(400)]).std(0)
    many = torch.stack([noise(mixed, start, start + 1)[mask] for start in range(0, 2000, 2)])
    assert (own - 0.5).abs().max() < 0.1
    assert many.mean().abs() < 0.1 and (many.std() - 1.0).abs() < 0.1


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(128, 128), (9,), (5, 16, 3)])
def test_compiled_policy_equals_the_modules(activation: str, hidden: tuple[int, ...]) -> None:
    """Whoever else is there."""
    ppo, batch = make_ppo(hidden=hidden, activation=activation), make_frames()
    observation, mask = batch[base.OBSERVATION], batch[base.MASK]
    shake(ppo.policy)
    noise = torch.randn(mask.shape, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        compiled = ppo.policy.sample(observation, mask, noise)
        by_modules = SamplingPolicy.sample(ppo.policy, observation, mask, noise)
        for place in mask.nonzero().tolist():
            alone = torch.zeros_like(mask)
            alone[tuple(place)] = True
            assert torch.equal(ppo.policy.sample(observation, alone, noise)[:, alone], compiled[:, alone])
    with torch.enable_grad():
        assert ppo.policy.sample(observation, mask, noise).requires_grad
    torch.testing.assert_close(compiled[:, mask], by_modules[:, mask], atol=2e-5, rtol=2e-5)
    assert (compiled[:, ~mask] == torch.tensor([[0.0], [1.0], [0.0], [0.0]])).all()


def test_untrained_policy_is_mild() -> None:
    ppo, batch = make_ppo(initial_accel_mps2=0.5), make_frames()
    action = act(ppo, batch, kind=ExplorationType.DETERMINISTIC)[base.ACTION][batch[base.MASK]]
    assert float((action - 0.5).abs().max()) < 0.2


def test_kl_penalty_and_value_clip_act_as_in_rllib() -> None:
    ppo = make_ppo(kl_coeff=0.2, kl_target=0.01, value_error_clip=1e-6, value_loss="l2", value_coeff=1.0)
    rows = ppo.advantages(act(ppo, make_frames()))
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


def test_a_batch_that_has_moved_the_policy_far_enough_is_left() -> None:
    patient, wary = (make_ppo(lr=0.05, anneal_lr=False, epochs=6, target_kl=kl) for kl in (None, 1e-3))
    batch = act(patient, make_frames())
    everything, some = (ppo.update(batch, 0.0)["gradient_steps"] for ppo in (patient, wary))
    assert 1.0 <= some < everything


def test_how_far_a_policy_has_moved_is_never_less_than_nothing() -> None:
    """The mean of minus the log-ratios, which TorchRL logs, is below 0 in many minibatches."""
    ppo = make_ppo(lr=0.01, anneal_lr=False, epochs=3)
    rows = ppo.advantages(act(ppo, make_frames()))
    shake(ppo.policy, 0.02)
    with torch.no_grad():
        estimates = [float(ppo.loss(rows[part])["kl_approx"]) for part in torch.randperm(len(rows)).split(8)]
    assert len(estimates) > 3 and min(estimates) >= 0.0 and sum(estimates) > 0.0


def test_separate_clips_bound_each_network_by_itself() -> None:
    ppo = make_ppo(separate_clips=True, max_grad_norm=0.1, epochs=1, rows_per_epoch=None, minibatch_rows=1000)
    batch = act(ppo, make_frames())
    batch["next", "agents", "reward"] *= 1e4  # large value errors
    stats = ppo.update(batch, 0.0)
    assert stats["critic_grad_norm"] > 0.1 and stats["actor_grad_norm"] > 0.0
    for network in (ppo.loss.actor_network, ppo.loss.critic_network):
        norm = torch.stack([p.grad.norm() for p in network.parameters()]).norm()
        assert float(norm) <= 0.1001
    kept = float(torch.stack([p.grad.norm() for p in ppo.policy.parameters()]).norm())
    assert kept > min(0.099, 0.99 * stats["actor_grad_norm"]), "the actor keeps what it is allowed"
