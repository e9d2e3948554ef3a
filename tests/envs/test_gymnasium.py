"""The Gymnasium views: Gymnasium's own checks, the ego's life, vector forms, and what is refused."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type

import izoo.envs
from izoo.contexts.context import Context
from izoo.contexts.source import RoundRobinSchedule
from izoo.errors import IzooError
from tests.envs.worlds import crossing, short

JOINT, EGO = "izoo/EcoDriving-v0", "izoo/EcoDrivingEgo-v0"
IDS = [JOINT, EGO]


def make(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    options = {"contexts": crossing(), "config": short(horizon_s=80.0)} | options
    return gymnasium.make(name, **options).unwrapped


@pytest.fixture(scope="module")
def joint() -> Iterator[gymnasium.Env[Any, Any]]:
    env = make(JOINT, render_mode="rgb_array")
    yield env
    env.close()


@pytest.fixture(scope="module")
def ego() -> Iterator[gymnasium.Env[Any, Any]]:
    env = make(EGO, contexts=crossing(phase_count=1, green_s=15.0, red_s=15.0))
    yield env
    env.close()


def forward(env: gymnasium.Env[Any, Any]) -> np.ndarray:
    return np.full(env.action_space.shape or (), 2.0, np.float32)


@pytest.mark.filterwarnings("ignore:.*Box:UserWarning", "ignore:.*symmetric:UserWarning")
@pytest.mark.parametrize("name", ["joint", "ego"])
def test_gymnasiums_own_check(name: str, request: pytest.FixtureRequest) -> None:
    check_env(request.getfixturevalue(name))


def test_importing_registers_without_torch() -> None:
    program = (
        "import sys, gymnasium; gymnasium.make('izoo.envs:izoo/EcoDriving-v0'); "
        "gymnasium.spec('izoo/EcoDrivingEgo-v0'); sys.exit('torch' in sys.modules or 'libsumo' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_reset_without_a_seed_goes_on(joint: gymnasium.Env[Any, Any]) -> None:
    first, again = joint.reset(seed=3)[1], joint.reset(seed=3)[1]
    assert first["episode"] == again["episode"] == 0 and first["episode_seed"] == again["episode_seed"]
    following = joint.reset()[1]
    assert following["episode"] == 1 and following["episode_seed"] != first["episode_seed"]
    chosen = joint.reset(options={"episode": 0})[1]
    assert chosen["episode_seed"] == first["episode_seed"]
    other = crossing(lane_count=1)
    assert joint.reset(options={"context": other, "episode_seed": 7})[1]["context"] == other.name


def test_joint_rewards(joint: gymnasium.Env[Any, Any]) -> None:
    """The mean over the CVs that acted; its sum is the episode's return."""
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


def test_ego_is_one_vehicle_after_another(ego: gymnasium.Env[Any, Any]) -> None:
    egos: list[int] = []
    ends = set()
    begin_m = ego.unwrapped.observation_names.index("stop_line_distance")
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


def test_others_act_by_their_mode_and_remember_a_simulation(ego: gymnasium.Env[Any, Any]) -> None:
    env = ego.unwrapped
    seen: list[tuple[bool, int]] = []

    def remembers(tensordict: TensorDict) -> TensorDict:
        assert exploration_type() == ExplorationType.DETERMINISTIC
        count = tensordict.get("count", torch.zeros(1, dtype=torch.int64))
        seen.append((bool(tensordict["is_init"]), int(count)))
        assert not (tensordict["agents", "observation"] == 7.0).all(), "what is foretold is not what is seen"
        tensordict["next"] = TensorDict({"count": count + 1, "is_init": torch.ones(1, dtype=torch.bool)}, [])
        tensordict["next", "agents", "observation"] = torch.full_like(tensordict["agents", "observation"], 7.0)
        return tensordict.set(("agents", "action"), torch.zeros(tensordict["agents", "mask"].shape[0], 1))

    env.others = remembers
    try:
        for _ in range(2):
            seen.clear()
            env.reset(seed=1)
            env.step(np.zeros(1, np.float32))
            assert [begins for begins, _ in seen] == [True] + [False] * (len(seen) - 1) and len(seen) >= 2
            assert [count for _, count in seen] == list(range(len(seen)))
    finally:
        env.others = None


@pytest.mark.parametrize("policy", ["brake", None])
def test_ego_among_others(policy: str | None, ego: gymnasium.Env[Any, Any]) -> None:
    """Others follow the policy, or SUMO, and the ego does what it is told."""
    env = ego.unwrapped
    env.others = brake if policy else None
    accelerations: dict[bool, list[float]] = {True: [], False: []}
    try:
        env.reset(seed=1)
        for _ in range(10):
            before = env.session.numbers
            env.step(np.full(1, -1.0, np.float32))
            rows = env.session.frame["agent_vehicle"]
            for slot in np.flatnonzero((before >= 0) & (env.session.numbers == before)):
                speed, acceleration = env.session.frame["vehicle_floats"][rows[slot], :2]
                if speed > 1.0:
                    accelerations[bool(slot == env._slot)].append(float(acceleration))
    finally:
        env.others = None
    own, others = np.array(accelerations[True]), np.array(accelerations[False])
    assert len(own) == 10 and len(others) >= 5 and np.allclose(own, -1.0, atol=1e-3)
    assert np.isclose(others, -2.0, atol=1e-3).all() if policy else (others > -1.5).any()


