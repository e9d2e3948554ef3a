"""The Gymnasium views: Gymnasium's own checks, the ego's episodes, vector environments, and what is refused."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, exploration_type

from izoo.contexts.context import Context
from izoo.contexts.source import RoundRobinSchedule
from izoo.errors import IzooError
from tests.envs.worlds import constant, crossing, short

JOINT, EGO = "izoo/EcoDriving-v0", "izoo/EcoDrivingEgo-v0"
Env = gymnasium.Env[Any, Any]
pytestmark = pytest.mark.filterwarnings("ignore:.*Box:UserWarning", "ignore:.*symmetric:UserWarning")


@contextlib.contextmanager
def view(name: str, **options: Any) -> Iterator[Any]:
    options = {"contexts": crossing(), "config": short(horizon_s=80.0)} | options
    with contextlib.closing(gymnasium.make(f"izoo.envs:{name}", **options).unwrapped) as env:
        yield env


@pytest.fixture(scope="module")
def joint() -> Iterator[Env]:
    with view(JOINT, render_mode="rgb_array") as env:
        yield env


@pytest.fixture(scope="module")
def ego() -> Iterator[Env]:
    with view(EGO, contexts=crossing(phase_count=1, green_s=15.0, red_s=15.0)) as env:
        yield env


@pytest.fixture(params=["joint", "ego"])
def env(request: pytest.FixtureRequest) -> Any:
    return request.getfixturevalue(request.param)


def forward(env: Env) -> np.ndarray:
    return np.full(env.action_space.shape or (), 2.0, np.float32)


def test_gymnasiums_own_check(env: Env) -> None:
    check_env(env)


REFUSED_RESETS: dict[str, dict[str, Any]] = {
    "unknown reset option 'episodes'.*Did you mean 'episode'": {"episodes": 3},
    "'context' is a str; give an izoo Context": {"context": "pcg"},
    "the reset option 'episode' is 2.9; it must be a whole number from 0": {"episode": 2.9},
    "'episode' is -1": {"episode": -1},
    "'episode_seed' is 1.5; it must be a whole number from 0": {"episode_seed": 1.5},
    "'episode_seed'": {"episode_seed": None},
}


def test_reset_begins_the_next_the_seeded_or_the_chosen_episode(joint: Env) -> None:
    first, again = joint.reset(seed=3)[1], joint.reset(seed=3)[1]
    assert first["episode"] == again["episode"] == 0 and first["episode_seed"] == again["episode_seed"]
    for message, wrong in REFUSED_RESETS.items():
        with pytest.raises(IzooError, match=message):
            joint.reset(seed=7, options=wrong)  # which leaves the schedule unchanged
    following = joint.reset()[1]
    assert following["episode"] == 1 and following["episode_seed"] != first["episode_seed"]
    assert joint.reset(options={"episode": 0})[1]["episode_seed"] == first["episode_seed"]
    other = crossing(lane_count=1)
    assert joint.reset(options={"context": other, "episode_seed": 7})[1]["context"] == other.name


def test_joint_reward_is_the_mean_over_the_cvs_that_acted(joint: Env) -> None:
    """Its sum is the episode's return."""
    observation, info = joint.reset(seed=0)
    total, left, truncated = 0.0, 0, False
    while not truncated:
        acted = observation["mask"].astype(bool)
        assert (info["vehicle"] >= 0).tolist() == acted.tolist()
        assert not observation["observation"][~acted].any()
        observation, reward, terminated, truncated, info = joint.step(forward(joint))
        assert not terminated and not info["reward"][~acted].any()
        assert reward == pytest.approx(info["reward"][acted].mean() if acted.any() else 0.0)
        assert not info["reward_vector"][~acted].any()
        total += reward
        left += int(info["agent_terminated"].sum())
    assert left >= 3 and total == pytest.approx(info["metrics"]["episode"]["return"], rel=1e-4)
    assert info["metrics"]["approach"]["crossed"].sum() >= 3
    with pytest.raises(IzooError, match="after the end of the episode"):
        joint.step(forward(joint))


def test_ego_is_one_vehicle_after_another(ego: Any) -> None:
    egos: list[int] = []
    ends = set()
    begin_m = ego.observation_names.index("stop_line_distance")
    observation, info = ego.reset(seed=0)
    while info["episode"] == 0:
        vehicle, begin_s = info["vehicle"], info["time_s"]
        assert vehicle not in egos and observation[begin_m] < -0.3, "an ego begins far from the stop line"
        egos.append(vehicle)
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = ego.step(forward(ego))
            assert info["vehicle"] == vehicle and info["time_s"] > begin_s
            ended = terminated or truncated
        assert observation.any() != terminated and ("metrics" in info) == truncated
        ends.add("left" if terminated else "horizon")
        observation, info = ego.reset()
    assert len(egos) >= 2 and ends == {"left", "horizon"} and info["episode"] == 1


