"""Learning that begins by imitating glide: what is imitated, for how long, and what holds the policy afterwards."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType

from izoo.algos.actions.action_wrappers import RAW_ACTION, SpeedCap
from izoo.algos.drivers.base import DEFER
from izoo.algos.drivers.by_name import make_driver
from izoo.algos.learners import base
from izoo.algos.learners.imitation import LEAST_SPREAD
from izoo.envs.config import EnvConfig
from tests.algos.frames import act
from tests.algos.test_action_wrappers import RED, make, observe

ENV = EnvConfig()
WARM = ("algo.warm_start=glide", "algo.warm_start_frames=1200", "algo.lr=3e-3", "algo.hidden=[32]")
ALGOS = ["ppo", "mappo", "gcrl"]


def glide_batch(n: int = 3, t: int = 40, a: int = 6, seed: int = 0) -> TensorDict:
    """CVs at random distances before a red or a green light, one in three slots empty: glide slows some of them."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda: torch.rand((n, t, a), generator=generator)  # noqa: E731
    kinds = torch.stack([observe(context_lane_count=1.0), observe(**RED, context_lane_count=1.0)])
    observation = kinds[(draw() < 0.5).long()]
    observation[..., 1] = -1.2 * draw()
    mask = draw() < 2 / 3
    mask[:, :, 0] = True
    ends = torch.zeros(n, t, a, 1, dtype=torch.bool)
    ends[:, -1] = True
    after = {"observation": observation.roll(-1, 1), "reward": torch.randn(n, t, a, 1, generator=generator)}
    after |= {"mask": mask, "done": ends, "truncated": ends, "terminated": torch.zeros_like(ends)}
    agents = TensorDict({"observation": observation, "mask": mask}, [n, t, a])
    following = TensorDict({"agents": TensorDict(after, [n, t, a]), "done": ends[:, :, 0]}, [n, t])
    return TensorDict({"agents": agents, "next": following}, [n, t])


def test_advice_for_a_command_gives_that_command() -> None:
    cap, generator = SpeedCap(ENV, brake_mps2=1.5), torch.Generator().manual_seed(0)
    speed, limit = 12.0 * torch.rand(500, generator=generator), torch.full((500,), 15.0)
    accel = 3.5 * torch.rand(500, generator=generator) - 1.4
    defer = torch.rand(500, generator=generator) < 0.3
    heard = torch.ones(500, dtype=torch.bool)
    advice = cap.raw_action_for((speed, limit, heard), accel, defer)
    again, deferred = cap.command((speed, limit, heard), advice)
    assert torch.equal(deferred, defer | (advice <= 0.0)) and 0.5 < float((~deferred).float().mean()) < 0.8
    within = ~deferred & (advice < 1.0)
    torch.testing.assert_close(again[within], accel[within], atol=1e-4, rtol=0.0)
    # At or above the limit there is nothing to advise.
    assert not cap.raw_action_for((limit, limit, heard), torch.ones(500), torch.zeros(500, dtype=torch.bool)).any()
    assert not cap.raw_action_for((speed, limit, ~heard), accel, defer).any()


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGOS)
def test_the_policy_learns_to_drive_like_glide_and_to_leave_alone_whom_glide_does(algo: str) -> None:
    torch.manual_seed(0)
    algorithm = make(algo, *WARM, "algo.warm_start_frames=1000000", action="advise")
    batch = glide_batch()
    mask = batch[base.MASK]
    expert = make_driver("glide", ENV)(batch.copy())
    commanded = mask & ~expert[DEFER]
    assert 0.2 < float(commanded.sum() / mask.sum()) < 0.8, "glide commands some, and leaves others alone"
    wanted = algorithm.expert_action(batch).squeeze(-1)  # type: ignore[attr-defined]
    assert not wanted[mask & expert[DEFER]].any()
    losses = [algorithm.update(act(algorithm, batch), 0.0)["loss_imitation"] for _ in range(60)]
    assert losses[-1] < losses[0] - 0.5
    greedy = act(algorithm, batch, kind=ExplorationType.DETERMINISTIC)
    agree = (greedy[RAW_ACTION].squeeze(-1) > 0)[mask] == (wanted > 0)[mask]
    assert float(agree.float().mean()) > 0.9
    error = (greedy[RAW_ACTION].squeeze(-1) - wanted)[commanded].abs().mean()
    assert float(error) < 0.5 * float(wanted[commanded].mean())