def brake(tensordict: Any) -> Any:
    mask = tensordict["agents", "mask"]
    return tensordict.set(("agents", "action"), torch.full((*mask.shape, 1), -2.0))


def test_ego_waits_through_empty_simulations() -> None:
    """That none came in several simulations is chance, and no reason to end a training."""
    rare = crossing(inflow_vph_per_lane=30.0, adoption=0.02)
    with contextlib.closing(make(EGO, contexts=rare, config=short(horizon_s=30.0), simulator="twin")) as env:
        with pytest.warns(UserWarning, match="no controlled vehicle entered in 20 simulations in a row"):
            _, info = env.reset(seed=1)
        assert info["episode"] >= 20


@pytest.mark.parametrize(
    ("context", "horizon_s", "reason"),
    [
        (crossing(adoption=0.0), 20.0, "the adoption of .* is 0"),
        (crossing(inflow_vph_per_lane=0.0), 20.0, ".* has no demand"),
        (crossing(lane_length_m=500.0), 10.0, r"the way to .* takes \d+ s, and 10 s are simulated"),
    ],
)
def test_it_is_said_why_no_controlled_vehicle_can_come(context: Context, horizon_s: float, reason: str) -> None:
    with contextlib.closing(make(EGO, contexts=context, config=short(horizon_s=horizon_s), simulator="twin")) as env:
        with pytest.raises(IzooError, match=f"no controlled vehicle entered, and none can: {reason}"):
            env.reset(seed=0)


def test_contexts_without_controlled_vehicles_are_passed_over() -> None:
    contexts = [crossing(adoption=0.0), crossing(adoption=0.0), crossing(adoption=0.0), crossing(adoption=0.9)]
    with contextlib.closing(
        make(EGO, contexts=RoundRobinSchedule(contexts, 0), config=short(), simulator="twin")
    ) as env:
        assert [env.reset()[1]["episode"] % 4 for _ in range(3)] == [3, 3, 3]


# -- vector forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "mode"), [(JOINT, None), (EGO, None), pytest.param(EGO, "async", marks=pytest.mark.slow)]
)
def test_vector_form(name: str, mode: str | None, request: pytest.FixtureRequest) -> None:
    """Every environment of a vector plays what one alone with its seed does."""
    env = request.getfixturevalue("joint" if name == JOINT else "ego")
    schedule = env.unwrapped.session.schedule
    options: dict[str, Any] = {"contexts": schedule, "config": short(horizon_s=80.0)}
    with contextlib.closing(gymnasium.make_vec(name, num_envs=2, vectorization_mode=mode, **options)) as envs:
        action = np.full(envs.action_space.shape or (), 2.0, np.float32)
        seen = [envs.reset(seed=5)[0], *(envs.step(action)[0] for _ in range(5))]
    alone = [env.reset(seed=6)[0], *(env.step(action[1])[0] for _ in range(5))]
    for one, several in zip(alone, seen, strict=True):
        if name == JOINT:
            np.testing.assert_array_equal(one["observation"], several["observation"][1])
        else:
            np.testing.assert_array_equal(one, several[1])


def test_vector_begins_anew() -> None:
    """After an end, the next step of that environment is a reset."""
    with contextlib.closing(gymnasium.make_vec(JOINT, 2, contexts=crossing(), config=short(horizon_s=8.0))) as envs:
        action = np.zeros(envs.action_space.shape or (), np.float32)
        envs.reset(seed=[3, 4])
        for _ in range(6):
            *_, truncated, info = envs.step(action)
        assert truncated.all() and (info["metrics"]["episode"]["steps"] == 6).all()
        observation, rewards, *_, truncated, info = envs.step(action)
        assert not truncated.any() and not rewards.any() and info["episode"].tolist() == [1, 1]
        assert observation in envs.observation_space
        with pytest.raises(IzooError, match=r"3 seeds.*2 environments"):
            envs.reset(seed=[1, 2, 3])
        with pytest.raises(IzooError, match="unknown reset option"):
            envs.reset(options={"what": 1})


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["joint", "ego"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda action: np.zeros(3, np.float32), r"float32 of shape \[3\].*shape \[(64|1)\]"),
        (lambda action: action[..., None], r"shape \[(64|1), 1\]"),
        (lambda action: action.astype(int), "int64.*floating-point"),
        (lambda action: None, "object"),
    ],
)
def test_bad_actions_are_refused(
    name: str, change: Callable[[Any], Any], message: str, request: pytest.FixtureRequest
) -> None:
    env = request.getfixturevalue(name)
    env.reset(seed=0)
    with pytest.raises(IzooError, match=message):
        env.step(change(forward(env)))
    env.step(forward(env))