def test_others_act_deterministically_with_a_memory_of_the_simulation(ego: Any) -> None:
    seen: list[tuple[bool, int]] = []

    def remembers(state: TensorDictBase) -> TensorDictBase:
        assert exploration_type() == ExplorationType.DETERMINISTIC
        count = state.get("count", torch.zeros(1, dtype=torch.int64))
        seen.append((bool(state["is_init"]), int(count)))
        assert not (state["agents", "observation"] == 7.0).all(), "predictions are not observations"
        state["next"] = TensorDict({"count": count + 1, "is_init": torch.ones(1, dtype=torch.bool)}, [])
        state["next", "agents", "observation"] = torch.full_like(state["agents", "observation"], 7.0)
        return constant(0.0)(state)

    ego.others = remembers
    try:
        for _ in range(2):
            seen.clear()
            ego.reset(seed=1)
            ego.step(np.zeros(1, np.float32))
            assert [begins for begins, _ in seen] == [True] + [False] * (len(seen) - 1) and len(seen) >= 2
            assert [count for _, count in seen] == list(range(len(seen)))
    finally:
        ego.others = None


@pytest.mark.parametrize("brakes", [True, False])
def test_ego_among_others(brakes: bool, ego: Any) -> None:
    """The others follow the policy, or are uncommanded, and the ego follows its own actions."""
    ego.others = constant(-2.0) if brakes else None
    accelerations: dict[bool, list[float]] = {True: [], False: []}
    try:
        ego.reset(seed=1)
        for _ in range(10):
            before = ego.session.numbers
            ego.step(np.full(1, -1.0, np.float32))
            rows = ego.session.frame["agent_vehicle"]
            for slot in np.flatnonzero((before >= 0) & (ego.session.numbers == before)):
                speed, acceleration = ego.session.frame["vehicle_floats"][rows[slot], :2]
                if speed > 1.0:
                    accelerations[bool(slot == ego._slot)].append(float(acceleration))
    finally:
        ego.others = None
    own, others = np.array(accelerations[True]), np.array(accelerations[False])
    assert len(own) == 10 and len(others) >= 5 and np.allclose(own, -1.0, atol=1e-3)
    assert np.isclose(others, -2.0, atol=1e-3).all() if brakes else (others > -1.5).any()


def test_ego_waits_through_empty_simulations() -> None:
    """That no CV enters in several simulations may be chance, and is no reason to end a training."""
    rare = crossing(inflow_vph_per_lane=30.0, adoption=0.02)
    with view(EGO, contexts=rare, config=short(horizon_s=30.0), simulator="twin") as env:
        with pytest.warns(UserWarning, match="no controlled vehicle entered in 20 simulations in a row"):
            _, info = env.reset(seed=1)
        assert info["episode"] >= 20
    contexts = [crossing(adoption=0.0), crossing(adoption=0.0), crossing(adoption=0.0), crossing(adoption=0.9)]
    with view(EGO, contexts=RoundRobinSchedule(contexts, 0), config=short(), simulator="twin") as env:
        assert [env.reset()[1]["episode"] % 4 for _ in range(3)] == [3, 3, 3]


@pytest.mark.parametrize(
    ("context", "horizon_s", "reason"),
    [
        (crossing(adoption=0.0), 20.0, "the adoption of .* is 0"),
        (crossing(inflow_vph_per_lane=0.0), 20.0, ".* has no demand"),
        (crossing(lane_length_m=500.0), 10.0, r"the way to .* takes \d+ s, and 10 s are simulated"),
    ],
)
def test_ego_names_the_reason_if_no_cv_can_enter(context: Context, horizon_s: float, reason: str) -> None:
    with (
        view(EGO, contexts=context, config=short(horizon_s=horizon_s), simulator="twin") as env,
        pytest.raises(IzooError, match=f"no controlled vehicle entered, and none can: {reason}"),
    ):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("name", "mode"), [(JOINT, None), (EGO, None), pytest.param(EGO, "async", marks=pytest.mark.slow)]
)
def test_environments_of_a_vector_play_what_one_alone_plays(name: str, mode: str | None, joint: Any, ego: Any) -> None:
    env = joint if name == JOINT else ego
    options: dict[str, Any] = {"contexts": env.session.schedule, "config": short(horizon_s=80.0)}
    with contextlib.closing(gymnasium.make_vec(name, num_envs=2, vectorization_mode=mode, **options)) as envs:
        action = np.full(envs.action_space.shape or (), 2.0, np.float32)
        seen = [envs.reset(seed=5)[0], *(envs.step(action)[0] for _ in range(5))]
    alone = [env.reset(seed=6)[0], *(env.step(action[1])[0] for _ in range(5))]
    for one, several in zip(alone, seen, strict=True):
        if name == JOINT:
            np.testing.assert_array_equal(one["observation"], several["observation"][1])
        else:
            np.testing.assert_array_equal(one, several[1])


