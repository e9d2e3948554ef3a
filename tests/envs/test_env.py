"""The TorchRL environments on both simulators: specs, steps, resets, seeds, and errors that say what to do."""

import contextlib
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv, check_env_specs

from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import EcoDrivingEnv
from izoo.envs.config import EMIT_GROUPS, NEIGHBOURS
from izoo.errors import IzooError
from tests.envs.conftest import Make
from tests.envs.worlds import constant, crossing, defer, digest, play, same, short, steer

PARTS, NUMBER = ("speed_before", "speed_behind"), {"emit": ("vehicles", "number")}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "nothing but agents": {"emit": ()},
    **{f"only {group}": {"emit": (group,)} for group in EMIT_GROUPS},
    "everything": {"emit": EMIT_GROUPS, "lane_change": True},
    "lane change": {"lane_change": True},
    "no context observed": {"observed": ()},
    "some context observed": {"observed": ("green_s", "adoption")},
    "blind": {"neighbours": (), "sensor_range_m": 50.0},
    "two neighbours": {"neighbours": NEIGHBOURS[:2], "sensor_range_m": 50.0},
    "few slots": {"num_agents": 1, "num_vehicles": 1, "num_approaches": 4},
    "long steps": {"step_s": 1.0},
    "no warm-up": {"warmup_s": 0.0},
    "speeds": {"action": "speed"},
    "accelerations per vehicle": {"decide": "vehicle", **NUMBER},
    "speeds per vehicle": {"decide": "vehicle", "action": "speed", **NUMBER},
    "two speeds per vehicle": {"decide": "vehicle_and_line", "action": "speed", "action_parts": PARTS, **NUMBER},
}
KINDS = [("sumo", None), ("sumo", 2), ("twin", 2)]
"""A single environment on SUMO, several in processes, several on the twin."""
each_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.mark.parametrize(
    ("kind", "variant"),
    [*((kind, name) for kind in (KINDS[0], KINDS[2]) for name in VARIANTS), (KINDS[1], "everything")],
)
def test_specs_of_every_variant(make: Make, kind: Any, variant: str) -> None:
    env = make(*kind, config=short(**VARIANTS[variant]))
    check_env_specs(env)
    for group in EMIT_GROUPS:
        place = ("agents", group) if group in ("reward_vector", "number") else group
        assert (place in env.observation_spec.keys(True)) == (group in env.config.emit)
    assert len(set(env.observation_names)) == env.observation_spec["agents", "observation"].shape[-1]
    if env.config.lane_change:
        assert env.full_action_spec["agents", "lane_change"].n == 3
    low = env.full_action_spec["agents", "action"].space.low.unique().tolist()
    assert low == pytest.approx([-4.5 if env.config.action == "acceleration" else 0.1])


def test_specs_of_both_simulators_are_equal(make: Make) -> None:
    config = short(emit=EMIT_GROUPS, lane_change=True)
    ours, theirs = (make(name, 2, config=config) for name in ("twin", "sumo"))
    for name in ("observation_spec", "full_action_spec", "reward_spec", "full_done_spec", "state_spec"):
        assert getattr(ours, name) == getattr(theirs, name)


def test_works_without_arguments() -> None:
    with contextlib.closing(EcoDrivingEnv()) as env:
        assert env.reset()["context", "seed"].item() > 0
        assert env.config.control_steps == 1950


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[2]])
def test_own_stepping_equals_torchrls(make: Make, kind: Any) -> None:
    """``step_and_maybe_reset`` gives what TorchRL's own version gives, over the end of an episode."""
    steps = short().control_steps + 5
    with contextlib.closing(make(*kind)) as env:
        ours = play(env, steps)
    env, frames = make(*kind), []
    state = env.reset()
    for _ in range(steps):
        frame, state = EnvBase.step_and_maybe_reset(env, steer(state))
        frames.append(frame)
    theirs = torch.stack(frames, -1)
    assert set(ours.keys(True)) == set(theirs.keys(True)) and ours["next", "done"].any()
    assert same(ours, theirs)


