"""DDPG: transitions, targets and losses against hand computations, and exploration."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.learners import base, replay
from izoo.algos.learners.ddpg import DDPG, DDPGConfig
from izoo.algos.learners.replay import NEXT_OBSERVATION, NEXT_TERMINATED, transitions
from tests.algos.frames import FEATURES, HIGH, LOW, SPACE, act, make_frames, shake

SMALL = {"hidden": (8,), "minibatch_rows": 16, "replay_rows": 500, "learning_starts": 0, "rows_per_frame": None}


def make_ddpg(**changes: object) -> DDPG:
    torch.manual_seed(3)
    return DDPG(DDPGConfig(**{**SMALL, **changes}), FEATURES, SPACE)  # type: ignore[arg-type]


def make_batch(seed: int = 0, n: int = 2, t: int = 6) -> TensorDict:
    batch = make_frames(n=n, t=t, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    return batch.set(base.ACTION, torch.rand(*batch[base.MASK].shape, 1, generator=generator) * (HIGH - LOW) + LOW)


@pytest.mark.parametrize("n_step", [1, 3])
def test_transitions_equal_a_walk_down_the_slots(n_step: int) -> None:
    batch, gamma, scale = make_batch(), 0.9, 0.5
    rows = transitions(batch, scale, n_step, gamma)
    agents, following = batch["agents"], batch["next", "agents"]
    expected = []
    for n, t, a in agents["mask"].nonzero().tolist():
        total, steps = 0.0, 0
        for k in range(n_step):
            total += scale * gamma**k * float(following["reward"][n, t + k, a])
            steps = k + 1
            if following["done"][n, t + k, a] or t + k + 1 == batch.shape[1]:
                break
        last = n, t + steps - 1, a
        gone = bool(following["terminated"][last])
        successor = torch.zeros(FEATURES) if gone else following["observation"][last]
        tail = [total, float(following["done"][last]), float(gone), float(steps)]
        row = torch.cat([agents["observation"][n, t, a], agents["action"][n, t, a], successor, torch.tensor(tail)])
        expected.append(row)
    actual = torch.cat([rows[key].float() for key in replay.TRANSITION], dim=-1)
    torch.testing.assert_close(actual, torch.stack(expected))


@pytest.mark.parametrize("value_loss", ["l2", "smooth_l1"])
def test_losses_equal_a_hand_computation(value_loss: str) -> None:
    ddpg = make_ddpg(value_loss=value_loss, gamma=0.9, n_step=2)
    rows = transitions(make_batch(), 3.0, 2, 0.9)
    target_actor, target_critic = copy.deepcopy(ddpg.actor.module), copy.deepcopy(ddpg.critic.module)
    shake(ddpg.loss)
    with torch.no_grad():
        losses = ddpg.loss(rows)
        observation, successor = rows[base.OBSERVATION], rows[NEXT_OBSERVATION]
        following = target_critic(successor, target_actor(successor))
        alive = (~rows[NEXT_TERMINATED]).float()  # truncated ones are worth what they see
        assert (rows[("next", *base.DONE)].float() > rows[NEXT_TERMINATED].float()).any() and not alive.all()
        target = rows[replay.NEXT_REWARD] + 0.9 ** rows[replay.STEPS] * alive * following
        error = ddpg.critic.module(observation, rows[base.ACTION]) - target
        l2, huber = error**2, torch.where(error.abs() < 1, 0.5 * error**2, error.abs() - 0.5)
        value = ddpg.critic.module(observation, ddpg.actor.module(observation))
    assert float((error.abs() > 1).float().mean()) > 0.1, "the two losses must differ in this test"
    torch.testing.assert_close(losses["loss_value"], (l2 if value_loss == "l2" else huber).mean())
    torch.testing.assert_close(losses["loss_actor"], -value.mean())
    torch.testing.assert_close(rows[replay.ERROR], (error**2).squeeze(-1))


def test_targets_follow_slowly_and_each_loss_moves_its_own_network() -> None:
    ddpg = make_ddpg(tau=0.1, actor_lr=1e-2, critic_lr=1e-3)
    rows = transitions(make_batch())
    before = {name: [p.clone() for p in parameters] for name, parameters in ddpg.parameters.items()}
    ddpg.loss(rows)["loss_actor"].backward()
    assert all(parameter.grad is None for parameter in ddpg.parameters["critic"])
    ddpg.gradient_step(rows)
    for name, group in (("actor", "actor_network"), ("critic", "value_network")):
        targets = getattr(ddpg.loss, f"target_{group}_params").values(True, True)
        for old, new, target in zip(before[name], ddpg.parameters[name], targets, strict=True):
            assert not torch.equal(old, new)
            torch.testing.assert_close(target, old + 0.1 * (new - old))


def test_only_a_random_part_is_stored_and_the_oldest_makes_room() -> None:
    ddpg = make_ddpg(rows_per_frame=0.5, replay_rows=8)
    batch = make_batch()
    ddpg.update(batch, 0.0)
    assert len(ddpg.replay) == 6  # half of twelve frames
    ddpg.update(batch, 0.0)
    assert len(ddpg.replay) == 8
    ddpg.replay.add(transitions(batch))
    assert len(ddpg.replay) == 8, "a batch larger than the replay fills it"


def test_exploration_is_bounded_and_remembers_each_vehicle() -> None:
    ddpg = make_ddpg(noise_sigma=0.1, noise_theta=0.15)
    observation = torch.zeros(1, 400, FEATURES)
    mask = torch.ones(1, 400, dtype=torch.bool)
    frame = TensorDict({"agents": TensorDict({"observation": observation, "mask": mask}, [1, 400])}, [1])
    noises = []
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for _ in range(60):
            action = ddpg.policy(frame.clone())[base.ACTION]
            assert float(action.min()) >= LOW and float(action.max()) <= HIGH
            noises.append(ddpg.policy.noise.flatten().clone())
    settled = torch.stack(noises[30:])
    # An AR(1) process: variance sigma^2 / (1 - (1 - theta)^2), correlation 1 - theta between steps.
    assert float(settled.std()) == pytest.approx(0.1 * (HIGH - LOW) / (1 - 0.85**2) ** 0.5, rel=0.05)
    correlation = (settled[1:] * settled[:-1]).mean() / settled.var()
    assert float(correlation) == pytest.approx(0.85, abs=0.03)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        frame[base.MASK][:, 0] = False
        ddpg.policy(frame)
    assert float(ddpg.policy.noise[0, 0]) == 0.0 and float(ddpg.policy.noise[0, 1]) != 0.0


def test_evaluation_is_deterministic_and_starts_mild() -> None:
    ddpg, batch = make_ddpg(initial_accel_mps2=0.5), make_batch()
    one, other = (act(ddpg, batch, seed, ExplorationType.DETERMINISTIC)[base.ACTION] for seed in range(2))
    torch.testing.assert_close(one, other, atol=0.0, rtol=0.0)
    mask = batch[base.MASK]
    assert float((one[mask] - 0.5).abs().max()) < 0.3
    assert not one[~mask].any()


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(128, 128), (9,), (5, 16, 3)])
def test_compiled_actor_equals_the_modules(activation: str, hidden: tuple[int, ...]) -> None:
    ddpg, batch = make_ddpg(hidden=hidden, activation=activation), make_batch()
    observation, mask = batch[base.OBSERVATION], batch[base.MASK]
    observation[~mask] = float("nan")
    shake(ddpg.policy)
    with torch.no_grad():
        compiled = ddpg.policy.mean(observation, mask)
        by_modules = ddpg.actor.module(observation)
        for place in mask.nonzero().tolist():
            alone = torch.zeros_like(mask)
            alone[tuple(place)] = True
            assert torch.equal(ddpg.policy.mean(observation, alone)[alone], compiled[alone])
    torch.testing.assert_close(compiled[mask], by_modules[mask], atol=2e-5, rtol=2e-5)
    with_gradient = ddpg.policy.mean(observation, mask)
    assert with_gradient.requires_grad
    torch.testing.assert_close(with_gradient.detach(), compiled, atol=2e-5, rtol=2e-5)
    assert compiled.shape == (*mask.shape, 1) and not compiled[~mask].any()


def test_noise_decays_and_randomness_ends() -> None:
    ddpg = make_ddpg(random_frames=20, noise_frames=24, noise_final=0.5)
    batch = make_batch()  # 12 frames
    assert ddpg.policy.uniform
    ddpg.update(batch, 0.0)
    assert ddpg.policy.uniform and float(ddpg.policy.noise_factor) == pytest.approx(0.75)
    ddpg.update(batch, 0.0)
    assert not ddpg.policy.uniform and float(ddpg.policy.noise_factor) == pytest.approx(0.5)


@pytest.mark.skipif(not torch.set_flush_denormal(False), reason="this CPU cannot take denormal numbers for 0")
@pytest.mark.parametrize("weight_decay", [0.0, 1e-6])
def test_weights_that_have_decayed_away_are_0(weight_decay: float) -> None:
    """Gradient steps with denormal weights take twice as long; outside of these steps arithmetic is as ever."""
    ddpg = make_ddpg(weight_decay=weight_decay)
    unit = ddpg.actor.module[0][0]
    with torch.no_grad():
        unit.weight[0], unit.bias[0] = 1e-39, -1e6  # never active
    ddpg.update(make_batch(), 0.25)
    assert unit.weight[1].all() and bool(unit.weight[0].any()) == (weight_decay == 0.0)
    assert (torch.full((8,), 1e-39) * 2).all()


def test_without_its_replay_a_restored_run_collects_before_it_learns() -> None:
    one, other = (make_ddpg(save_replay=False, learning_starts=24) for _ in range(2))
    for _ in range(2):
        stats = one.update(make_batch(), 0.0)
    assert "loss_value" in stats
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    assert "loss_value" not in other.update(make_batch(), 0.0)
    assert "loss_value" in other.update(make_batch(), 0.0)


def test_priorities_decide_what_is_drawn_and_weights_undo_it() -> None:
    torch.manual_seed(0)
    memory = replay.Replay(capacity=3, minibatch_rows=3000, alpha=0.5, beta=1.0)
    memory.add(transitions(make_batch())[:3])
    rows = memory.sample()
    rows["index"], rows[replay.ERROR] = torch.arange(3000) % 3, torch.tensor([1.0, 16.0, 81.0]).repeat(1000)
    memory.learned(rows)
    drawn = memory.sample()
    share = torch.bincount(drawn["index"], minlength=3) / 3000  # errors 1, 4, 9 to the power 0.5
    torch.testing.assert_close(share, torch.tensor([1.0, 2.0, 3.0]) / 6, atol=0.03, rtol=0.0)
    weight = torch.tensor([drawn["priority_weight"][drawn["index"] == row][0] for row in range(3)])
    torch.testing.assert_close(weight, torch.tensor([1.0, 1 / 2, 1 / 3]), atol=1e-4, rtol=1e-4)
    memory.add(transitions(make_batch())[:1])
    assert isinstance(memory.sampler, replay.PriorityDraws)
    assert float(memory.sampler.priority[0]) == pytest.approx(9.0, abs=1e-3), "new rows come first"
