"""The exact state of environments on the twin: saved, loaded, branched, and refused where it does not fit."""

import contextlib
import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch

from izoo.envs import TwinEnv
from izoo.envs.config import EMIT_GROUPS, RewardConfig
from izoo.errors import IzooError
from tests.envs.conftest import Make, MakeTwin
from tests.envs.test_determinism import schedule
from tests.envs.worlds import crossing, play, play_on, same, short, steer


def test_a_loaded_state_goes_on_bit_for_bit(make_twin: MakeTwin) -> None:
    """Over the end of the episodes, with every key, whatever the environment did before."""
    options = {"config": short(emit=EMIT_GROUPS)}
    env, other = make_twin(3, schedule(), **options), make_twin(3, schedule(), threads=2, **options)
    _, state = play_on(env, 41, steer, env.reset())
    saved = env.state_dict()
    whole = play(env, 90, start=state)
    play(other, 7)
    other.load_state_dict(saved)
    assert same(other.present(), state.select(*other.present().keys(True, True)))
    resumed = play(other, 90, start=other.present())
    assert whole["next", "done"].any() and set(whole.keys(True, True)) == set(resumed.keys(True, True))
    for key in whole.keys(True, True):
        assert torch.equal(whole[key], resumed[key]), key
    for ours, theirs in zip(env.state_dict()["packed"], other.state_dict()["packed"], strict=True):
        assert torch.equal(ours, theirs)


def test_an_agent_that_leaves_right_after_loading_is_cleared(make_twin: MakeTwin) -> None:
    """A slot that was empty in the first frame, and whose CV leaves in the first step after loading."""
    env, other = (make_twin(1, crossing(), config=short(horizon_s=150.0)) for _ in range(2))
    state = env.reset()
    empty, leavers = ~state["agents", "mask"], 0
    for _ in range(250):
        saved = env.state_dict()
        frame, following = env.step_and_maybe_reset(steer(state))
        if (frame["next", "agents", "terminated"].squeeze(-1) & empty).any():
            leavers += 1
            other.load_state_dict(saved)
            seen = other.step(state.clone())["next", "agents", "observation"]
            assert torch.equal(seen, frame["next", "agents", "observation"])
        state = following
    assert leavers >= 3


