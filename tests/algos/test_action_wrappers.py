"""Advice and corrections: what is stored, what is learned from, and what they stand for."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import AdviseAction, ResidualAction
from izoo.algos.actions.action_wrappers import (
    RAW_ACTION,
    ActionTransform,
    SpeedCap,
    TransformedAlgorithm,
    TransformedPolicy,
)
from izoo.algos.actions.residual import Correction, NominalDriver
from izoo.algos.drivers.base import DEFER
from izoo.algos.learners import base
from izoo.algos.learners.registry import ALGORITHMS, make_algorithm
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import FAR_M
from izoo.errors import IzooError
from tests.algos.frames import act, observed

ENV = EnvConfig()
NAMES = observation_names(ENV)
RED = {"signal_green": 0.0, "signal_red": 1.0, "signal_time_left": 30.0}

ONE_POLICY = sorted(set(ALGORITHMS) - {"cmaes", "glide_search"})
"""Algorithms that explore by the actions of one policy; the others compare several."""


def observe(**values: float) -> torch.Tensor:
    """An observation in SI units: a CV at 10 m/s, 100 m before a green light, on a free road, limit 15 m/s."""
    seen = {"speed": 10.0, "stop_line_distance": -100.0, "location_approaching": 1.0, "leader_distance": FAR_M}
    seen |= {"signal_green": 1.0, "signal_time_left": 20.0, "signal_second_green": 60.0, "signal_third_green": 120.0}
    seen |= {"context_green_s": 30.0, "context_red_s": 30.0, "context_speed_limit_mps": 15.0}
    return observed(ENV, **(seen | values))


def nominal(**values: float) -> float:
    observation = observe(**values).reshape(1, 1, -1)
    return float(NominalDriver(ENV)(observation, torch.ones(1, 1, dtype=torch.bool))[0])


def make(algo: str, *words: str, action: str = "residual") -> TransformedAlgorithm:
    torch.manual_seed(3)
    options = compose_config(TrainConfig, [f"algo={algo}", "algo.hidden=[8]", f"action={action}", *words])
    algorithm = make_algorithm(options.algo, options.action, options.env)
    assert isinstance(algorithm, TransformedAlgorithm)
    return algorithm


def make_batch(n: int = 2, t: int = 5, a: int = 3) -> TensorDict:
    """Noise around :func:`observe`; the last slot is empty."""
    generator = torch.Generator().manual_seed(0)
    shape = (n, t, a)
    mask = torch.ones(shape, dtype=torch.bool)
    mask[..., -1] = False
    ended = torch.zeros(*shape, 1, dtype=torch.bool)
    ended[0, 2, 1] = True
    draw = lambda: observe() + 0.1 * torch.randn(*shape, len(NAMES), generator=generator)  # noqa: E731
    successor = {"observation": draw(), "mask": mask, "done": ended, "terminated": ended}
    successor["reward"] = torch.randn(*shape, 1, generator=generator)
    agents = {"observation": draw(), "mask": mask}
    following = TensorDict({"agents": TensorDict(successor, shape)}, [n, t])
    return TensorDict({"agents": TensorDict(agents, shape), "next": following}, [n, t])


def test_nominal_is_glide_where_glide_commands() -> None:
    # Red for 30 s more, 100 m ahead: 2 s of start lag make it 32 s, so glide asks for its floor speed of 4 m/s.
    driver = NominalDriver(ENV)
    observation, mask = observe(**RED).reshape(1, 1, -1), torch.ones(1, 1, dtype=torch.bool)
    advised, idle = driver.glide.drive(observation, mask)
    assert not idle.any()
    accel, estimated = driver(observation, mask)
    torch.testing.assert_close(accel, advised)
    assert not estimated.any()
    assert nominal(**RED) < -0.5


def test_nominal_is_the_car_following_model_elsewhere() -> None:
    assert nominal() == pytest.approx(2.6 * (1 - (10 / 15) ** 4), abs=1e-4)
    assert nominal(speed=15.0) == pytest.approx(0.0, abs=1e-4)
    behind = {"leader_present": 1.0, "leader_distance": 14.0, "leader_speed": 8.0}
    desired = 2.0 + 10.0 * 1.0 + 10.0 * 2.0 / (2 * (2.6 * 4.5) ** 0.5)
    expected = 2.6 * (1 - (10 / 15) ** 4 - (desired / 14.0) ** 2)
    assert nominal(**behind) == pytest.approx(max(expected, -4.5), abs=1e-3)
    assert nominal(leader_present=1.0, leader_distance=0.0) == pytest.approx(-4.5)


def test_a_red_light_ahead_holds_but_not_in_the_last_metres() -> None:
    red = RED | {"signal_time_left": 5.0}
    far, near = (NominalDriver(ENV).follow(observe(**red, stop_line_distance=-d)) for d in (40.0, 10.0))
    desired = 10.0 * 1.0 + 10.0 * 10.0 / (2 * (2.6 * 4.5) ** 0.5)
    assert float(far) == pytest.approx(2.6 * (1 - (10 / 15) ** 4 - (desired / 40.0) ** 2), abs=1e-3)
    assert float(near) > 0


class Said(TensorDictModuleBase):
    """A policy that says what it is given."""

    in_keys, out_keys = [base.OBSERVATION], [base.ACTION]
    no_op_band = 0.0

    def __init__(self, advice: list[float]) -> None:
        super().__init__()
        self.advice = torch.tensor(advice).unsqueeze(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(base.ACTION, self.advice)


def say(transform: ActionTransform, advice: list[float], band: float = 0.0, **seen: float) -> TensorDict:
    """Let agents in one situation say something."""
    learned = Said(advice)
    learned.no_op_band = band
    agents = {"observation": observe(**seen).expand(len(advice), -1), "mask": torch.ones(len(advice), dtype=torch.bool)}
    return TransformedPolicy(learned, transform)(TensorDict({"agents": agents}))


def test_vehicles_that_glide_leaves_alone_can_only_be_held_back() -> None:
    acted = say(Correction(NominalDriver(ENV)), [-0.5, 0.0, 0.5])
    assert acted[DEFER].tolist() == [True, True, False]
    assert float(acted[base.ACTION][2]) == pytest.approx(nominal() - 0.5, abs=1e-5)
    acted = say(Correction(NominalDriver(ENV)), [-0.5, 0.0, 0.5], **RED)
    assert not acted[DEFER].any() and acted[base.TWO_SIDED].all()
    expected = nominal(**RED) + torch.tensor([0.5, 0.0, -0.5])
    torch.testing.assert_close(acted[base.ACTION].squeeze(-1), expected)


def test_advice_caps_the_speed_and_its_origin_is_doing_nothing() -> None:
    """At 10 m/s under a limit of 15: a cap of 9 m/s is 2 m/s^2 away, one of 6 needs the hardest braking allowed."""
    acted = say(SpeedCap(ENV, brake_mps2=2.5), [-0.3, 0.0, 0.4, 0.6, 0.2])
    assert acted[DEFER].tolist() == [True, True, False, False, False]
    torch.testing.assert_close(acted[base.ACTION].squeeze(-1)[2:], torch.tensor([-2.0, -2.5, 2.6]))


def test_advice_is_not_heard_behind_the_stop_line() -> None:
    for place in ("location_inside", "location_leaving"):
        assert say(SpeedCap(ENV, brake_mps2=2.5), [0.4, 0.8], location_approaching=0.0, **{place: 1.0})[DEFER].all()


def test_a_quiet_band_is_taken_off_and_what_was_said_is_kept() -> None:
    acted = say(SpeedCap(ENV, brake_mps2=2.5), [0.1, 0.2, 0.6], band=0.2)
    assert acted[DEFER].tolist() == [True, True, False]
    assert float(acted[base.ACTION][2]) == pytest.approx((15 * 0.6 - 10) / 0.5)
    torch.testing.assert_close(acted[RAW_ACTION].squeeze(-1), torch.tensor([0.1, 0.2, 0.6]))


@pytest.mark.parametrize("algo", ONE_POLICY)
@pytest.mark.parametrize("action", ["advise", "residual"])
def test_training_starts_from_doing_nothing(algo: str, action: str) -> None:
    """The untrained policy itself does nothing at all; exploring, it acts in the share of decisions that was asked."""
    algorithm, batch = make(algo, action=action), make_batch(t=400)
    acted = act(algorithm, batch, kind=ExplorationType.DETERMINISTIC)
    mask = batch[base.MASK]
    nominal, idle = NominalDriver(ENV)(batch[base.OBSERVATION], mask)
    if action == "advise":
        assert acted[DEFER][mask].all()
    else:
        assert torch.equal(acted[DEFER][mask], idle[mask])
        moved = mask & ~idle
        torch.testing.assert_close(acted[base.ACTION][moved].squeeze(-1), nominal[moved])
    explored = act(algorithm, batch)
    free = mask if action == "advise" else mask & idle
    if algo in ("ddpg", "td3"):  # each vehicle's noise must first have grown from 0, and one call is one step of it
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(30):
                explored = algorithm.policy(explored)
    share = float((~explored[DEFER][free]).float().mean())
    assert 0.04 < share < 0.11, "5 to 10 % of decisions act"


@pytest.mark.parametrize("algo", ONE_POLICY)
def test_corrections_stay_in_their_range_and_sums_in_the_environments(algo: str) -> None:
    algorithm = make(algo, "action.half_width_mps2=0.5")
    acted = act(algorithm, make_batch(t=400))
    assert 0.05 < float(acted[RAW_ACTION].abs().max()) <= 0.5
    assert float(acted[base.ACTION].min()) >= -4.5 and float(acted[base.ACTION].max()) <= 2.6
    assert set(algorithm.policy.out_keys) <= set(acted.keys(True, True))


@pytest.mark.parametrize("algo", ["ppo", "mappo", "gcrl"])
@pytest.mark.parametrize("action", ["advise", "residual"])
def test_log_probabilities_are_those_of_the_advice(algo: str, action: str) -> None:
    """Before the first update the ratio of PPO is 1 for what was stored, so its objective is the mean advantage: 0."""
    algorithm = make(algo, action=action)
    acted = act(algorithm, make_batch(t=100))
    own = acted.copy().set(base.ACTION, acted[RAW_ACTION])
    mask = acted[base.MASK]
    assert 0 < int((acted[RAW_ACTION][mask] != 0).sum()) < int((acted[RAW_ACTION][mask] == 0).sum())
    rows = algorithm.learned.advantages(own)  # type: ignore[attr-defined]
    losses = algorithm.learned.loss(rows)  # type: ignore[attr-defined]
    assert float(losses["loss_objective"].detach()) == pytest.approx(0.0, abs=1e-5)
    wrong = algorithm.learned.loss(algorithm.learned.advantages(acted))  # type: ignore[attr-defined]
    assert abs(float(wrong["loss_objective"].detach())) > 1e-3, "the command in the place of the advice must show here"


@pytest.mark.parametrize("algo", ONE_POLICY)
def test_update_sees_the_advice_and_leaves_the_batch_alone(algo: str) -> None:
    now = ("algo.learning_starts=0", "algo.minibatch_rows=8") if algo in ("ddpg", "td3") else ()
    one, other = (make(algo, *now) for _ in range(2))
    acted = act(one, make_batch())
    before = acted.clone()
    torch.manual_seed(5)
    stats = one.update(acted, 0.0)
    assert (acted == before).all()
    mask = acted[base.MASK]
    assert stats.pop("raw_action_abs") == pytest.approx(float(acted[RAW_ACTION][mask].abs().mean()))
    assert stats.pop("acting_share") == pytest.approx(float((~acted[DEFER][mask]).float().mean()))
    torch.manual_seed(5)
    assert other.learned.update(before.set(base.ACTION, before[RAW_ACTION]), 0.0) == pytest.approx(stats)


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(IzooError, match="half_width"):
        ResidualAction(half_width_mps2=0.0)
    with pytest.raises(IzooError, match="act_share"):
        AdviseAction(act_share=0.9)
    with pytest.raises(IzooError, match=r"action\.spread is 0\.01; it must lie in"):
        AdviseAction(spread=0.01)
    with pytest.raises(IzooError, match=r"add speed_limit_mps"):
        make_algorithm(TrainConfig().algo, AdviseAction(), EnvConfig(observed=("green_s",)))
    blind = dataclasses.replace(TrainConfig(action=ResidualAction()), env=EnvConfig(neighbours=()))
    with pytest.raises(IzooError, match="glide needs leader_present"):
        make_algorithm(blind.algo, blind.action, blind.env)
