"""The twin environment: it emits what SUMO's environments emit, and checks its options."""

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.twin import backend
from izoo.errors import IzooError
from tests.envs.conftest import MakeTwin
from tests.envs.test_determinism import schedule
from tests.envs.worlds import Driver, at_random, crossing, defer, one_lane, play, play_on, same, short, steer


def briskly(tensordict: TensorDictBase) -> TensorDictBase:
    """Steer, but fast enough that the queue moves."""
    steer(tensordict)["agents", "action"].add_(2.0).clamp_max_(2.6)
    return tensordict


@pytest.mark.parametrize(
    ("act", "seed", "changes", "roads"),
    [
        (briskly, 1, {}, {}),
        (briskly, 2, {"warmup_s": 0.0}, {}),
        (at_random(3), 3, {"num_agents": 2}, {}),
        (defer, 4, {"step_s": 1.0}, {}),
        (defer, 8, {}, {"lane_count": 3, "phase_count": 2, "approach": None}),
    ],
    ids=["briskly", "no warm-up", "at random, few slots", "uncommanded, long steps", "three lanes"],
)
def test_every_key_equals_sumos(act: Driver, seed: int, changes: dict[str, Any], roads: dict[str, Any]) -> None:
    """On scenarios with identical driving, everything computed from it is identical too."""
    config = EnvConfig(**({"horizon_s": 150.0, "warmup_s": 20.0, "emit": EMIT_GROUPS} | changes))
    context = one_lane(**({"lane_length_m": 150.0, "adoption": 0.4} | roads))
    blinking = 0
    envs = [EcoDrivingEnv(context, config=config, simulator=name) for name in ("sumo", "twin")]
    compared = 0
    try:
        ours, theirs = (env.reset(context=context, seed=seed) for env in envs)
        assert_close(ours, theirs, 0)
        for step in range(config.control_steps):
            theirs = act(theirs)
            commanded = theirs.select(("agents", "action"), ("agents", "defer"), strict=False)
            ours = ours.update(commanded)
            following = [env._step(state) for env, state in zip(envs, (ours, theirs), strict=True)]
            compared = assert_close(*following, step + 1)
            blinking += int(sum(following[1]["vehicles", f"blinker_{side}"].sum() for side in ("left", "right")))
            ours, theirs = (part.exclude(("agents", "reward")) for part in following)
    finally:
        for env in envs:
            env.close()
    sums = ours["metrics", "approach"]
    assert compared > 70 and sums["entered"].sum() > 3 and sums["agent_steps"].sum() > 100
    assert ours["done"].all() and (not roads or blinking > 100)


def assert_close(ours: TensorDictBase, theirs: TensorDictBase, step: int) -> int:
    """Compare every leaf of a step; return how many there are."""
    leaves = dict(ours.items(True, True))
    assert leaves.keys() == set(theirs.keys(True, True))
    for key, value in leaves.items():
        other = theirs.get(key)
        assert value.dtype == other.dtype and value.shape == other.shape
        # CO2 comes from the torch module on the twin and from compiled code here, which differ by less than 1e-5.
        assert torch.allclose(value.double(), other.double(), rtol=1e-5, atol=1e-3), f"{key} at step {step}"
    return len(leaves)


def test_advance_plays_each_environment_uncommanded(make_twin: MakeTwin) -> None:
    """The states are those of deferred CVs, and commands act again afterwards."""
    config = short(hold_s=2.0, emit=EMIT_GROUPS)
    env, plain = make_twin(3, schedule(), config=config), make_twin(3, schedule(), config=config)
    with pytest.raises(IzooError, match=r"advance\(\) came before reset"):
        env.advance([1, 2, 3])
    env.reset()
    state = env.advance([0, 7, 3])
    other = plain.reset()
    for decision in range(8):
        for index, wanted in enumerate((0, 7, 3)):
            assert wanted != decision or same(state[index], other[index].select(*state.keys(True, True)))
        _, other = plain.step_and_maybe_reset(defer(other))
    assert state["metrics", "episode", "steps"].view(-1).tolist() == [0, 28, 12]
    steered = play(env, 6, steer, start=state)["next", "vehicles"]
    assert not steered["deferred"][steered["is_cv"]].all(), "commands act again"
    for wrong in ([1, 2], [-1, 0, 0], [0, 0, config.decisions], [1.7] * 3, [1, [2], 3], 1, ["a"] * 3, [True] * 3):
        with pytest.raises(IzooError, match="a whole number of decisions, 0 or more and fewer than its"):
            env.advance(wrong)


@pytest.mark.parametrize(("surrogate", "stage"), [("torch", "conclude_all"), ("compiled", "play_all")])
@pytest.mark.parametrize("threads", [1, 2])
def test_an_interrupted_environment_needs_a_reset(
    make_twin: MakeTwin, monkeypatch: pytest.MonkeyPatch, surrogate: str, stage: str, threads: int
) -> None:
    """Otherwise the simulation would be ahead of the metrics."""
    env, fresh = (make_twin(3, surrogate=surrogate, threads=threads) for _ in range(2))
    state, real = play_on(env, 4, steer, env.reset())[1], getattr(backend, stage)

    def interrupted(*arguments: object) -> None:
        if stage == "play_all":
            real(*arguments)  # which counts the step
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(backend, stage, interrupted)
        env.step_lean(steer(state))
    for call in (lambda: env.step(steer(state)), env.present, lambda: env.advance([1, 1, 1])):
        with pytest.raises(IzooError, match=r"\(\) came before reset"):
            call()
    ours, theirs = (play(each, 20, start=each.reset(episode=[0, 1, 2]))["next"] for each in (env, fresh))
    assert same(ours, theirs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threads": 0}, "threads is 0"),
        ({"threads": 1.5}, "threads is 1.5; it must be a whole number from 1 to 1024"),
        ({"num_envs": 2.5}, "num_envs is 2.5; it must be a whole number from 1 to 65536"),
        ({"num_envs": 0}, "num_envs is 0"),
        ({"surrogate": "onnx"}, "surrogate"),
        ({"config": short(gui=True)}, "no window"),
        ({"contexts": 3}, "contexts is a int"),
    ],
)
def test_bad_options_are_refused(make_twin: MakeTwin, options: dict[str, Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        make_twin(**options)


def test_a_bad_context_raises_when_its_episode_begins(make_twin: MakeTwin) -> None:
    """Also when another thread prepares it."""
    negative = lambda number: (crossing(), 5 if number < 2 else -1)  # noqa: E731
    env = make_twin(2, negative)
    _, state = play_on(env, env.config.control_steps - 1, steer, env.reset())
    with pytest.raises(IzooError, match="episode seed is -1"):
        env.step_and_maybe_reset(steer(state))
