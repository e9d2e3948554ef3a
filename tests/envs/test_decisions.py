"""Decisions that last several steps: trajectories, sums of rewards, CVs that leave or enter during a decision."""

import contextlib
from collections import defaultdict

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from tests.envs.worlds import crossing, play, short, steering

HOLD_STEPS = 4
CONFIG = short(horizon_s=150.0, hold_s=2.0)
SEED = 5


def numbers(part: TensorDictBase) -> list[int]:
    """Number of the vehicle in every agent slot, -1 where the slot is empty."""
    found = part["vehicles", "vehicle_number"].long()[part["agents", "vehicle"]]
    return torch.where(part["agents", "mask"], found, -1).tolist()  # type: ignore[no-any-return]


def decide(state: TensorDictBase) -> dict[int, float]:
    """An action for every CV that is there, by the vehicle's number."""
    chosen = steering(state["agents", "observation"]).squeeze(-1).tolist()
    return {number: action for number, action in zip(numbers(state), chosen, strict=True) if number >= 0}


def command(state: TensorDictBase, actions: dict[int, float]) -> TensorDictBase:
    """Command the vehicles that decided; the others are uncommanded."""
    held = numbers(state)
    state["agents", "action"] = torch.tensor([actions.get(number, 0.0) for number in held]).unsqueeze(-1)
    state["agents", "defer"] = torch.tensor([number not in actions for number in held])
    return state


@pytest.fixture(scope="module")
def decisions() -> TensorDict:
    with contextlib.closing(EcoDrivingEnv(config=CONFIG)) as env:
        return play(env, CONFIG.decisions, lambda s: command(s, decide(s)), env.reset(context=crossing(), seed=SEED))


def test_a_decision_equals_its_steps(decisions: TensorDict) -> None:
    """Repeating its actions step by step gives the same traffic, and the same total rewards."""
    ended: set[int] = set()
    with contextlib.closing(EcoDrivingEnv(config=short(horizon_s=150.0))) as env:
        state = env.reset(context=crossing(), seed=SEED)
        for frame in decisions.unbind(0):
            assert sorted(numbers(state)) == sorted(numbers(frame))
            actions, rewards = decide(state), defaultdict(float)
            for _ in range(HOLD_STEPS):
                asked = numbers(state)
                following = env.step(command(state, actions))["next"]
                for number, reward, over in zip(
                    asked, following["agents", "reward"], following["agents", "terminated"], strict=True
                ):
                    if number in actions:
                        rewards[number] += float(reward)
                        ended |= {number} if bool(over) else set()
                state = following.exclude(("agents", "reward"))
                if bool(following["done"]):
                    break
            ours = dict(zip(numbers(frame), frame["next", "agents", "reward"].squeeze(-1).tolist(), strict=True))
            ours.pop(-1, None)
            assert ours == pytest.approx(dict(rewards), abs=1e-4)
            one, other = following["vehicles"], frame["next", "vehicles"]
            for name in ("vehicle_number", "speed_mps", "path_position_m"):
                mine, theirs = (part[name][part["present"]].sort().values for part in (one, other))
                torch.testing.assert_close(mine, theirs)
        assert bool(following["done"])
        for name, value in following["metrics", "approach"].items():
            torch.testing.assert_close(value, decisions[-1]["next", "metrics", "approach", name], msg=name)
        episode = decisions[-1]["next", "metrics", "episode"]
        torch.testing.assert_close(following["metrics", "episode", "return"], episode["return"])
    left = ((numbers(frame), frame["next", "agents", "terminated"]) for frame in decisions.unbind(0))
    gone = {number for held, over in left for number, end in zip(held, over, strict=True) if end}
    assert gone == ended and len(gone) > 5


def test_the_last_decision_may_be_shorter(decisions: TensorDict) -> None:
    assert CONFIG.control_steps % HOLD_STEPS == 2, "the scenario must have a shorter one"
    assert len(decisions) == -(-CONFIG.control_steps // HOLD_STEPS)
    done = decisions["next", "done"].squeeze(-1)
    assert done[-1] and not done[:-1].any()
    assert decisions[-1]["next", "metrics", "episode", "steps"].item() == CONFIG.control_steps


def test_next_shows_the_same_vehicle_or_an_empty_slot(decisions: TensorDict) -> None:
    """A slot whose vehicle left during a decision is empty when it ends, even if others entered meanwhile."""
    entered = 0
    for frame in decisions.unbind(0):
        before, after = numbers(frame), numbers(frame["next"])
        for slot, (now, then) in enumerate(zip(before, after, strict=True)):
            left = bool(frame["next", "agents", "terminated"][slot])
            if now >= 0:
                assert then == (-1 if left else now)
            else:
                assert not left and float(frame["next", "agents", "reward"][slot]) == 0.0
                entered += then >= 0
    assert entered > 10, "new vehicles make their first decision when the present one ends"


@pytest.mark.parametrize(
    ("hold_s", "message"), [(0.25, "hold_s is 0.25.*0.5"), (0.7, "Give 0.5 or 1,"), (0.0, "hold_s is 0")]
)
def test_other_lengths_than_multiples_of_a_step_are_refused(hold_s: float, message: str) -> None:
    with pytest.raises(IzooError, match=message):
        EnvConfig(hold_s=hold_s)
    assert EnvConfig().decision_s == 0.5 and EnvConfig(hold_s=3.0).decisions == 325
