"""CMA-ES over linear policies: who plays what, what is learned, and that it goes on where it stopped."""

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import train
from izoo.algos.actions.action_modes import ActionSpace, PointMass
from izoo.algos.learners import base
from izoo.algos.learners.cmaes import CMAES, CMAESConfig
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.contexts.procedural import EASY
from izoo.contexts.source import RandomSchedule
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.training import run_folder
from izoo.training.run_state import shared

FEATURES, AGENTS, STEPS, BLOCK = 5, 6, 4, 3
GOAL = torch.tensor([1.0, -1.0, 0.5, 0.0, 0.0])


def frames(envs: int) -> TensorDict:
    """One observation and mask per environment; those of a block's environments are every block's."""
    generator = torch.Generator().manual_seed(3)
    seen = torch.randn(BLOCK, AGENTS, FEATURES, generator=generator).repeat(envs // BLOCK, 1, 1)
    mask = (torch.rand(BLOCK, AGENTS, generator=generator) < 0.7).repeat(envs // BLOCK, 1)
    return TensorDict({"agents": {"observation": seen, "mask": mask}}, [envs])


def make(population: int = 8, seed: int = 0, point_mass: PointMass | None = None) -> CMAES:
    torch.manual_seed(seed)
    return CMAES(CMAESConfig(population=population), FEATURES, ActionSpace(-0.8, 0.8, point_mass or PointMass()))


def act(algorithm: CMAES, envs: int, kind: ExplorationType = ExplorationType.RANDOM) -> TensorDict:
    with set_exploration_type(kind):
        return algorithm.policy(frames(envs))


def generation(algorithm: CMAES) -> TensorDict:
    """A batch whose team reward is highest where actions are those of :data:`GOAL`, times 0.3."""
    envs = len(algorithm.policy.candidates) * BLOCK
    acted = act(algorithm, envs)
    mask, wanted = acted[base.MASK], torch.tanh(0.3 * acted[base.OBSERVATION] @ GOAL) * 0.8
    error = ((acted[base.ACTION].squeeze(-1) - wanted).square() * mask).sum(-1) / mask.sum(-1)
    reward = -(1.0 + error)[:, None, None].expand(envs, STEPS, 1) / STEPS
    done = torch.zeros(envs, STEPS, 1, dtype=torch.bool)
    done[:, -1] = True
    return TensorDict({"next": {TEAM_REWARD: reward, "done": done}}, [envs, STEPS])


def test_blocks_of_environments_belong_to_one_policy_each() -> None:
    algorithm = make()
    acted = act(algorithm, 8 * BLOCK)
    one = frames(BLOCK)
    for number in range(8):
        own = algorithm.policy.candidates[number]
        raw = one[base.OBSERVATION].clamp(-2.0, 2.0) @ own[:-1] + own[-1]
        wanted = 0.8 * torch.tanh(raw.sign() * (raw.abs() - 0.3).clamp_min(0.0)) * one[base.MASK]
        there = acted[number * BLOCK : (number + 1) * BLOCK]
        torch.testing.assert_close(there[base.ACTION].squeeze(-1), wanted)
    assert float(acted[base.ACTION].abs().max()) > 0.1


def test_untrained_it_does_nothing_and_empty_slots_hold_nothing() -> None:
    algorithm = make()
    assert not act(algorithm, BLOCK, ExplorationType.DETERMINISTIC)[base.ACTION].any()
    acted = act(algorithm, 8 * BLOCK)
    assert not acted[base.ACTION].squeeze(-1)[~acted[base.MASK]].any()
    # Without a rest it begins at full throttle.
    acted = act(CMAES(CMAESConfig(), FEATURES, ActionSpace(-4.5, 2.6)), BLOCK, ExplorationType.DETERMINISTIC)
    assert float(acted[base.ACTION][acted[base.MASK]].min()) > 2.5


def test_in_evaluation_mode_it_is_its_mean_for_any_number_of_environments() -> None:
    algorithm = make()
    algorithm.policy.mean.normal_()
    explored = algorithm.policy.eval()(frames(BLOCK))
    algorithm.policy.train()
    assert torch.equal(explored[base.ACTION], act(algorithm, BLOCK, ExplorationType.DETERMINISTIC)[base.ACTION])


def test_it_finds_what_is_paid() -> None:
    algorithm = make(population=16)
    first = algorithm.update(generation(algorithm), 0.0)
    for _ in range(60):
        algorithm.update(generation(algorithm), 0.0)
    mean = algorithm.policy.mean
    likeness = torch.nn.functional.cosine_similarity(mean[:3], GOAL[:3], dim=0)
    assert float(likeness) > 0.95
    assert first["return_spread"] > algorithm.update(generation(algorithm), 0.0)["return_spread"]


def test_it_goes_on_exactly_where_it_stopped() -> None:
    one, other = make(), make(seed=1)
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    for _ in range(5):
        one.update(generation(one), 0.0)
    assert not torch.equal(one.policy.candidates, other.policy.candidates)
    other.load_state_dict(one.state_dict())
    for _ in range(5):
        assert torch.equal(one.policy.candidates, other.policy.candidates)
        one.update(generation(one), 0.0)
        other.update(generation(other), 0.0)
    assert np.random.get_state()[1].tolist() == before, "the global generator is left alone"  # noqa: NPY002


def test_what_cannot_be_compared_is_refused() -> None:
    algorithm = make()
    with pytest.raises(IzooError, match="one number, not 2"):
        CMAES(CMAESConfig(), FEATURES, ActionSpace(0.2, 1.0, size=2))
    with pytest.raises(IzooError, match="cannot share 12 environments"):
        act(algorithm, 12)
    batch = generation(algorithm)
    batch["next", "done"][0, -1] = False
    with pytest.raises(IzooError, match="whole episodes"):
        algorithm.update(batch, 0.0)


def test_all_blocks_play_the_same_episodes_and_each_only_once() -> None:
    schedule = functools.partial(shared, RandomSchedule(EASY, 0), 12, 4)
    for number in range(3):
        rounds = [[schedule(number * 12 + block * 3 + k)[1] for k in range(3)] for block in range(4)]
        assert all(seeds == rounds[0] for seeds in rounds)
    seeds = [schedule(number * 12 + k)[1] for number in range(3) for k in range(3)]
    assert len(set(seeds)) == 9


@pytest.mark.slow
@pytest.mark.parametrize(
    "algo",
    [
        "algo=cmaes action=advise",
        "algo=glide_search action=direct",
        "algo=cmaes action=speed env.action=speed env.action_parts=[glide]",
    ],
)
def test_a_run_can_be_stopped_and_resumed_exactly(algo: str, tmp_path: Path) -> None:
    words = [*algo.split(), "algo.population=4", "num_envs=4", "simulator=twin", "twin.threads=1"]
    words += ["twin.surrogate=compiled", "twin.compare_every=0", "env.reward=fuel_team", "env.hold_s=2"]
    words += ["env.horizon_s=150", "contexts=pcg_easy", "contexts.inflow_vph_per_lane=600"]
    words += ["validation.every_batches=0", "evaluation.contexts=0", "checkpoint.every_batches=1"]
    whole, half = tmp_path / "whole", tmp_path / "half"
    decisions = EnvConfig(horizon_s=150.0, hold_s=2.0).decisions * 4
    assert train.main([*words, f"total_frames={4 * decisions}", f"run_dir={whole}"]) == 0
    assert train.main([*words, f"total_frames={2 * decisions}", f"run_dir={half}"]) == 0
    assert train.main([f"resume={half}", f"total_frames={4 * decisions}"]) == 0
    one, other = (run_folder.load_algorithm(path)[0].state_dict() for path in (whole, half))
    assert len(one["returns"]) == 4 and one["returns"].nan_to_num().std() > 0.0
    torch.testing.assert_close(one["returns"], other["returns"], rtol=0.0, atol=0.0, equal_nan=True)
    assert torch.equal(one["policy"]["candidates"], other["policy"]["candidates"])
