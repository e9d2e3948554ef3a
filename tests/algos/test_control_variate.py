"""The control variate: what it takes from advantages no action decides, and with it gradients vary less."""

import pytest
import torch
from tensordict import TensorDict

from izoo.algos.learners import base
from izoo.algos.learners.mappo import MAPPO, TEAM_BASELINE, MAPPOConfig
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.errors import IzooError
from tests.algos.frames import FEATURES, SPACE, act, make_frames

GAMMA = 0.9


def make(control_variate: bool, lmbda: float = 1.0) -> MAPPO:
    torch.manual_seed(2)
    small = {"hidden": (6, 6), "critic_queries": 2, "critic_embedding": 4, "gamma": GAMMA, "reward_scale": 1.0}
    variate = "team" if control_variate else "none"
    config = MAPPOConfig(credit="team", control_variate=variate, gae_lambda=lmbda, **small)  # type: ignore[arg-type]
    return MAPPO(config, FEATURES, SPACE)


def episodes(algorithm: MAPPO, seed: int) -> TensorDict:
    """Two whole episodes of six steps, in one of which vehicles leave early; a busy and an idle place."""
    batch = act(algorithm, make_frames(seed=seed), seed)
    done = torch.zeros(2, 6, 1, dtype=torch.bool)
    done[:, -1] = True
    batch["next", "done"], batch["next", "terminated"] = done, done.clone()
    generator = torch.Generator().manual_seed(seed)
    busy = torch.randn(2, 6, 1, generator=generator) * 10.0
    batch["next", TEAM_BASELINE] = busy
    mask = batch[base.MASK]
    action = torch.where(mask.unsqueeze(-1), batch[base.ACTION], 0.0).sum(-2)
    batch["next", TEAM_REWARD] = busy + action
    return batch


def raw_advantages(algorithm: MAPPO, batch: TensorDict) -> torch.Tensor:
    """Advantages ``[2, 6, A]`` before they are normalised."""
    estimator, kept = algorithm.loss.value_estimator, {}
    forward = estimator.forward

    def remember(*args: object, **options: object) -> TensorDict:
        kept["estimated"] = forward(*args, **options)  # type: ignore[arg-type]
        return kept["estimated"]

    estimator.forward = remember  # type: ignore[method-assign]
    try:
        algorithm.advantages(batch)
    finally:
        del estimator.forward
    return kept["estimated"][base.ADVANTAGE].squeeze(-1)


def test_what_is_taken_away_depends_on_no_action() -> None:
    """It is the discounted sum of the uncommanded rewards to the end of the episode, whoever left before."""
    plain, less = make(False), make(True)
    for seed in range(3):
        batch = episodes(plain, seed)
        other = batch.clone()
        other[base.ACTION] = torch.randn_like(other[base.ACTION])
        other["next", TEAM_REWARD] = torch.randn_like(other["next", TEAM_REWARD]) * 100.0
        running, expected = torch.zeros(2), torch.zeros(2, 6)
        for t in reversed(range(6)):
            running = batch["next", TEAM_BASELINE][:, t, 0] + GAMMA * running
            expected[:, t] = running
        mask = batch[base.MASK]
        expected = torch.where(mask, expected.unsqueeze(-1), 0.0)
        for played in (batch, other):
            taken = raw_advantages(plain, played) - raw_advantages(less, played)
            torch.testing.assert_close(taken, expected, rtol=1e-4, atol=1e-3)


def test_it_fits_the_credit() -> None:
    with pytest.raises(IzooError, match=r"control_variate=team does not go with .* choose vehicle or none"):
        MAPPOConfig(control_variate="team")
    with pytest.raises(IzooError, match=r"control_variate=vehicle does not go with .* choose team or none"):
        MAPPOConfig(control_variate="vehicle", credit="team")
