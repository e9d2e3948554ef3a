"""The twin behind the same MDP: what it emits is what SUMO's environments emit, for any number of environments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv, check_env_specs

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, RandomSchedule, RoundRobinSchedule
from izoo.envs import EcoDrivingEnv, EnvConfig, SumoParallelEnv, TwinEnv
from izoo.envs.config import EMIT_GROUPS, RewardConfig
from izoo.envs.twin.emitting import GROUP
from izoo.errors import IzooError
from tests.envs.test_determinism import by_episode, schedule
from tests.envs.test_env import VARIANTS
from tests.envs.worlds import Driver, at_random, crossing, defer, play, same, short, steer, steer_and_change

Make = Callable[..., TwinEnv]
EPISODES = 4
NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
GOLDEN = "dc986a0f8ed211e7"
"""Digest of a fixed episode on the twin."""


@pytest.fixture
def make() -> Iterator[Make]:
    """Build environments on the twin and close them in the end."""
    made: list[TwinEnv] = []

    def build(num_envs: int = 2, contexts: Any = None, **options: Any) -> TwinEnv:
        contexts = crossing() if contexts is None else contexts
        env = TwinEnv(num_envs, contexts, **({"config": short(), "threads": 1} | options))
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()


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
def test_specs_of_every_variant(make: Make, variant: str) -> None:
    env = make(config=short(**VARIANTS[variant]))
    check_env_specs(env)


def test_specs_are_those_of_the_parallel_environment(make: Make) -> None:
    config = short(emit=EMIT_GROUPS, lane_change=True)
    ours, theirs = make(config=config), SumoParallelEnv(2, crossing(), config=config)
    try:
        for name in ("observation_spec", "full_action_spec", "reward_spec", "full_done_spec", "state_spec"):
            assert getattr(ours, name) == getattr(theirs, name)
    finally:
        theirs.close()


def test_specs_below_transforms(make: Make) -> None:
    transforms = Compose(
        RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")]), StepCounter(max_steps=20)
    )
    check_env_specs(TransformedEnv(make(), transforms))


def test_one_environment_alone() -> None:
    env = EcoDrivingEnv(crossing(), config=short(), simulator="twin")
    try:
        check_env_specs(env)
        env.reset(context=crossing(lane_count=1), seed=3)
        assert env.scene().context == crossing(lane_count=1) and env.render().any()
    finally:
        env.close()


def test_own_stepping_is_torchrls(make: Make) -> None:
    lean, plain = make(), make()
    steps = lean.config.control_steps + 20
    ours = play(lean, steps)
    theirs = plain.rollout(steps, steer, break_when_any_done=False, auto_reset=True)
    assert ours["next", "done"].sum() == 2
    for key in (("agents", "observation"), ("agents", "mask"), ("next", "agents", "reward"), ("context", "episode")):
        assert torch.equal(ours[key], theirs[key])


def test_partial_reset_touches_only_its_own(make: Make) -> None:
    env, undisturbed = make(3), make(3)
    state, other = env.reset(), undisturbed.reset()
    for _ in range(10):
        (_, state), (_, other) = env.step_and_maybe_reset(steer(state)), undisturbed.step_and_maybe_reset(steer(other))
    chosen = torch.tensor([[False], [True], [False]])
    state = env.reset(state.clone().set("_reset", chosen), select_reset_only=True)
    assert state["context", "episode"].view(-1).tolist() == [0, 4, 2]
    assert same(state[0], other[0]) and same(state[2], other[2])
    assert state["metrics", "episode", "steps"].view(-1).tolist() == [10, 0, 10]


def test_render_shows_the_present_state(make: Make) -> None:
    env = make(2, RoundRobinSchedule([crossing(), crossing(lane_count=1)]))
    with pytest.raises(IzooError, match=r"render\(\) came before reset"):
        env.render()
    state = env.reset()
    assert env.scene(1).context.intersection != env.scene(0).context.intersection
    before = env.render(index=1)
    for _ in range(8):
        _, state = env.step_and_maybe_reset(defer(state))
    assert before.shape == (640, 640, 3) and (env.render(index=1) != before).any()
    assert len(env.scene(1).vehicles["speed_mps"]) == int(state["vehicles", "present"][1].sum())


def test_environments_advance_by_themselves(make: Make) -> None:
    """Each comes to where it comes when its CVs are deferred, and commands mean something again afterwards."""
    config = short(hold_s=2.0, emit=EMIT_GROUPS)
    env, plain = make(3, schedule(), config=config), make(3, schedule(), config=config)
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


# -- determinism -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected() -> dict[int, str]:
    """Digest of every numbered episode, played by a single environment."""
    env = TwinEnv(1, schedule(), config=short(), threads=1)
    try:
        digests = by_episode(play(env, EPISODES * env.config.control_steps))
    finally:
        env.close()
    assert len(set(digests.values())) == EPISODES
    return digests


@pytest.mark.parametrize(("num_envs", "threads"), [(2, 1), (4, 1), (4, 2), (4, 3)])
def test_same_for_any_number_of_environments_and_threads(
    make: Make, expected: dict[int, str], num_envs: int, threads: int
) -> None:
    env = make(num_envs, schedule(), threads=threads)
    assert by_episode(play(env, EPISODES // num_envs * env.config.control_steps)) == expected


def test_same_whatever_was_played_before(make: Make, expected: dict[int, str]) -> None:
    """Episodes in another order, begun anew in the middle."""
    env = make(2, schedule())
    env.reset()
    state = env.reset(episode=[3, 1])
    for _ in range(7):
        _, state = env.step_and_maybe_reset(steer(state))
    frames = play(env, env.config.control_steps, start=env.reset(episode=[2, 0]))
    assert by_episode(frames) == {number: expected[number] for number in (0, 2)}


def test_working_memory_keeps_nothing(make: Make, expected: dict[int, str]) -> None:
    """Environments of a thread share it, so whatever stands there when a step begins must not matter."""
    env = make(1, schedule())

    def spoil(state: TensorDictBase) -> TensorDictBase:
        blocks = [block for desk in env.backend._desks for block in desk._blocks.values()]
        assert sum(len(block) for block in blocks) > 10_000
        for block in blocks:
            block[:] = 255  # -1, and not a number
        return steer(state)

    assert by_episode(play(env, env.config.control_steps, spoil)) == {0: expected[0]}


def test_each_thread_copies_the_observations_of_its_environments(make: Make) -> None:
    """What is read is what was written, stays as it is, and is read anew where a step has failed in between."""
    env = make(5, schedule(), threads=2)
    state = env.reset()
    copy, taken = env.backend.played, []
    env.backend.played = lambda rows: (taken.append(rows), copy(rows))
    kept = []
    for _ in range(30):
        taken.clear()
        steer(state)
        following, state = env.step_and_maybe_reset(state)
        assert sorted((rows.start, rows.stop) for rows in taken) == [(0, 2), (2, 5)]
        seen = following["next", "agents", "observation"]
        assert torch.equal(seen, torch.from_numpy(env.frames["observation"]))
        kept.append((seen, seen.clone()))
    assert all(torch.equal(one, other) for one, other in kept) and not torch.equal(kept[0][0], kept[-1][0])

    def fail_in_one(rows: slice) -> None:
        copy(rows)
        env.frames["observation"][rows] += 1.0  # written after it was copied
        if rows.start == 0:
            raise RuntimeError("on purpose")

    env.backend.played = fail_in_one
    with pytest.raises(RuntimeError, match="on purpose"):
        env.step_lean(steer(state))
    assert torch.equal(env.present()["agents", "observation"], torch.from_numpy(env.frames["observation"]))


def test_golden(expected: dict[int, str]) -> None:
    """A change here changes what a seed means on the twin: say so in the release notes."""
    assert expected[0] == GOLDEN


@pytest.mark.parametrize("hold_s", [None, 2.0])
@pytest.mark.parametrize("other", ["compiled", pytest.param("cuda", marks=NEEDS_GPU)])
def test_the_surrogates_agree(make: Make, hold_s: float | None, other: str) -> None:
    """With torch all environments take a step together, with compiled code a few play a decision to the end."""
    config = short(hold_s=hold_s, emit=EMIT_GROUPS)
    parts = [play(make(3, surrogate=name, config=config), config.decisions + 5)["next"] for name in ("torch", other)]
    for key in (("vehicles", "emission_g"), ("agents", "reward"), ("metrics", "approach", "emission_g")):
        assert torch.allclose(parts[0][key], parts[1][key], rtol=1e-4, atol=1e-4), key
    for key in (("agents", "observation"), ("agents", "mask"), ("vehicles", "speed_mps"), ("agents", "vehicle")):
        assert torch.equal(parts[0][key], parts[1][key]), key
    assert parts[0]["done"].any() and parts[0]["vehicles", "emission_g"].sum() > 1.0


@pytest.mark.parametrize(("num_envs", "threads"), [(GROUP + 3, 1), (3 * GROUP, 2)])
def test_the_compiled_surrogate_groups_environments_without_a_trace(make: Make, num_envs: int, threads: int) -> None:
    """Those of a group are in other phases of their episodes, and have played as many decisions to get there."""
    config, phases = short(hold_s=2.0), [7 * index % 11 for index in range(num_envs)]
    envs = [make(num_envs, schedule(), threads=threads, surrogate="compiled", config=config)]
    envs += [make(1, schedule(), surrogate="compiled", config=config) for _ in range(num_envs)]
    together, alone = envs[0], envs[1:]
    together.reset(episode=[index % EPISODES for index in range(num_envs)])
    state = together.advance(phases)
    states = []
    for index, env in enumerate(alone):
        env.reset(episode=index % EPISODES)
        states.append(env.advance([phases[index]]))
    assert config.decisions - max(phases) > 3
    for _ in range(config.decisions - max(phases)):
        following = together.step_lean(steer(state))
        for index, env in enumerate(alone):
            one = env.step_lean(steer(states[index]))
            for key, value in one.items(True, True):
                assert torch.equal(following.get(key)[index], value[0]), (index, key)
            states[index] = one.exclude(("agents", "reward"))
        state = following.exclude(("agents", "reward"))
    assert following["done"].any() and not following["done"].all()


# -- what is counted ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"inflow_vph_per_lane": 900.0}, {"lane_count": 3, "adoption": 1.0}])
def test_the_demand_closes(make: Make, changes: dict[str, Any]) -> None:
    env = make(2, crossing(**changes), config=short(horizon_s=120.0))
    last = play(env, env.config.control_steps)[:, -1]["next", "metrics", "approach"]
    reached = sum(last[name] for name in ("dropped", "waiting", "outside", "early", "entered"))
    assert torch.equal(last["due"], reached) and (last["due"] > 5).any()
    assert torch.equal(last["entered"], last["crossed"] + last["unfinished"])


def test_lane_changes_are_commanded(make: Make) -> None:
    context = crossing(lane_count=3, adoption=1.0)
    config = short(lane_change=True)
    drivers = (steer_and_change, _keep_lanes)
    lanes = [play(make(1, context, config=config), 60, act)["next", "vehicles", "lane"] for act in drivers]
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
def test_bad_options_are_refused(make: Make, options: dict[str, Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        make(**options)


def test_a_missing_gpu_is_refused(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(IzooError, match=r"surrogate=cuda, but PyTorch finds no GPU.*choose surrogate=torch"):
        make(surrogate="cuda")


def test_environments_that_are_not_there(make: Make) -> None:
    env = make(2)
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


def test_step_before_reset_and_after_the_end(make: Make) -> None:
    env = make()
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


def test_too_few_approaches(make: Make) -> None:
    with pytest.raises(IzooError, match="num_approaches"):
        make(config=short(num_approaches=2)).reset()


def test_a_bad_context_is_named_when_its_turn_comes(make: Make) -> None:
    """Also where another thread prepares it."""
    negative = lambda number: (crossing(), 5 if number < 2 else -1)  # noqa: E731
    env = make(2, negative)
    state = env.reset()
    for _ in range(env.config.control_steps - 1):
        _, state = env.step_and_maybe_reset(steer(state))
    with pytest.raises(IzooError, match="episode seed is -1"):
        env.step_and_maybe_reset(steer(state))


def test_episodes_of_measured_intersections(make: Make, dataset: ContextList) -> None:
    """The largest demand of the sample, all approaches."""
    context = max(dataset, key=lambda context: context.flow_vph_per_lane(context.approach or "A")).replace(
        approach=None
    )
    env = make(2, RandomSchedule(ContextList([context]), 1), config=short(horizon_s=200.0))
    last = play(env, env.config.control_steps)[:, -1]
    assert last["next", "metrics", "approach", "crossed"].sum() > 10


# -- the exact state ---------------------------------------------------------------------------------------------------


def test_what_is_loaded_goes_on_bit_for_bit(make: Make) -> None:
    """Over the end of the episodes, with every key; also what the environment does in between is forgotten."""
    options = {"config": short(emit=EMIT_GROUPS)}
    env, other = make(3, schedule(), **options), make(3, schedule(), threads=2, **options)
    state = env.reset()
    for _ in range(41):
        _, state = env.step_and_maybe_reset(steer(state))
    saved = env.state_dict()
    whole = play(env, 90, start=state)
    play(other, 7)
    other.load_state_dict(saved)
    assert same(other.present(), state.select(*other.present().keys(True, True)))
    resumed = play(other, 90, start=other.present())
    assert whole["next", "done"].any() and set(whole.keys(True, True)) == set(resumed.keys(True, True))
    for key in whole.keys(True, True):
        assert torch.equal(whole[key], resumed[key]), key
    assert [tensor.tolist() for tensor in env.state_dict()["packed"]] == [
        tensor.tolist() for tensor in other.state_dict()["packed"]
    ]


def test_branches_begin_alike_and_go_their_own_ways(make: Make) -> None:
    env = make(2, schedule())
    state = env.reset()
    for _ in range(20):
        _, state = env.step_and_maybe_reset(steer(state))
    branches = env.branch(3)
    try:
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
    finally:
        branches.close()


def test_branches_are_brought_back_to_their_environments(make: Make) -> None:
    """Over and over, also after the ends of their own episodes; what they play next is of their own."""
    env = make(2, schedule())
    env.reset()
    branches = env.branch(2)
    try:
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
            env.branch_into(make(3, schedule()))
    finally:
        branches.close()


def test_nothing_to_branch_before_the_first_reset(make: Make) -> None:
    with pytest.raises(IzooError, match=r"branch\(\) came before reset"):
        make().branch(2)


@pytest.fixture(scope="module")
def saved() -> dict[str, Any]:
    """State of two environments in the midst of their first episodes."""
    env = TwinEnv(2, schedule(), config=short(), threads=1)
    try:
        with pytest.raises(IzooError, match=r"state_dict\(\) came before reset"):
            env.state_dict()
        play(env, 15)
        return env.state_dict()
    finally:
        env.close()


@pytest.mark.parametrize(
    ("contexts", "options", "message"),
    [
        (schedule(), {"num_envs": 3}, "is that of 2 environments, and this has 3"),
        (crossing(lane_count=1), {}, r"does not fit episode 0 of the schedule, which is seed \d+ of .*: it is that of"),
        (schedule(), {"config": short(sensor_range_m=50.0)}, r"other settings: env.sensor_range_m None \(here 50.0\);"),
        (schedule(), {"config": short(step_s=1.0)}, r"other settings: env.step_s 0.5 \(here 1.0\);"),
        (schedule(), {"config": short(reward=RewardConfig(eta=0.5))}, r"other settings: env.reward.eta"),
    ],
    ids=["environments", "context", "sensors", "steps", "reward"],
)
def test_states_of_others_are_refused(
    make: Make, saved: dict[str, Any], contexts: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(IzooError, match=message):
        make(**({"num_envs": 2, "contexts": contexts} | options)).load_state_dict(saved)


@pytest.mark.parametrize("changes", [{"adoption": 0.4}, {"green_s": 24.0}])
def test_states_of_contexts_that_look_alike_are_refused(make: Make, changes: dict[str, Any]) -> None:
    """The tables of these are as large."""
    env, other = make(1), make(1, crossing(**changes))
    env.reset()
    with pytest.raises(IzooError, match="does not fit episode 0"):
        other.load_state_dict(env.state_dict())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.clear(), "no settings, plays, episodes, next_episodes, packed; give what state_dict"),
        (lambda state: state.pop("packed"), "no packed; give what state_dict"),
        (lambda state: (state.pop("plays"), state.pop("settings")), "an earlier version of izoo saved it"),
        (lambda state: state["plays"].__setitem__(1, ["0" * 64, 3]), "does not fit episode 1 of the schedule"),
        (lambda state: state["packed"].__setitem__(1, state["packed"][1][:-9]), "does not fit episode 1 .* damaged"),
        (lambda state: state["packed"].pop(), "that of 1 or 2 environments"),
    ],
    ids=["empty", "an entry less", "of an earlier version", "another context", "damaged", "half"],
)
def test_a_refused_state_leaves_the_environments_as_they_are(
    make: Make, saved: dict[str, Any], change: Callable[[dict[str, Any]], object], message: str
) -> None:
    env, undisturbed = make(2, schedule()), make(2, schedule())
    play(env, 20), play(undisturbed, 20)
    state = {name: value if name == "settings" else list(value) for name, value in saved.items()}
    change(state)
    with pytest.raises(IzooError, match=message):
        env.load_state_dict(state)
    ours, theirs = (play(each, 100, start=each.present()) for each in (env, undisturbed))
    assert ours["next", "done"].any()
    assert torch.equal(ours["next", "agents", "observation"], theirs["next", "agents", "observation"])


def test_a_closed_environment_says_so(make: Make, saved: dict[str, Any]) -> None:
    env = make(2, schedule())
    env.reset()
    env.close()
    for call in (env.reset, env.render, env.state_dict, env.present, env.scene, lambda: env.load_state_dict(saved)):
        with pytest.raises(IzooError, match="this environment is closed; make another one"):
            call()