@pytest.mark.filterwarnings("ignore:.*Box:UserWarning", "ignore:.*symmetric:UserWarning")
@pytest.mark.parametrize("name", IDS)
def test_lane_changes(name: str) -> None:
    """Gymnasium's own check of the dictionary of actions, and what it refuses."""
    with contextlib.closing(make(name, config=short(lane_change=True), in_process=True)) as env:
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
            (
                good | {"acceleration": np.zeros(3, np.float32)},
                r"'acceleration' of the action is float32 of shape \[3\]",
            ),
        ):
            with pytest.raises(IzooError, match=message):
                env.step(bad)
        env.step(good)


@pytest.mark.parametrize("name", IDS)
def test_step_before_reset_is_refused(name: str) -> None:
    env = make(name)
    with pytest.raises(IzooError, match=r"step\(\) came before reset\(\); call reset\(\) first"):
        env.step(forward(env))


def test_step_after_the_end_is_refused(joint: gymnasium.Env[Any, Any]) -> None:
    joint.reset(seed=0)
    while not joint.step(forward(joint))[3]:
        pass
    with pytest.raises(IzooError, match="after the end of the episode"):
        joint.step(forward(joint))


@pytest.mark.parametrize(("hold_s", "fps"), [(0.5, 2), (1.0, 1), (3.5, 1)])
def test_time_is_in_seconds_however_long_decisions_are(hold_s: float, fps: int) -> None:
    """Also where the last decision is shorter."""
    with contextlib.closing(make(JOINT, config=short(hold_s=hold_s), simulator="twin")) as env:
        info, truncated = env.reset(seed=0)[1], False
        assert info["time_s"] == 5.0
        assert env.step(forward(env))[4]["time_s"] == 5.0 + hold_s
        while not truncated:
            _, _, _, truncated, info = env.step(forward(env))
        assert info["time_s"] == 60.0 and env.metadata["render_fps"] == fps


def test_a_lost_process_is_replaced(joint: gymnasium.Env[Any, Any]) -> None:
    joint.reset(seed=0)
    joint.unwrapped.session._backend._workers[0].process.kill()
    with pytest.raises(RuntimeError, match=r"was lost.*call reset\(\)"):
        for _ in range(3):
            joint.step(forward(joint))
    with pytest.raises(IzooError, match=r"call reset\(\)"):
        joint.step(forward(joint))
    joint.reset()
    joint.step(forward(joint))


def test_a_refused_reset_leaves_the_schedule_alone(joint: gymnasium.Env[Any, Any]) -> None:
    first = joint.reset(seed=3)[1]
    with pytest.raises(IzooError, match="'episode' is -1"):
        joint.reset(seed=7, options={"episode": -1})
    with pytest.raises(IzooError, match="'episode_seed' is None"):
        joint.reset(options={"episode_seed": None})
    assert (
        joint.reset()[1]["episode"] == 1
        and joint.reset(options={"episode": 0})[1]["episode_seed"] == first["episode_seed"]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 3}, "unknown reset option 'episodes'.*Did you mean 'episode'"),
        ({"context": "pcg"}, "'context' is a str; give an izoo Context"),
        ({"episode": 2.9}, "the reset option 'episode' is 2.9; it must be a whole number from 0"),
        ({"episode": True}, "'episode' is True"),
        ({"episode": -1}, "'episode' is -1"),
        ({"episode_seed": 1.5}, "'episode_seed' is 1.5; it must be a whole number from 0"),
    ],
)
def test_bad_options_are_refused(joint: gymnasium.Env[Any, Any], options: dict[str, Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        joint.reset(options=options)


def test_unknown_names_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(gymnasium.error.NameNotFound, match="EcoDriving"):
        gymnasium.make("izoo/EcoDrive-v0")
    with pytest.raises(TypeError, match="horizon"):
        gymnasium.make(JOINT, horizon=3)
    with pytest.raises(IzooError, match="rgb_array, human"):
        izoo.envs.views.gymnasium.EcoDrivingJoint(render_mode="ansi")
    with pytest.raises(IzooError, match=r"EnvConfig"):
        make(JOINT, config={"horizon_s": 3})
    with pytest.raises(IzooError, match="others is a str"):
        make(EGO, others="glide")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(IzooError, match="needs a screen"):
        make(JOINT, render_mode="human")


def test_the_twin_draws_pictures_and_has_no_window() -> None:
    with contextlib.closing(make(JOINT, simulator="twin", render_mode="rgb_array")) as env:
        env.reset(seed=0)
        picture = env.render()
        assert isinstance(picture, np.ndarray) and picture.shape == (640, 640, 3) and picture.std() > 0.0
    with pytest.raises(IzooError, match="the twin has no window"):
        make(JOINT, simulator="twin", render_mode="human")
    with pytest.raises(IzooError, match="'twni'"):
        make(JOINT, simulator="twni")
