"""MAPPO's critic: the attention by hand, who sees whom, and a real run."""

import math

import pytest
import torch

from izoo.algos.learners import base
from izoo.algos.learners.mappo import COUNT_SCALE, MAPPO, MAPPOConfig, SetCritic
from izoo.algos.learners.ppo import PPOConfig
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from tests.algos.frames import FEATURES, SPACE, make_frames


def make_critic(**changes: object) -> SetCritic:
    torch.manual_seed(2)
    config = MAPPOConfig(**{"hidden": (6, 6), "critic_queries": 2, "critic_embedding": 4, **changes})  # type: ignore[arg-type]
    return SetCritic(FEATURES, config)


def test_values_equal_a_hand_computation() -> None:
    """Three vehicles and an empty slot, in plain Python."""
    critic = make_critic()
    observation = torch.randn(4, FEATURES)
    observation[2] = float("nan")
    mask = torch.tensor([True, True, False, True])
    with torch.no_grad():
        values = critic(observation, mask)
        own = [critic.embed(observation[k]) for k in (0, 1, 3)]
        summaries = []
        for query in range(2):
            scores = [math.exp(float(critic.score(vector)[query])) for vector in own]
            summaries.append(sum(score / sum(scores) * vector for score, vector in zip(scores, own, strict=True)))
        shared = torch.cat([critic.gather(torch.cat(summaries)), torch.tensor([3 / COUNT_SCALE])])
        expected = torch.stack([critic.value(torch.cat([vector, shared])) for vector in own])
    torch.testing.assert_close(values[mask], expected)
    assert values.isfinite().all()


def test_an_empty_set_has_an_empty_summary() -> None:
    critic = make_critic()
    with torch.no_grad():
        summary = critic.attend(torch.randn(3, 4), torch.zeros(3, dtype=torch.bool))
        values = critic(torch.randn(3, FEATURES), torch.zeros(3, dtype=torch.bool))
    assert not summary.any()
    assert values.isfinite().all()


def test_the_critic_sees_everyone_and_the_policy_only_oneself() -> None:
    torch.manual_seed(0)
    mappo = MAPPO(MAPPOConfig(hidden=(8, 8)), FEATURES, SPACE)
    batch = make_frames()
    changed = batch.clone()
    changed[base.OBSERVATION][..., 0, :] += 1.0
    mask = batch[base.MASK]
    second = mask & (torch.arange(4) == 1) & mask[..., :1]
    with torch.no_grad():
        before, after = (mappo.loss.value_estimator.values(part, second) for part in (batch, changed))
        own = [mappo.policy.network(part[base.OBSERVATION])[0][second] for part in (batch, changed)]
    torch.testing.assert_close(*own)
    assert float((before - after).abs().min()) > 1e-4


def test_the_paper_preset_is_rllibs_ppo() -> None:
    paper, ppo = MAPPOConfig.paper(), PPOConfig.paper()
    assert {name: getattr(paper, name) for name in vars(ppo)} == vars(ppo) | {"name": paper.name}


def test_team_credit_with_rewards_that_are_not_the_teams_is_refused() -> None:
    with pytest.raises(IzooError, match=r"algo.credit=team .* env.reward.eta is 0.*fuel_team"):
        compose_config(TrainConfig, ["algo=mappo", "algo.credit=team", "env.reward=fuel"])
    chosen = compose_config(TrainConfig, ["algo=mappo", "algo.credit=team", "env.reward=fuel_team"])
    assert chosen.env.emit == ("team_reward",)