def test_the_loss_is_that_of_a_censored_normal() -> None:
    """By hand: a density where glide advises, the probability of the band where it does not."""
    torch.manual_seed(0)
    algorithm = make("ppo", *WARM, "algo.epochs=1", "algo.minibatch_rows=100000", action="advise")
    batch = act(algorithm, glide_batch())
    mask = batch[base.MASK]
    wanted = algorithm.expert_action(batch)[mask].squeeze(-1)  # type: ignore[attr-defined]
    loc, scale = (batch[key][mask].squeeze(-1) for key in (base.LOC, base.SCALE))
    half_band, bound = 0.35 * 1.5547735945968535, 0.8
    normal = torch.distributions.Normal(loc, scale.clamp_min(LEAST_SPREAD))
    raw = torch.atanh(wanted / bound) + half_band
    density = normal.log_prob(raw) - torch.log(bound * (1.0 - (wanted / bound) ** 2))
    rest = torch.log(normal.cdf(torch.tensor(half_band)))
    expected = -torch.where(wanted > 0, density, rest).mean()
    assert algorithm.update(batch, 0.0)["loss_imitation"] == pytest.approx(float(expected), abs=1e-4)


@pytest.mark.parametrize("algo", ALGOS)
def test_after_the_warm_start_the_penalty_holds_the_policy_and_fades(algo: str) -> None:
    """Three batches of 120 frames are imitated where 300 are asked for; the penalty is linear in what is left."""
    torch.manual_seed(0)
    words = ("algo.warm_start_frames=300", "algo.kl_to_start=2", "algo.epochs=1", "algo.minibatch_rows=100000")
    algorithm = make(algo, *WARM, *words, action="advise")
    batch = glide_batch()
    seen = [algorithm.update(act(algorithm, batch), progress) for progress in (0.0, 0.1, 0.2, 0.3, 0.6)]
    assert ["loss_imitation" in stats for stats in seen] == [True, True, True, False, False]
    assert ["loss_objective" in stats for stats in seen] == [False, False, False, True, True]
    assert seen[3]["kl_to_start"] == pytest.approx(0.0, abs=1e-6), "nothing has been learned since"
    assert seen[4]["kl_to_start"] > 1e-6
    share = 1.0 - (0.6 - 0.2) / 0.8
    assert seen[4]["loss_kl_to_start"] == pytest.approx(2.0 * share * seen[4]["kl_to_start"], rel=1e-4)


def test_the_imitation_may_have_a_learning_rate_of_its_own() -> None:
    words = ("algo.warm_start_frames=200", "algo.warm_start_lr=0.01", "algo.lr=0.001", "algo.epochs=1")
    algorithm, batch = make("ppo", *WARM, *words, action="advise"), glide_batch()
    rates = [algorithm.update(act(algorithm, batch), progress)["lr"] for progress in (0.0, 0.2, 0.4)]
    assert rates == pytest.approx([0.01, 0.008, 0.0006])


def test_the_weight_of_a_penalty_that_does_not_act_stays() -> None:
    """Each batch of an imitation moves the policy far."""
    words = ("algo.warm_start_frames=1000000", "algo.warm_start_lr=0.05", "algo.kl_coeff=0.2")
    algorithm, batch = make("ppo", *WARM, *words, action="advise"), glide_batch()
    stats = [algorithm.update(act(algorithm, batch), 0.0) for _ in range(2)]
    assert stats[0]["kl"] > 0.02, "more than twice the aim"
    assert float(algorithm.learned.loss.kl_weight) == pytest.approx(0.2)


def test_the_penalty_keeps_the_policy_near_the_imitation() -> None:
    moved = []
    for weight in (0.0, 30.0):
        torch.manual_seed(0)
        words = ("algo.warm_start_frames=100", f"algo.kl_to_start={weight}")
        algorithm = make("ppo", *WARM, *words, action="advise")
        batch = glide_batch()
        algorithm.update(act(algorithm, batch), 0.0)
        before = act(algorithm, batch, kind=ExplorationType.DETERMINISTIC)[base.LOC].clone()
        for _ in range(15):
            algorithm.update(act(algorithm, batch), 0.0)
        after = act(algorithm, batch, kind=ExplorationType.DETERMINISTIC)[base.LOC]
        moved.append(float((after - before)[batch[base.MASK]].square().mean()))
    assert math.sqrt(moved[1]) < 0.5 * math.sqrt(moved[0])


@pytest.mark.parametrize("algo", ALGOS)
def test_state_is_restored_within_and_after_the_warm_start(algo: str) -> None:
    words = (*WARM, "algo.warm_start_frames=300", "algo.epochs=1")
    for batches in (1, 4):
        torch.manual_seed(0)
        first = make(algo, *words, action="advise")
        batch = glide_batch()
        for _ in range(batches):
            first.update(act(first, batch), 0.1)
        torch.manual_seed(5)
        second = make(algo, *words, action="advise")
        second.load_state_dict(copy.deepcopy(first.state_dict()))
        results = []
        for algorithm in (first, second):
            torch.manual_seed(6)
            results.append([algorithm.update(act(algorithm, batch), 0.5) for _ in range(3)])
        assert results[0] == results[1]
