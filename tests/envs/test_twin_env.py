"""The twin behind the same MDP: what it emits is what SUMO's environments emit, and what it is given is checked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv, check_env_specs

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, RandomSchedule, RoundRobinSchedule
from izoo.envs import EcoDrivingEnv, EnvConfig, SumoParallelEnv, TwinEnv
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.twin import backend
from izoo.envs.twin.net.reader import twin_traffic
from izoo.envs.twin.runtime.layout import ARRIVED, LOST_TAILS
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.errors import IzooError
from izoo.networks.road import read_road
from tests.envs.conftest import MakeTwin
from tests.envs.test_determinism import schedule
from tests.envs.test_env import VARIANTS
from tests.envs.twin.crossroads import build_crossroads, meeting
from tests.envs.worlds import Driver, at_random, crossing, defer, play, same, short, steer, steer_and_change

# -- the same MDP as behind SUMO ---------------------------------------------------------------------------------------


def single_lane(**changes: Any) -> Context:
    """An approach of one lane, where the twin drives exactly as SUMO does."""
    values = {"lane_count": 1, "phase_count": 1, "approach": "A", "lane_length_m": 150.0, "adoption": 0.4}
    return crossing(**(values | {"inflow_vph_per_lane": 500.0} | changes))


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
    ids=["briskly", "no warm-up", "at random, few slots", "left to their drivers, long steps", "three lanes"],
)
def test_every_key_is_that_of_sumo(act: Driver, seed: int, changes: dict[str, Any], roads: dict[str, Any]) -> None:
    """Where the driving is the same, so is everything that is made from it: the MDP is written once."""
    config = EnvConfig(**({"horizon_s": 150.0, "warmup_s": 20.0, "emit": EMIT_GROUPS} | changes))
    context = single_lane(**roads)
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
    assert compared > 70
    assert ours["metrics", "approach", "entered"].sum() > 3
    assert ours["metrics", "approach", "agent_steps"].sum() > 100
    assert ours["done"].all()
    assert not roads or blinking > 100


def assert_close(ours: TensorDictBase, theirs: TensorDictBase, step: int) -> int:
    """Compare every leaf of a step; return how many there are."""
    leaves = dict(ours.items(True, True))
    assert leaves.keys() == set(theirs.keys(True, True))
    for key, value in leaves.items():
        other = theirs.get(key)
        assert value.dtype == other.dtype and value.shape == other.shape
        # CO2 comes from the torch module there and from compiled code here, which differ by less than 1e-5 of it.
        assert torch.allclose(value.double(), other.double(), rtol=1e-5, atol=1e-3), f"{key} at step {step}"
    return len(leaves)


# -- TorchRL's view ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_specs_of_every_variant(make_twin: MakeTwin, variant: str) -> None:
    env = make_twin(config=short(**VARIANTS[variant]))
    check_env_specs(env)


def test_specs_are_those_of_the_parallel_environment(make_twin: MakeTwin) -> None:
    config = short(emit=EMIT_GROUPS, lane_change=True)
    ours, theirs = make_twin(config=config), SumoParallelEnv(2, crossing(), config=config)
    try:
        for name in ("observation_spec", "full_action_spec", "reward_spec", "full_done_spec", "state_spec"):
            assert getattr(ours, name) == getattr(theirs, name)
    finally:
        theirs.close()


def test_specs_below_transforms(make_twin: MakeTwin) -> None:
    transforms = Compose(
        RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")]), StepCounter(max_steps=20)
    )
    check_env_specs(TransformedEnv(make_twin(), transforms))


def test_one_environment_alone() -> None:
    env = EcoDrivingEnv(crossing(), config=short(), simulator="twin")
    try:
        check_env_specs(env)
        env.reset(context=crossing(lane_count=1), seed=3)
        assert env.scene().context == crossing(lane_count=1) and env.render().any()
    finally:
        env.close()


def test_own_stepping_is_torchrls(make_twin: MakeTwin) -> None:
    lean, plain = make_twin(), make_twin()
    steps = lean.config.control_steps + 20
    ours = play(lean, steps)
    theirs = plain.rollout(steps, steer, break_when_any_done=False, auto_reset=True)
    assert ours["next", "done"].sum() == 2
    for key in (("agents", "observation"), ("agents", "mask"), ("next", "agents", "reward"), ("context", "episode")):
        assert torch.equal(ours[key], theirs[key])


def test_partial_reset_touches_only_its_own(make_twin: MakeTwin) -> None:
    env, undisturbed = make_twin(3), make_twin(3)
    state, other = env.reset(), undisturbed.reset()
    for _ in range(10):
        (_, state), (_, other) = env.step_and_maybe_reset(steer(state)), undisturbed.step_and_maybe_reset(steer(other))
    chosen = torch.tensor([[False], [True], [False]])
    state = env.reset(state.clone().set("_reset", chosen), select_reset_only=True)
    assert state["context", "episode"].view(-1).tolist() == [0, 4, 2]
    assert same(state[0], other[0]) and same(state[2], other[2])
    assert state["metrics", "episode", "steps"].view(-1).tolist() == [10, 0, 10]


def test_render_shows_the_present_state(make_twin: MakeTwin) -> None:
    env = make_twin(2, RoundRobinSchedule([crossing(), crossing(lane_count=1)]))
    with pytest.raises(IzooError, match=r"render\(\) came before reset"):
        env.render()
    state = env.reset()
    assert env.scene(1).context.intersection != env.scene(0).context.intersection
    before = env.render(index=1)
    for _ in range(8):
        _, state = env.step_and_maybe_reset(defer(state))
    assert before.shape == (640, 640, 3) and (env.render(index=1) != before).any()
    assert len(env.scene(1).vehicles["speed_mps"]) == int(state["vehicles", "present"][1].sum())


def test_environments_advance_by_themselves(make_twin: MakeTwin) -> None:
    """Each comes to where it comes when its CVs are deferred, and commands mean something again afterwards."""
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
    assert not steered["deferred"][steered["is_cv"]].all(), "commands count again"
    for wrong in ([1, 2], [-1, 0, 0], [0, 0, config.decisions], [1.7] * 3, [1, [2], 3], 1, ["a"] * 3, [True] * 3):
        with pytest.raises(IzooError, match="a whole number of decisions, 0 or more and fewer than its"):
            env.advance(wrong)


class _Interrupted(BaseException):
    """What nobody expects, as Ctrl-C is."""


def _interrupt(env: TwinEnv, call: Callable[[], object], monkeypatch: pytest.MonkeyPatch, surrogate: str) -> None:
    """Let a call end in the midst of its simulation: on torch before, with compiled code after the step was counted."""
    name = "conclude_all" if surrogate == "torch" else "play_all"
    whole = getattr(backend, name)

    def broken(*arguments: object) -> None:
        if name == "play_all":
            whole(*arguments)
        raise _Interrupted

    with monkeypatch.context() as patch, pytest.raises(_Interrupted):
        patch.setattr(backend, name, broken)
        call()


@pytest.mark.parametrize("surrogate", ["torch", "compiled"])
@pytest.mark.parametrize("threads", [1, 2])
def test_what_is_interrupted_must_be_begun_anew(
    make_twin: MakeTwin, monkeypatch: pytest.MonkeyPatch, surrogate: str, threads: int
) -> None:
    """Else the simulators would be ahead of the metrics, and episodes would go on past their horizon."""
    env, fresh = (make_twin(3, surrogate=surrogate, threads=threads) for _ in range(2))
    state = env.reset()
    for _ in range(4):
        _, state = env.step_and_maybe_reset(steer(state))
    _interrupt(env, lambda: env.step_lean(steer(state)), monkeypatch, surrogate)
    for call in (lambda: env.step(steer(state)), env.present, lambda: env.advance([1, 1, 1])):
        with pytest.raises(IzooError, match=r"\(\) came before reset"):
            call()
    numbers = [0, 1, 2]
    ours, theirs = (play(each, 20, start=each.reset(episode=numbers))["next"] for each in (env, fresh))
    assert same(ours, theirs)


@pytest.mark.parametrize("surrogate", ["torch", "compiled"])
def test_commands_count_again_after_an_interrupted_advance(
    make_twin: MakeTwin, monkeypatch: pytest.MonkeyPatch, surrogate: str
) -> None:
    env, fresh = (make_twin(2, surrogate=surrogate) for _ in range(2))
    env.step_lean(steer(env.reset()))  # with a step that defers nobody, who defers is forgotten
    _interrupt(env, lambda: env.advance([3, 3]), monkeypatch, surrogate)
    ours, theirs = (play(each, 20, start=each.reset(episode=[0, 1]))["next"] for each in (env, fresh))
    assert same(ours, theirs) and not ours["vehicles", "deferred"].all()


# -- what is counted ---------------------------------------------------------------------------------------------------


def test_a_context_where_nobody_comes(make_twin: MakeTwin) -> None:
    env = make_twin(2, crossing(inflow_vph_per_lane=0.0))
    frames = play(env, env.config.control_steps)
    assert frames["next", "done"].any() and not frames["next", "vehicles", "present"].any()


@pytest.mark.parametrize("changes", [{}, {"inflow_vph_per_lane": 900.0}, {"lane_count": 3, "adoption": 1.0}])
def test_the_demand_closes(make_twin: MakeTwin, changes: dict[str, Any]) -> None:
    env = make_twin(2, crossing(**changes), config=short(horizon_s=120.0))
    last = play(env, env.config.control_steps)[:, -1]["next", "metrics", "approach"]
    reached = sum(last[name] for name in ("dropped", "waiting", "outside", "early", "entered"))
    assert torch.equal(last["due"], reached) and (last["due"] > 5).any()
    assert torch.equal(last["entered"], last["crossed"] + last["unfinished"])


@pytest.mark.parametrize(("way", "lost"), [("AC", False), ("AB", True)])
def test_tails_on_more_lanes_than_the_tables_hold_are_counted(tmp_path: Path, way: str, lost: bool) -> None:
    """To the left a way has two lanes inside the junction."""
    net = build_crossroads(tmp_path, [(100.0, "G" * 12)], length_m=25.0)
    case = meeting(net, [{"depart": 0.0, "way": way, "length_m": 45.0}])
    episode = TwinEpisode(case.world.net, twin_traffic(case.traffic, read_road(net), case.world.net))
    for _ in range(60):
        episode.step()
    assert (episode.status == ARRIVED).all() and (episode.state.clock[LOST_TAILS] > 0) == lost


def test_tails_that_were_lost_are_reported(make_twin: MakeTwin, caplog: pytest.LogCaptureFixture) -> None:
    env = make_twin(2)
    state = env.reset()
    env.backend._runs[1].driving.state.clock[LOST_TAILS] = 3
    for _ in range(env.config.control_steps):
        _, state = env.step_and_maybe_reset(steer(state))
    assert [record.getMessage().count("3 times; there the twin forgot it") for record in caplog.records] == [1]


def test_lane_changes_are_commanded(make_twin: MakeTwin) -> None:
    context = crossing(lane_count=3, adoption=1.0)
    config = short(lane_change=True)
    drivers = (steer_and_change, _keep_lanes)
    lanes = [play(make_twin(1, context, config=config), 60, act)["next", "vehicles", "lane"] for act in drivers]
    assert not torch.equal(*lanes)


def _keep_lanes(tensordict: TensorDictBase) -> TensorDictBase:
    mask = tensordict["agents", "mask"]
    tensordict["agents", "lane_change"] = torch.ones_like(mask, dtype=torch.int64)
    return steer(tensordict)


# -- bad input ---------------------------------------------------------------------------------------------------------


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


def test_a_missing_gpu_is_refused(make_twin: MakeTwin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(IzooError, match=r"surrogate=cuda, but PyTorch finds no GPU.*choose surrogate=torch"):
        make_twin(surrogate="cuda")


def test_environments_that_are_not_there(make_twin: MakeTwin) -> None:
    env = make_twin(2)
    env.reset()
    for index in (2, -1, 0.0):
        for call in (env.scene, lambda index: env.render(index=index)):
            with pytest.raises(IzooError, match=f"index is {index}; it must be a whole number from 0 to 1"):
                call(index)
    with pytest.raises(IzooError, match=r"n is 1\.5; it must be a whole number from 1 to 32768"):
        env.branch(1.5)  # type: ignore[arg-type]


def test_unknown_simulator() -> None:
    with pytest.raises(IzooError, match="simulator"):
        EcoDrivingEnv(crossing(), simulator="cityflow")


def test_step_before_reset_and_after_the_end(make_twin: MakeTwin) -> None:
    env = make_twin()
    idle = TensorDict({"agents": TensorDict({"action": torch.zeros(2, 64, 1)}, [2, 64])}, [2])
    with pytest.raises(IzooError, match=r"step\(\) came before reset"):
        env.step(idle)
    state = env.reset()
    for _ in range(env.config.control_steps):
        state = env._step(steer(state)).exclude(("agents", "reward"))
    with pytest.raises(IzooError, match="the episode ended after 110 steps"):
        env._step(steer(state))
    env.close()
    with pytest.raises(IzooError, match="closed"):
        env.reset()


def test_a_single_environment_says_that_it_is_closed() -> None:
    """At once, not only when it has been reset as it first said."""
    env = EcoDrivingEnv(crossing(), config=short(), simulator="twin", worker=0)
    state = env.reset()
    env.close()
    for call in (lambda: env.step(steer(state)), env.reset, env.scene, env.render):
        with pytest.raises(IzooError, match="this environment is closed; make another one"):
            call()
    with pytest.raises(IzooError, match="this environment is closed; make another one"):
        env.backend.step()


def test_too_few_approaches(make_twin: MakeTwin) -> None:
    with pytest.raises(IzooError, match="num_approaches"):
        make_twin(config=short(num_approaches=2)).reset()


def test_a_bad_context_is_named_when_its_turn_comes(make_twin: MakeTwin) -> None:
    """Also where another thread prepares it."""
    negative = lambda number: (crossing(), 5 if number < 2 else -1)  # noqa: E731
    env = make_twin(2, negative)
    state = env.reset()
    for _ in range(env.config.control_steps - 1):
        _, state = env.step_and_maybe_reset(steer(state))
    with pytest.raises(IzooError, match="episode seed is -1"):
        env.step_and_maybe_reset(steer(state))


def test_episodes_of_measured_intersections(make_twin: MakeTwin, dataset: ContextList) -> None:
    """The largest demand of the sample, all approaches."""
    context = max(dataset, key=lambda context: context.flow_vph_per_lane(context.approach or "A")).replace(
        approach=None
    )
    env = make_twin(2, RandomSchedule(ContextList([context]), 1), config=short(horizon_s=200.0))
    last = play(env, env.config.control_steps)[:, -1]
    assert last["next", "metrics", "approach", "crossed"].sum() > 10