def test_rollout_goes_on_with_the_next_episode(make: Make) -> None:
    env = make()
    steps = env.config.control_steps
    frames = env.rollout(2 * steps + 3, policy=steer, break_when_any_done=False)
    assert frames["context", "episode"].flatten().tolist() == [0] * steps + [1] * steps + [2] * 3
    assert frames["next", "truncated"].flatten().nonzero().flatten().tolist() == [steps - 1, 2 * steps - 1]
    counted = frames["next", "metrics", "episode", "steps"].flatten().tolist()
    assert counted == [*range(1, steps + 1), *range(1, steps + 1), *range(1, 4)]
    assert not frames["metrics", "approach", "entered"][steps].any()
    frames = env.rollout(steps + 50, policy=defer)
    assert len(frames) == steps and frames["next", "agents", "terminated"].any(), "agents leave, and it goes on"


def test_transforms_see_every_episode(make: Make) -> None:
    """Returns and counters begin anew, and each automatic reset begins the next episode of the schedule."""
    sums = RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")])
    env = TransformedEnv(make("sumo", 2), Compose(sums, StepCounter()))
    steps = env.config.control_steps
    frames = env.rollout(2 * steps, policy=steer, break_when_any_done=False)
    assert frames["context", "episode"].squeeze(-1)[:, ::steps].tolist() == [[0, 2], [1, 3]]
    assert frames["next", "step_count"].squeeze(-1)[0].tolist() == [*range(1, steps + 1), *range(1, steps + 1)]
    reward, summed = frames["next", "agents", "reward"], frames["next", "agents", "episode_reward"]
    total = reward[:, :steps].sum((1, 2, 3))
    torch.testing.assert_close(summed[:, steps - 1].sum((1, 2)), total, rtol=1e-4, atol=1e-3)
    assert torch.equal(summed[:, steps], reward[:, steps])


def test_frames_own_their_memory(make: Make) -> None:
    """Frames do not change when the environment goes on, nor when one of them is moved to shared memory."""
    env = make()
    kept, state = [], env.reset()
    for _ in range(20):
        frame, state = env.step_and_maybe_reset(steer(state))
        for name, array in (("mask", "mask"), ("reward", "reward"), ("done", "agent_done")):
            assert (frame["next", "agents", name].flatten().numpy() == env.frames[array].flatten()).all(), name
        kept.append((frame, frame.clone()))
        frame["next", "agents", "mask"].share_memory_()
    assert all(same(frame, as_it_was) for frame, as_it_was in kept)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_partial_reset_touches_only_its_own_environment(make: Make, kind: Any) -> None:
    with contextlib.closing(make(*kind)) as env:
        undisturbed = play(env, 40, steer)
    env, frames = make(*kind), []
    state = env.reset()
    for t in range(40):
        if t == 25:
            chosen = state.clone().set("_reset", torch.tensor([[True], [False]]))
            again = env.reset(chosen, select_reset_only=True)
            assert again["context", "episode"].flatten().tolist() == [2, 1]
            assert again["metrics", "episode", "steps"].flatten().tolist() == [0, 25]
            assert same(again[1], state.select(*again.keys(True, True))[1])
            state = again
        frame, state = env.step_and_maybe_reset(steer(state))
        frames.append(frame)
    disturbed = torch.stack(frames, -1)
    assert digest(disturbed[1]) == digest(undisturbed[1])
    assert digest(disturbed[0]) != digest(undisturbed[0])


@pytest.mark.parametrize("kind", KINDS[:2])
def test_an_episode_can_be_played_again(make: Make, kind: Any) -> None:
    env = make(*kind)
    env.schedule = RoundRobinSchedule([crossing(), crossing(lane_count=1)], 9)
    first = [play(env, 30, defer, env.reset()) for _ in range(3)]
    assert len({digest(part) for part in first}) == 3
    numbers = first[1]["context", "episode"][..., 0, :]
    again = env.reset(episode=numbers)
    assert torch.equal(again["context", "episode"], numbers)
    assert digest(play(env, 30, defer, again)) == digest(first[1])
    # The schedule goes on where it was.
    assert env.reset()["context", "episode"].flatten().tolist() == ([3] if kind[1] is None else [6, 7])


