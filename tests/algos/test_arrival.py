"""Actions that say when to arrive: which speeds they stand for, and that learners learn from what they said."""

import contextlib
from typing import Any

import pytest
import torch

from izoo.algos.actions.action_modes import ArriveAction
from izoo.algos.actions.action_wrappers import RAW_ACTION
from izoo.algos.actions.arrival import Arrival
from izoo.algos.learners.base import ACTION, DECIDES, MASK
from izoo.algos.learners.decisions import Decisions
from izoo.algos.learners.registry import make_algorithm, preset
from izoo.envs import EnvConfig, TwinEnv
from izoo.errors import IzooError
from tests.algos.frames import observed
from tests.envs.worlds import crossing

PARTS = ("speed_before", "speed_behind")
SLOTS: dict[str, Any] = {"num_agents": 16, "num_vehicles": 64, "emit": ()}
CONFIG = EnvConfig(horizon_s=150.0, warmup_s=5.0, decide="vehicle", action="speed", action_parts=PARTS, **SLOTS)
LIMIT_MPS, GREEN_S, RED_S = 10.0, 20.0, 30.0


def seen(distance_m: float, colour: str, left_s: float, second_s: float) -> torch.Tensor:
    """What a vehicle observes before a signal of 20 s of green and 30 s of red, ``[1, F]``."""
    times = {"signal_time_left": left_s, "signal_second_green": second_s, f"signal_{colour}": 1.0}
    times |= {"signal_third_green": second_s + GREEN_S + RED_S, "context_green_s": GREEN_S, "context_red_s": RED_S}
    return observed(CONFIG, context_speed_limit_mps=LIMIT_MPS, stop_line_distance=-distance_m, **times).unsqueeze(0)


@pytest.mark.parametrize(
    ("observation", "late", "arrival_s"),
    [
        (seen(100.0, "red", 20.0, 70.0), 0.0, 20.0),  # 10 s away, green in 20 s
        (seen(100.0, "red", 20.0, 70.0), 0.5, 30.0),
        (seen(100.0, "green", 15.0, 45.0), 0.0, 10.0),  # it is green, and stays so until it is there
        (seen(100.0, "green", 15.0, 45.0), 0.9, 13.0),  # 5 of 20 s have gone by; 18 of them in 13 s
        (seen(200.0, "green", 15.0, 45.0), 0.1, 47.0),  # too far for this green
        (seen(100.0, "red", 2.0, 52.0), 0.1, 10.0),  # no earlier than the limit allows
    ],
)
def test_speeds_are_those_that_arrive_in_time(observation: torch.Tensor, late: float, arrival_s: float) -> None:
    arrival = Arrival(CONFIG, slowest=0.2)
    speeds, _ = arrival.command((observation,), torch.tensor([[late, 0.25]]))
    distance_m = -float(arrival.seen(observation, "stop_line_distance"))
    assert float(speeds[0, 0]) * LIMIT_MPS == pytest.approx(distance_m / arrival_s, rel=1e-4)
    assert float(speeds[0, 1]) == pytest.approx(0.8)
    three, _ = arrival.command((observation,), torch.tensor([[late, 0.25, 0.5]]))
    assert torch.equal(three[:, :2], speeds) and float(three[0, 2]) == pytest.approx(0.55)


def test_who_is_past_the_line_or_would_have_to_creep_stays_within_bounds() -> None:
    arrival = Arrival(CONFIG, slowest=0.2)
    past, far = seen(-20.0, "green", 5.0, 35.0), seen(20.0, "red", 29.0, 79.0)
    assert float(arrival.command((past,), torch.tensor([[0.9, 0.0]]))[0][0, 0]) == 1.0
    assert arrival.command((far,), torch.tensor([[0.9, 1.0]]))[0][0].tolist() == pytest.approx([0.2, 0.2])


@pytest.mark.parametrize(("name", "stop"), [("ppo", False), ("ppo", True), ("ddpg", False)])
def test_learners_learn_from_what_they_said(name: str, stop: bool) -> None:
    torch.manual_seed(0)
    mode = ArriveAction(stop=stop)
    config = EnvConfig(**(vars(CONFIG) | mode.commands))
    algorithm: Any = make_algorithm(preset(name), mode, config)
    with (
        contextlib.closing(TwinEnv(2, crossing(adoption=0.6), config=config, threads=1, shard=0)) as env,
        torch.no_grad(),
    ):
        batch = env.rollout(40, algorithm.policy, break_when_any_done=False)
    asked = batch[MASK] & batch[DECIDES]
    assert ((batch[RAW_ACTION][asked] > 0.0) & (batch[RAW_ACTION][asked] < 1.0)).all()
    assert ((batch[ACTION][asked] >= 0.1) & (batch[ACTION][asked] <= 1.0)).all()
    assert batch[ACTION].shape[-1] == 2 + stop
    decisions = Decisions()(batch)
    given: dict[str, torch.Tensor] = {}
    algorithm.learned.update = lambda own, progress: given.update(action=own[ACTION]) or {}
    algorithm.update(decisions, 0.0)
    assert torch.equal(given["action"], decisions[RAW_ACTION]) and not torch.equal(given["action"], decisions[ACTION])


def test_what_must_be_observed_is_said() -> None:
    blind = EnvConfig(**(vars(CONFIG) | {"observed": ("red_s", "speed_limit_mps")}))
    with pytest.raises(IzooError, match="action=arrive needs context_green_s"):
        Arrival(blind, 0.2)
