"""The losses alone: padding, slots' order and masks mean what they say."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss, DDPGLoss, LossModule, TD3Loss, ValueEstimators
from torchrl.objectives.value import GAE

from izoo.algos.learners import base
from izoo.algos.learners.ddpg import Squash
from izoo.algos.learners.mappo import MAPPOConfig, TeamCritic
from izoo.algos.losses import MaskedDDPGLoss, MaskedGraphPPOLoss, MaskedMAPPOLoss, MaskedPPOLoss, MaskedTD3Loss
from izoo.algos.losses.masked_gae import MaskedGAE
from izoo.algos.networks.gaussian import normal_parameters, tanh_normal
from izoo.errors import IzooError
from tests.algos.frames import FEATURES, HIGH, LOW, SPACE, make_frames, reordered, with_noise

OBSERVATION, MASK, ACTION = base.OBSERVATION, base.MASK, base.ACTION


class Among(nn.Module):
    """A network on a set: one's own observation beside the mean of all who are there, ``[*M, A, outputs]``."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2 * FEATURES, 8), nn.Tanh(), nn.Linear(8, outputs))
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, observation: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        there = mask.unsqueeze(-1)
        total = torch.where(there, observation, 0.0).sum(-2, keepdim=True)
        mean = total / there.sum(-2, keepdim=True).clamp_min(1)
        return self.layers(torch.cat([observation, mean.expand_as(observation)], -1))