def test_reset_to_any_context_and_seed(make: Make) -> None:
    env = make(contexts=RoundRobinSchedule([crossing(), crossing(engine="electric", adoption=0.25)], 4))
    for number in range(3):
        played = env.reset()["context"]
        assert played["engine"].item() == number % 2 and played["adoption"].item() == (0.5, 0.25)[number % 2]
        assert played["seed"].item() == env.schedule(number)[1]
    played = env.reset(context=crossing(adoption=1.0, temperature_c=-5.0), seed=77)["context"]
    assert [played[name].item() for name in ("seed", "adoption", "temperature_c", "context_id")] == [77, 1.0, -5.0, -1]


def test_the_base_seed_decides(make: Make) -> None:
    digests = []
    for seed in (1, 1, 2):
        with contextlib.closing(make()) as env:
            env.set_seed(seed)
            digests.append(digest(play(env, 30, defer)))
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.parametrize("simulator", [pytest.param("sumo", marks=pytest.mark.slow), "twin"])
def test_shards_share_the_episodes_of_a_schedule(make: Make, simulator: str) -> None:
    def episodes(num_envs: int, **shards: int) -> list[tuple[int, int]]:
        with contextlib.closing(make(simulator, num_envs, **shards)) as env:
            played = torch.cat([env.reset()["context"] for _ in range(2)])
        return list(zip(*(played[name].flatten().tolist() for name in ("episode", "seed")), strict=True))

    whole, parts = episodes(4), [episodes(2, shard=shard, num_shards=2) for shard in range(2)]
    assert [episode for episode, _ in parts[1]] == [2, 3, 6, 7]
    assert sorted(parts[0] + parts[1]) == sorted(whole)


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_wrong_shards_and_too_few_approaches_are_refused(make: Make, simulator: str) -> None:
    for wrong in ({"shard": 2, "num_shards": 2}, {"shard": -1}, {"num_shards": 0}, {"num_shards": 2}, {"shard": 1.5}):
        with pytest.raises(IzooError, match=next(iter(wrong)) if len(wrong) == 1 else "shard"):
            make(simulator, 2, **wrong)
    with pytest.raises(IzooError, match=r"num_workers is 4, and .*; give worker=k, too"):
        make(simulator, num_workers=4)
    with pytest.raises(IzooError, match="set it to 4 or more"):
        make(simulator, config=short(num_approaches=2)).reset()


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_lane_change_commands_move_vehicles(make: Make, simulator: str) -> None:
    """Right, keep and left: the mean lane of approaching CVs, and its mean change in a step; none collides."""
    config = short(lane_change=True, horizon_s=100.0)
    context = crossing(lane_count=3, lane_length_m=250.0, inflow_vph_per_lane=200.0, adoption=1.0)
    lanes, changes = [], []
    for command in range(3):

        def act(state: TensorDictBase, command: int = command) -> TensorDictBase:
            state["agents", "lane_change"] = torch.full(state["agents", "mask"].shape, command)
            return constant(1.0)(state)

        with contextlib.closing(make(simulator, contexts=context, config=config)) as env:
            frames = play(env, config.control_steps, act)
        before, after = frames["vehicles"], frames["next", "vehicles"]
        there = before["present"] & after["present"] & (before["vehicle_number"] == after["vehicle_number"])
        there &= (before["location"] == 0) & (after["location"] == 0)
        assert frames["next", "metrics", "episode", "collisions"][-1].item() == 0
        lanes.append(after["lane"][there].float().mean())
        changes.append((after["lane"] - before["lane"])[there].float().mean())
    assert lanes[0] < lanes[1] - 0.1 < lanes[2] - 0.2
    assert changes[0] < changes[1] < changes[2]