def test_branches_begin_equal_and_are_independent(make_twin: MakeTwin) -> None:
    env = make_twin(2, schedule())
    _, state = play_on(env, 20, steer, env.reset())
    with contextlib.closing(env.branch(3)) as branches:
        begin = branches.present()
        for copy in range(6):
            assert same(begin[copy], state.select(*begin.keys(True, True))[copy // 3])
        steered = steer(begin.clone())
        steered["agents", "action"][3] -= 1.0
        frames, going_on = [], steered
        for _ in range(30):
            frame, going_on = branches.step_and_maybe_reset(going_on)
            frames.append(frame)
            steer(going_on)["agents", "action"][3] -= 1.0
        seen = torch.stack(frames, -1)["next", "agents", "observation"]
        original = play(env, 30, start=state)["next", "agents", "observation"]
        assert torch.equal(seen[0], original[0]) and torch.equal(seen[2], original[0])
        assert torch.equal(seen[5], original[1]) and not torch.equal(seen[3], original[1])


def test_branches_can_be_set_to_the_state_of_their_environments(make_twin: MakeTwin) -> None:
    """Repeatedly, also after the end of their own episodes, whose schedule they keep."""
    env = make_twin(2, schedule())
    env.reset()
    with contextlib.closing(env.branch(2)) as branches:
        numbers = branches.state_dict()["next_episodes"]
        assert len(numbers) == 4 and min(numbers) >= 2
        for _ in range(2):
            play(env, 15, start=env.present())
            play(branches, env.config.control_steps + 5, start=branches.present())
            played = branches.state_dict()["next_episodes"]
            env.branch_into(branches)
            assert branches.state_dict()["next_episodes"] == played != numbers
            here, there = env.present(), branches.present()
            assert all(same(there[copy], here[copy // 2]) for copy in range(4))
            theirs, ours = (play(each, 20, start=each.present())["next", "agents"] for each in (branches, env))
            assert ours["mask"].any() and all(same(theirs[copy], ours[copy // 2]) for copy in range(4))
        with pytest.raises(IzooError, match="3 environments are no copies of 2"):
            env.branch_into(make_twin(3, schedule()))


def test_branches_need_no_schedule(make_twin: MakeTwin) -> None:
    """After a new seed, the present episodes are in no schedule."""
    env = make_twin(2, schedule())
    play(env, 10)
    env.set_seed(7)
    with contextlib.closing(env.branch(2)) as branches:
        assert all(same(branches.present()[copy], env.present()[copy // 2]) for copy in range(4))
        play(env, 5, start=env.present())
        env.branch_into(branches)
        assert all(same(branches.present()[copy], env.present()[copy // 2]) for copy in range(4))
        with pytest.raises(IzooError, match=r"other settings: env.sensor_range_m None \(here 50.0\);"):
            env.branch_into(make_twin(4, schedule(), config=short(sensor_range_m=50.0)))
    with pytest.raises(IzooError, match="this environment is closed"):
        env.branch_into(branches)


@pytest.fixture(scope="module")
def saved() -> dict[str, Any]:
    """State of two environments in the middle of their first episodes."""
    with contextlib.closing(TwinEnv(2, schedule(), config=short(), threads=1)) as env:
        for call in (env.state_dict, lambda: env.branch(2)):
            with pytest.raises(IzooError, match=r"\(\) came before reset"):
                call()
        play(env, 15)
        return env.state_dict()


@pytest.mark.parametrize(
    ("contexts", "options", "message"),
    [
        (schedule(), {"num_envs": 3}, "is that of 2 environments, and this has 3"),
        (crossing(lane_count=1), {}, r"does not fit episode 0 of the schedule, which is seed \d+ of .*: it is that of"),
        (crossing(adoption=0.4), {}, "does not fit episode 0"),
        (schedule(), {"config": short(step_s=1.0)}, r"other settings: env.step_s 0.5 \(here 1.0\);"),
        (schedule(), {"config": short(reward=RewardConfig(eta=0.5))}, r"other settings: env.reward.eta"),
    ],
    ids=["environments", "context", "similar context", "steps", "reward"],
)
def test_states_of_other_environments_are_refused(
    make_twin: MakeTwin, saved: dict[str, Any], contexts: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(IzooError, match=message):
        make_twin(**({"num_envs": 2, "contexts": contexts} | options)).load_state_dict(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("packed"), "no packed; give what state_dict"),
        (lambda state: state["plays"].__setitem__(1, ["0" * 64, 3]), "does not fit episode 1 of the schedule"),
        (lambda state: state["packed"].__setitem__(1, state["packed"][1][:-9]), "another user or version of izoo"),
        (lambda state: state["packed"][1].bitwise_xor_(1), "another user or version of izoo"),
        (lambda state: state["packed"].reverse(), "another user or version of izoo"),
    ],
    ids=["an entry missing", "another context", "truncated", "changed", "swapped"],
)
def test_a_refused_state_leaves_the_environments_unchanged(
    make_twin: MakeTwin, saved: dict[str, Any], change: Callable[[dict[str, Any]], object], message: str
) -> None:
    env, undisturbed = make_twin(2, schedule()), make_twin(2, schedule())
    play(env, 20), play(undisturbed, 20)
    state = copy.deepcopy(saved)
    change(state)
    with pytest.raises(IzooError, match=message):
        env.load_state_dict(state)
    ours, theirs = (play(each, 100, start=each.present()) for each in (env, undisturbed))
    assert ours["next", "done"].any()
    assert torch.equal(ours["next", "agents", "observation"], theirs["next", "agents", "observation"])


@pytest.mark.parametrize("simulator", ["one", "several"])
def test_calls_of_a_closed_environment_are_refused(make: Make, saved: dict[str, Any], simulator: str) -> None:
    env = make("twin", 2 if simulator == "several" else None, schedule())
    state = env.reset()
    env.close()
    calls: list[Callable[[], Any]] = [env.reset, env.render, env.scene, lambda: env.step(steer(state))]
    if simulator == "several":
        calls += [env.state_dict, env.present, lambda: env.load_state_dict(saved)]
    for call in calls:
        with pytest.raises(IzooError, match="this environment is closed; make another one"):
            call()
