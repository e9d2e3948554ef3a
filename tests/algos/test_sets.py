"""What MAPPO and graph RL share: whole frames, and indifference to slot order, slot count and padding."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.learners import base
from izoo.algos.learners.graph_ppo import GCRL, GCRLConfig
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.learners.set_ppo import SetPPO
from izoo.algos.networks.set_networks import COLUMN, FRAME, places
from tests.algos.frames import FEATURES, HIGH, LOW, act, alone, hand_advantages, make_frames

KINDS = {
    "mappo": (MAPPO, MAPPOConfig, {"critic_queries": 2, "critic_embedding": 6}),
    "gcrl": (GCRL, GCRLConfig, {"neighbours": 1, "range_m": 400.0, "heads": 2}),
}
WHOLE = {"rows_per_epoch": None, "minibatch_rows": 10_000, "epochs": 1}
pytestmark = pytest.mark.parametrize("kind", KINDS)


def make(kind: str, **changes: object) -> SetPPO:
    algorithm, config, small = KINDS[kind]
    torch.manual_seed(3)
    made = algorithm(config(**{"hidden": (8, 8), "minibatch_rows": 7, **small, **changes}), FEATURES, LOW, HIGH)  # type: ignore[operator]
    with torch.no_grad():  # an untrained policy hardly looks at what it observes
        for parameter in made.actor.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(9)))
    return made


def same_parameters(one: SetPPO, other: SetPPO, **tolerance: float) -> None:
    for mine, theirs in zip(one.loss.parameters(), other.loss.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, **tolerance)


def test_places_number_frames_and_agents(kind: str) -> None:
    mask = torch.tensor([[[1, 0, 1], [0, 0, 0]], [[0, 1, 0], [1, 1, 1]]], dtype=torch.bool)
    frame, column = places(mask)
    assert frame.tolist() == [0, 0, 1, 2, 2, 2]
    assert column.tolist() == [0, 1, 0, 0, 1, 2]


def test_values_are_those_of_each_frame_alone(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    mask = batch[base.MASK]
    expected = alone(algorithm, batch[base.OBSERVATION], mask)
    with torch.no_grad():
        torch.testing.assert_close(algorithm.loss.value_estimator.values(batch, mask).squeeze(-1), expected[mask])
        some = mask & (torch.arange(4) == 2)
        torch.testing.assert_close(algorithm.loss.value_estimator.values(batch, some).squeeze(-1), expected[some])


def test_advantages_equal_the_recursion_by_hand(kind: str) -> None:
    algorithm = make(kind)
    batch = act(algorithm, make_frames())
    rows, mask = algorithm.advantages(batch), batch[base.MASK]
    advantage, value = hand_advantages(algorithm, batch)
    torch.testing.assert_close(rows[base.VALUE_TARGET].squeeze(-1), (advantage + value)[mask], atol=1e-5, rtol=1e-5)
    valid = advantage[mask]
    expected = (valid - valid.mean()) / valid.std()
    torch.testing.assert_close(rows[base.ADVANTAGE].squeeze(-1), expected, atol=1e-5, rtol=1e-5)


def test_losses_equal_a_hand_computation(kind: str) -> None:
    algorithm = make(kind, clip_epsilon=0.1, value_loss="l2", value_coeff=0.5)
    batch = act(algorithm, make_frames())
    rows, mask = algorithm.advantages(batch), batch[base.MASK]
    with torch.no_grad():
        for parameter in algorithm.loss.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(5)))
        losses = algorithm.loss(rows)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            now = algorithm.policy(batch.clone())
    loc, scale, action = now[base.LOC][mask], now[base.SCALE][mask], batch[base.ACTION][mask]
    squashed = (action - (HIGH + LOW) / 2) / ((HIGH - LOW) / 2)
    log_prob = -0.5 * ((torch.atanh(squashed) - loc) / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)
    log_prob = log_prob - torch.log((HIGH - LOW) / 2 * (1 - squashed**2))
    ratio = (log_prob.squeeze(-1) - batch[base.LOG_PROB][mask]).exp()
    advantage = rows[base.ADVANTAGE].squeeze(-1)
    clipped = torch.minimum(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage)
    value = alone(algorithm, batch[base.OBSERVATION], mask)[mask]
    error = (value - rows[base.VALUE_TARGET].squeeze(-1)) ** 2
    assert float((ratio.clamp(0.9, 1.1) != ratio).float().mean()) > 0.2, "the clipping must matter in this test"
    torch.testing.assert_close(losses["loss_objective"], -clipped.mean(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(losses["loss_critic"], 0.5 * error.mean(), atol=1e-5, rtol=1e-4)


def test_the_loss_sees_the_policy_that_collected(kind: str) -> None:
    algorithm = make(kind)
    rows = algorithm.advantages(act(algorithm, make_frames()))
    with torch.no_grad():
        again = algorithm.actor.get_dist(rows.clone()).log_prob(rows[base.ACTION])
    torch.testing.assert_close(again, rows[base.LOG_PROB], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("noise", [1e6, float("nan")])
def test_padding_changes_nothing(kind: str, noise: float) -> None:
    clean_one, noisy_one = (make(kind, rows_per_epoch=None, epochs=2) for _ in range(2))
    clean = act(clean_one, make_frames())
    noisy = clean.clone()
    for group in (noisy["agents"], noisy["next", "agents"]):
        empty = ~group["mask"]
        for key in set(group.keys()) & {"observation", "action", "loc", "scale", "action_log_prob"}:
            group[key][empty] = noise
    noisy["next", "agents", "reward"][~noisy[base.MASK]] = noise
    torch.manual_seed(7)
    expected = clean_one.update(clean, 0.0)
    torch.manual_seed(7)
    assert noisy_one.update(noisy, 0.0) == pytest.approx(expected, rel=1e-6)
    same_parameters(clean_one, noisy_one)


def test_noise_in_empty_slots_does_not_reach_actions(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    noisy = batch.clone()
    noisy[base.OBSERVATION][~batch[base.MASK]] = 1e6
    mask = batch[base.MASK]
    torch.testing.assert_close(act(algorithm, noisy)[base.ACTION][mask], act(algorithm, batch)[base.ACTION][mask])


def test_slot_order_and_slot_count_change_nothing(kind: str) -> None:
    one, other = make(kind, **WHOLE), make(kind, **WHOLE)
    batch = act(one, make_frames())
    permuted = batch.clone()
    order = torch.tensor([2, 3, 0, 1])
    wide = TensorDict({"agents": _spread(batch["agents"], order)}, batch.batch_size)
    wide["next"] = TensorDict({"agents": _spread(batch["next", "agents"], order)}, batch.batch_size)
    assert wide[base.MASK].shape[-1] == permuted[base.MASK].shape[-1] + 3
    assert other.update(wide, 0.0) == pytest.approx(one.update(batch, 0.0), rel=1e-3, abs=1e-5)
    # Adam turns rounding into steps of the learning rate where a gradient is 0 but for rounding.
    same_parameters(one, other, atol=1e-3, rtol=0.0)


def _spread(agents: TensorDict, order: torch.Tensor) -> TensorDict:
    """Permute the slots of ``agents`` and put three empty ones in front."""
    empty = torch.zeros_like(agents[..., :3])
    return torch.cat([empty, agents[..., order]], dim=-1)


def test_permuted_agents_act_alike(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    order = torch.tensor([2, 0, 3, 1])
    permuted = TensorDict({"agents": batch["agents"][..., order]}, batch.batch_size)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        straight, turned = algorithm.policy(batch.clone())[base.ACTION], algorithm.policy(permuted)[base.ACTION]
    mask = batch[base.MASK][..., order]
    torch.testing.assert_close(turned[mask], straight[..., order, :][mask])


def test_minibatches_are_whole_frames_and_cover_everything(kind: str) -> None:
    algorithm = make(kind, epochs=3, minibatch_rows=7, rows_per_epoch=None)
    rows = algorithm.advantages(act(algorithm, make_frames()))
    rows["row"] = torch.arange(len(rows))
    frame = rows[FRAME].clone()
    parts = list(algorithm._minibatches(rows))
    seen = torch.cat([part["row"] for part in parts])
    assert sorted(seen.tolist()) == sorted(3 * list(range(len(rows))))
    for part in parts:
        assert part[FRAME].unique().tolist() == list(range(int(part[FRAME].max()) + 1)), "numbered anew from 0"
        for number in part[FRAME].unique():
            members = part["row"][part[FRAME] == number]
            whole = (frame == frame[members[0]]).nonzero()[:, 0]
            assert sorted(members.tolist()) == whole.tolist()
    limited = make(kind, epochs=1, minibatch_rows=7, rows_per_epoch=6)
    assert sum(len(part) for part in limited._minibatches(rows)) == pytest.approx(6, abs=3)


@pytest.mark.parametrize("agents", [0, 1])
def test_few_agents(kind: str, agents: int) -> None:
    algorithm, batch = make(kind), make_frames()
    for group in (batch["agents"], batch["next", "agents"]):
        group["mask"] &= torch.arange(4) < agents
        for key in set(group.keys()) & {"done", "terminated", "truncated"}:
            group[key] &= (torch.arange(4) < agents).unsqueeze(-1)
    acted = act(algorithm, batch)
    assert acted[base.ACTION].isfinite().all()
    before = copy.deepcopy(algorithm.state_dict()["policy"])
    stats = algorithm.update(acted, 0.0)
    moved = any(not torch.equal(before[key], value) for key, value in algorithm.state_dict()["policy"].items())
    assert moved == bool(agents)
    assert all(math.isfinite(value) for value in stats.values())
    assert stats.get("agent_rows", 0) == float(batch[base.MASK].sum())


def test_policy_without_a_batch_dimension(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    acted = act(algorithm, batch[0, 0])
    assert acted[base.ACTION].shape == (4, 1)


def test_a_copied_policy_acts_by_its_own_weights(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    mask, before = batch[base.MASK], act(algorithm, batch)[base.LOC]
    other = copy.deepcopy(algorithm.policy)
    with torch.no_grad():
        for parameter in algorithm.policy.parameters():
            parameter.zero_()
        assert torch.equal(other(batch.clone())[base.LOC], before)
    assert not act(algorithm, batch)[base.LOC][mask].any()


def test_state_restores_the_very_next_update(kind: str) -> None:
    one, other = make(kind, kl_coeff=0.2), make(kind, kl_coeff=0.2)
    batch = act(one, make_frames())
    one.update(batch, 0.0)
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    torch.manual_seed(11)
    expected = one.update(batch, 0.1)
    torch.manual_seed(11)
    assert other.update(batch, 0.1) == expected
    same_parameters(one, other, atol=0.0, rtol=0.0)


def test_kl_penalty_starts_at_zero(kind: str) -> None:
    algorithm = make(kind, kl_coeff=0.2)
    rows = algorithm.advantages(act(algorithm, make_frames()))
    assert float(algorithm.loss(rows)["loss_kl"].detach()) == pytest.approx(0.0, abs=1e-5)


def test_update_improves_a_bandit(kind: str) -> None:
    """Reward is the acceleration itself: the mean action must rise."""
    algorithm = make(kind, lr=1e-2, anneal_lr=False, gamma=0.0, epochs=2, minibatch_rows=64)
    means = []
    for round_ in range(10):
        batch = act(algorithm, make_frames(n=4, t=16, seed=round_), seed=round_)
        batch["next", "agents", "reward"] = batch[base.ACTION].clone()
        means.append(float(batch[base.ACTION][batch[base.MASK]].mean()))
        algorithm.update(batch, 0.0)
    assert means[-1] > means[0] + 0.5


def test_rows_carry_their_place(kind: str) -> None:
    algorithm = make(kind)
    rows = algorithm.advantages(act(algorithm, make_frames()))
    keys: Any = rows.keys(True)
    assert {FRAME, COLUMN} <= set(keys)
    assert int(rows[FRAME].max()) + 1 == 11, "one of the twelve frames is empty"