@pytest.mark.parametrize("simulator", ["sumo", "twin"])
def test_render_shows_the_present_state(make: Make, simulator: str) -> None:
    env = make(simulator)
    state = env.reset(context=crossing(lane_count=1), seed=3)
    assert env.scene().context == crossing(lane_count=1)
    before = env.render()
    for _ in range(8):
        _, state = env.step_and_maybe_reset(defer(state))
    assert before.shape == (640, 640, 3) and (env.render() != before).any()
    assert len(env.scene().vehicles["speed_mps"]) == int(state["vehicles", "present"].sum())


@each_kind
def test_steps_need_a_running_episode(make: Make, kind: Any) -> None:
    env = make(*kind, config=short(horizon_s=6.0))
    with pytest.raises(IzooError, match=r"before reset"):
        env.step(env.full_action_spec.zero())
    state = env.reset()
    for _ in range(env.config.control_steps):
        state = env.step(defer(state))["next"]
    assert state["done"].all()
    with pytest.raises(IzooError, match=r"the episode ended after 2 steps; call reset\(\)"):
        env.step(defer(state))
    assert not env.step(defer(env.reset()))["next", "done"].any()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("action", None, r"'action'\) is missing; give accelerations in m/s\^2"),
        ("action", torch.zeros(64), r"float32 of shape \[64\].*shape \[64, 1\]"),
        ("action", torch.zeros(64, 1, dtype=torch.long), "int64.*float tensor"),
        ("defer", torch.zeros(64, 2, dtype=torch.bool), r"'defer'\) is of shape \[64, 2\]; give flags of shape \[64\]"),
        ("lane_change", None, r"'lane_change'\) is missing; with lane_change=True"),
        ("lane_change", torch.zeros(64, 1, dtype=torch.long), r"shape \[64, 1\].*shape \[64\]: 0 right"),
        ("lane_change", torch.ones(64), "float32"),
        ("lane_change", torch.full((64,), 3), r"values \[3\]"),
    ],
)
def test_bad_actions_are_refused(make: Make, key: str, value: torch.Tensor | None, message: str) -> None:
    env = make(config=short(lane_change=True))
    action = env.reset().update(env.full_action_spec.zero())
    agents = dict(action["agents"].exclude(key).items()) | ({} if value is None else {key: value})
    with pytest.raises(IzooError, match=message):
        env._step(TensorDict({"agents": TensorDict(agents, [64])}, []))


def test_two_simulations_of_sumo_in_one_process_are_refused(make: Make) -> None:
    one, two = make(), make()
    one.reset()
    with pytest.raises(IzooError, match=r"one simulation per process.*SumoParallelEnv"):
        two.reset()
    play(one, 5, steer, one.reset())
    one.close()
    assert two.reset() is not None


def test_a_forgotten_environment_frees_libsumo() -> None:
    """Rebinding the name of an environment, as in a notebook, is enough."""
    env = EcoDrivingEnv(crossing(), config=short())
    env.reset()
    env = EcoDrivingEnv(crossing(), config=short())
    with contextlib.closing(env):
        env.reset()


def test_observed_features_have_one_order(make: Make) -> None:
    for observed in (("adoption", "green_s"), ("green_s", "adoption")):
        with contextlib.closing(make(config=short(observed=observed))) as env:
            state = env.reset()
            present = state["agents", "observation"][state["agents", "mask"]]
            columns = {name: present[:, k] for k, name in enumerate(env.observation_names)}
            assert env.config.observed == ("adoption", "green_s")
            assert (columns["context_adoption"] == 0.5).all() and (columns["context_green_s"] < 1.0).all()


@each_kind
def test_specs_below_transforms(make: Make, kind: Any) -> None:
    sums = RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")])
    check_env_specs(TransformedEnv(make(*kind), Compose(sums, StepCounter(max_steps=20))))