def test_a_vector_begins_the_next_episode_in_the_step_after_an_end() -> None:
    config = short(horizon_s=8.0, lane_change=True)
    with contextlib.closing(gymnasium.make_vec(JOINT, 2, contexts=crossing(), config=config)) as envs:
        envs.reset(seed=[3, 4])
        for _ in range(6):
            *_, truncated, info = envs.step(envs.action_space.sample())
        assert truncated.all() and (info["metrics"]["episode"]["steps"] == 6).all()
        observation, rewards, *_, truncated, info = envs.step(envs.action_space.sample())
        assert not truncated.any() and not rewards.any() and info["episode"].tolist() == [1, 1]
        assert observation in envs.observation_space
        with pytest.raises(IzooError, match=r"3 seeds.*2 environments"):
            envs.reset(seed=[1, 2, 3])
        with pytest.raises(IzooError, match="unknown reset option"):
            envs.reset(options={"what": 1})
        envs.reset()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda action: np.zeros(3, np.float32), r"float32 of shape \[3\].*shape \[(64|1)\]"),
        (lambda action: action[..., None], r"shape \[(64|1), 1\]"),
        (lambda action: action.astype(int), "int64.*floating-point"),
        (lambda action: None, "object"),
    ],
)
def test_bad_actions_are_refused(env: Env, change: Callable[[Any], Any], message: str) -> None:
    env.reset(seed=0)
    with pytest.raises(IzooError, match=message):
        env.step(change(forward(env)))
    env.step(forward(env))


@pytest.mark.parametrize("name", [JOINT, EGO])
def test_lane_changes(name: str) -> None:
    """Gymnasium's own check of the dictionary of actions, and what it refuses."""
    with view(name, config=short(lane_change=True), in_process=True) as env:
        shape = env.action_space["acceleration"].shape
        good = {"acceleration": np.zeros(shape, np.float32), "lane_change": np.ones(shape, np.int64)}
        if name == EGO:
            good["lane_change"] = np.int64(1)
        check_env(env, skip_render_check=True)
        env.reset(seed=0)
        for bad, message in (
            (good["acceleration"], r"is a ndarray; .*dictionary of 'acceleration'.*'lane_change'"),
            ({"acceleration": good["acceleration"]}, r"has the keys \['acceleration'\]"),
            (good | {"defer": 1}, "'defer'"),
            (good | {"lane_change": good["lane_change"] * 3}, r"values \[3\].*0 right, 1 keep, 2 left"),
            (good | {"lane_change": good["lane_change"] * 0.5}, r"float64.*whole numbers"),
            (good | {"lane_change": np.ones(3, np.int64)}, r"shape \[3\]"),
            (good | {"acceleration": np.zeros(3, np.float32)}, r"'acceleration' of the action is float32 of shape \[3"),
        ):
            with pytest.raises(IzooError, match=message):
                env.step(bad)
        env.step(good)


@pytest.mark.parametrize("name", [JOINT, EGO])
def test_step_before_reset_is_refused(name: str) -> None:
    with view(name) as env, pytest.raises(IzooError, match=r"step\(\) came before reset\(\); call reset\(\) first"):
        env.step(forward(env))


@pytest.mark.parametrize(("hold_s", "fps"), [(0.5, 2), (1.0, 1), (3.5, 1)])
def test_time_is_in_seconds_for_any_length_of_decisions(hold_s: float, fps: int) -> None:
    """Also where the last decision is shorter."""
    with view(JOINT, config=short(hold_s=hold_s), simulator="twin") as env:
        info, truncated = env.reset(seed=0)[1], False
        assert info["time_s"] == 5.0
        assert env.step(forward(env))[4]["time_s"] == 5.0 + hold_s
        while not truncated:
            _, _, _, truncated, info = env.step(forward(env))
        assert info["time_s"] == 60.0 and env.metadata["render_fps"] == fps


def test_a_lost_process_is_replaced(joint: Any) -> None:
    joint.reset(seed=0)
    joint.session._backend._workers[0].process.kill()
    with pytest.raises(RuntimeError, match=r"was lost.*call reset\(\)"):
        for _ in range(3):
            joint.step(forward(joint))
    with pytest.raises(IzooError, match=r"call reset\(\)"):
        joint.step(forward(joint))
    joint.reset()
    joint.step(forward(joint))


def test_bad_options_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    wrong: list[tuple[str, dict[str, Any], type[Exception], str]] = [
        ("izoo/EcoDrive-v0", {}, gymnasium.error.NameNotFound, "EcoDriving"),
        (JOINT, {"horizon": 3}, TypeError, "horizon"),
        (JOINT, {"config": {"horizon_s": 3}}, IzooError, "EnvConfig"),
        (EGO, {"others": "glide"}, IzooError, "others is a str"),
        (JOINT, {"render_mode": "human"}, IzooError, "needs a screen"),
        (JOINT, {"simulator": "twin", "render_mode": "human"}, IzooError, "the twin has none"),
        (JOINT, {"simulator": "twni"}, IzooError, "'twni'"),
    ]
    for name, options, kind, message in wrong:
        with pytest.raises(kind, match=message), view(name, **options):
            pass
