"""Value normalisation: of valid agent-steps alone, turned back where advantages are estimated, kept in checkpoints."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import RunningValueNorm, ValueOperator

from izoo.algos.learners import base
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.losses.masked_gae import MaskedGAE
from tests.algos.frames import FEATURES, SPACE, act, make_frames
from tests.algos.test_ppo import make_ppo

KINDS = ("running", "popart")


def test_estimates_are_those_of_a_critic_that_speaks_in_the_rewards_unit() -> None:
    torch.manual_seed(0)
    network, norm = nn.Linear(FEATURES, 1), RunningValueNorm()
    norm.update(torch.tensor([[-500.0], [-100.0], [300.0]]))
    spread, centre = float(norm.scale()), float(norm.mean)

    class InUnits(nn.Module):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return network(observation) * spread + centre

    def estimate(module: nn.Module, norm: RunningValueNorm | None) -> TensorDict:
        value = ValueOperator(module, in_keys=[base.OBSERVATION], out_keys=[base.VALUE])
        return MaskedGAE(gamma=0.9, lmbda=0.8, value_network=value, value_norm=norm)(make_frames())

    ours, theirs = estimate(network, norm), estimate(InUnits(), None)
    for key in (base.ADVANTAGE, base.VALUE_TARGET):
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-5, atol=1e-3)
        assert float(theirs[key].abs().max()) > 100.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise", [1e9, float("nan")])
def test_statistics_are_of_the_valid_agent_steps(kind: str, noise: float) -> None:
    ppo = make_ppo(value_norm=kind, reward_scale=1.0)
    batch = act(ppo, make_frames())
    batch["next", "agents", "reward"].mul_(50.0).sub_(7.0)
    empty = ~batch[base.MASK]
    batch["next", "agents", "reward"][empty] = noise
    batch[base.OBSERVATION][empty] = noise
    targets = ppo.advantages(batch)[base.VALUE_TARGET]
    norm = ppo.loss.value_norm
    torch.testing.assert_close(norm.scale(), targets.std(0, correction=0), rtol=1e-4, atol=1e-4)
    normalised = norm.normalize(targets)
    torch.testing.assert_close(normalised.mean(), torch.tensor(0.0), rtol=0.0, atol=1e-4)
    torch.testing.assert_close(norm.denormalize(normalised), targets, rtol=1e-4, atol=1e-3)


def test_the_teams_statistics_are_of_all_frames() -> None:
    torch.manual_seed(0)
    config = MAPPOConfig(hidden=(6, 6), critic_queries=2, critic_embedding=4, credit="team", value_norm="running")
    mappo = MAPPO(config, FEATURES, SPACE)
    batch = act(mappo, make_frames())
    batch["next", "done"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    batch["next", "terminated"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    batch["next", "team_reward"] = torch.randn(2, 6, 1) * 30.0
    assert not batch[base.MASK].any(-1).all(), "some frames are empty"
    mappo.advantages(batch)
    assert float(mappo.loss.value_norm.count) == 12


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_large_returns_are_learned_as_fast_as_small_ones(kind: str) -> None:
    """Rewards of thousands that depend on what is observed: without normalisation the critic lags far behind."""
    found, settings = {}, {"lr": 5e-3, "anneal_lr": False, "gamma": 0.0, "reward_scale": 1.0, "separate_clips": True}
    settings["minibatch_rows"] = 16
    for name in ("none", kind):
        ppo = make_ppo(value_norm=name, **settings)
        for round_ in range(25):
            batch = act(ppo, make_frames(n=4, t=16, seed=round_))
            batch["next", "agents", "reward"] = 2000.0 + 1000.0 * batch[base.OBSERVATION][..., :1]
            found[name] = ppo.update(batch, 0.0)["explained_variance"]
    assert found[kind] > 0.8, found
    assert found["none"] < 0.3, found