def actor(among: bool) -> object:
    network = Among(2) if among else nn.Sequential(nn.Linear(FEATURES, 8), nn.Tanh(), nn.Linear(8, 2))
    last = network.layers[-1] if among else network[-1]
    nn.init.zeros_(last.bias)
    extract = normal_parameters(last, SPACE, 0.0, 0.5)

    class Both(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network, self.extract = network, extract

        def forward(self, *seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return self.extract(self.network(*seen))

    return tanh_normal(Both(), [OBSERVATION, MASK] if among else [OBSERVATION], SPACE)


def critic(among: bool) -> ValueOperator:
    network = Among(1) if among else nn.Linear(FEATURES, 1)
    return ValueOperator(network, in_keys=[OBSERVATION, MASK] if among else [OBSERVATION], out_keys=[base.VALUE])


def make(kind: str, **options: object) -> LossModule:
    torch.manual_seed(1)
    if kind in OFF_POLICY:
        policy = nn.Sequential(nn.Linear(FEATURES, 8), nn.Tanh(), nn.Linear(8, 1), Squash(SPACE))

        class Value(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.layers = nn.Sequential(nn.Linear(FEATURES + 1, 8), nn.Tanh(), nn.Linear(8, 1))

            def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
                return self.layers(torch.cat([observation, action], -1))

        value = ValueOperator(Value(), in_keys=[OBSERVATION, ACTION], out_keys=[base.ACTION_VALUE])
        network = TensorDictModule(policy, [OBSERVATION], [ACTION])
        if kind == "td3":  # without noise on the targets, which is drawn row by row
            options = {"bounds": (LOW, HIGH), "target_noise": 0.0, **options}
            return MaskedTD3Loss(network, value, **options)  # type: ignore[arg-type]
        return MaskedDDPGLoss(network, value, **options)  # type: ignore[arg-type]
    losses = {"ppo": MaskedPPOLoss, "mappo": MaskedMAPPOLoss, "graph": MaskedGraphPPOLoss}
    return losses[kind](actor(kind == "graph"), critic(kind != "ppo"), **options)  # type: ignore[arg-type]


def collect(loss: LossModule, seed: int = 0) -> TensorDict:
    """What a collector would hand over: frames ``[N, T]`` with noise in empty slots, and actions in all."""
    batch = make_frames(n=2, t=6, seed=seed)
    torch.manual_seed(seed)
    if isinstance(loss, (DDPGLoss, TD3Loss)):
        return batch.set(ACTION, torch.rand(*batch[MASK].shape, 1) * (HIGH - LOW) + LOW)
    batch.set(ACTION, torch.rand(*batch[MASK].shape, 1) * 2.0 - 1.0)
    return batch.set(base.LOG_PROB, torch.full(batch[MASK].shape, -1.3))


OFF_POLICY = {"ddpg": DDPGLoss, "td3": TD3Loss}
KINDS = ("ppo", "mappo", "graph", *OFF_POLICY)


def total(loss: LossModule, batch: TensorDict) -> torch.Tensor:
    return sum(value for key, value in loss(batch).items() if key.startswith("loss_"))  # type: ignore[return-value]


def gradients(loss: LossModule, batch: TensorDict) -> list[torch.Tensor]:
    loss.zero_grad()
    total(loss, batch).backward()
    return [p.grad.clone() for p in loss.parameters() if p.grad is not None]


@pytest.mark.parametrize("kind", KINDS)
def test_they_are_torchrls_own(kind: str) -> None:
    loss = make(kind)
    assert isinstance(loss, OFF_POLICY.get(kind, ClipPPOLoss))
    if kind not in OFF_POLICY:
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.8)
        assert isinstance(loss.value_estimator, GAE) and float(loss.value_estimator.gamma) == pytest.approx(0.9)


@pytest.mark.parametrize("noise", [1e6, float("nan")])
@pytest.mark.parametrize("kind", KINDS)
def test_what_empty_slots_hold_is_as_if_it_were_not_there(kind: str, noise: float) -> None:
    loss = make(kind)
    clean = collect(loss)
    expected = gradients(loss, clean)
    for one, other in zip(expected, gradients(loss, with_noise(clean, noise)), strict=True):
        torch.testing.assert_close(one, other)
    assert any(part.any() for part in expected)


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_and_number_of_slots_change_nothing(kind: str) -> None:
    loss = make(kind)
    batch = collect(loss)
    for one, other in zip(gradients(loss, batch), gradients(loss, reordered(batch)), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_not_finite_in_a_valid_slot_is_named(kind: str) -> None:
    loss = make(kind)
    batch = collect(loss)
    batch[OBSERVATION][1, 2, 0, 3] = float("nan")
    with pytest.raises(IzooError, match=r"'observation'.* is NaN in 1 valid agent-steps, first in entry \[1, 2, 0\]"):
        total(loss, batch)
    if kind == "ppo":
        rows = loss.rows(loss.value_estimator(collect(loss)))
        rows[OBSERVATION][5, 3] = float("nan")
        with pytest.raises(IzooError, match=r"'observation'.* is NaN in 1 valid agent-steps, first in row 5"):
            loss(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_of_nobody_there_is_nothing_to_learn(kind: str) -> None:
    """Minibatches without a vehicle are common in light traffic, and stock training loops hand them over."""
    loss = make(kind)
    batch = collect(loss)
    some = {key for key in loss(batch.clone()).keys() if key.startswith("loss_")}  # noqa: SIM118
    batch[MASK][:] = False
    if kind not in OFF_POLICY:
        batch = loss.value_estimator(batch)
        assert not batch[base.ADVANTAGE].any()
    losses = loss(batch)
    assert some <= set(losses.keys()) and all(float(value.detach()) == 0.0 for value in losses.values())
    assert all(not part.any() for part in gradients(loss, batch))
    assert len(gradients(loss, batch)) == len(list(loss.parameters())), "the loss has no graph"
    if kind in OFF_POLICY:
        assert batch[loss.tensor_keys.priority].shape == batch[MASK].shape


@pytest.mark.parametrize("kind", ["ppo", *OFF_POLICY])
def test_a_batch_without_a_mask_is_rows(kind: str) -> None:
    loss = make(kind)
    batch = collect(loss)
    if kind == "ppo":
        batch = loss.value_estimator(batch)
    expected = gradients(loss, batch)
    rows = loss.rows(batch)
    for one, other in zip(expected, gradients(loss, rows), strict=True):
        torch.testing.assert_close(one, other)


def test_networks_that_see_one_agent_alone_are_refused_where_they_should_see_all() -> None:
    with pytest.raises(IzooError, match=r"the critic reads .* one agent alone"):
        MaskedMAPPOLoss(actor(False), critic(False))  # type: ignore[arg-type]
    with pytest.raises(IzooError, match=r"the actor reads .* one agent alone"):
        MaskedGraphPPOLoss(actor(False), critic(True))  # type: ignore[arg-type]


def test_the_teams_advantage_is_the_recursion_by_hand_and_shared() -> None:
    """Leaving does not end the team's return; the root's done does. A frame without agents has its value, too."""
    torch.manual_seed(0)
    batch = make_frames()
    done = torch.zeros(2, 6, 1, dtype=torch.bool)
    done[1, 3] = True
    following = batch["next"]
    following["done"], following["terminated"] = done, torch.zeros_like(done)
    following["team_reward"] = torch.randn(2, 6, 1)
    network = TeamCritic(FEATURES, MAPPOConfig(hidden=(6, 6), critic_queries=2, critic_embedding=4))
    value = ValueOperator(network, in_keys=[OBSERVATION, MASK], out_keys=[base.VALUE])
    found = MaskedGAE(gamma=0.9, lmbda=0.8, value_network=value, team=True)(batch.clone())
    with torch.no_grad():
        now, then = (network(part[OBSERVATION], part[MASK]).squeeze(-1) for part in (batch, following))
    for n in range(2):
        running = 0.0
        for t in reversed(range(6)):
            bootstrap = now[n, t + 1] if t < 5 and not done[n, t] else then[n, t]
            delta = following["team_reward"][n, t, 0] + 0.9 * bootstrap - now[n, t]
            running = delta + 0.9 * 0.8 * (0.0 if done[n, t] else running)
            mask = batch[MASK][n, t]
            shared = found[base.ADVANTAGE][n, t].squeeze(-1)
            torch.testing.assert_close(shared, torch.where(mask, running, 0.0), atol=1e-5, rtol=1e-5)
    assert not batch[MASK][0, 4].any(), "the scenario has a frame without agents"
