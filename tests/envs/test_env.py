"""TorchRL's view: specs of every variant, resets, seeds, and errors that say what to do."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv, check_env_specs

from izoo.contexts.source import ContextList, RoundRobinSchedule
from izoo.envs import EcoDrivingEnv, SumoParallelEnv
from izoo.envs.config import EMIT_GROUPS, NEIGHBOURS
from izoo.errors import IzooError
from tests.envs.worlds import crossing, defer, digest, play, same, short, steer

Make = Callable[..., Any]
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
}


@pytest.fixture
def make() -> Iterator[Make]:
    """Build environments and close them in the end."""
    made: list[EnvBase] = []

    def build(cls: type[EnvBase] = EcoDrivingEnv, contexts: Any = None, *args: Any, **kwargs: Any) -> Any:
        kwargs = {"config": short(), **kwargs}
        contexts = crossing() if contexts is None else contexts
        env = cls(*args, contexts, **kwargs) if args else cls(contexts=contexts, **kwargs)
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()


# -- specs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_specs_of_every_variant(make: Make, variant: str) -> None:
    env = make(config=short(**VARIANTS[variant]))
    check_env_specs(env)
    for group in EMIT_GROUPS:
        place = ("agents", group) if group in ("reward_vector", "number") else group
        assert (place in env.observation_spec.keys(True)) == (group in env.config.emit)


@pytest.mark.parametrize(
    "variant",
    ["everything", *(pytest.param(name, marks=pytest.mark.slow) for name in ("default", "nothing but agents"))],
)
def test_specs_of_the_parallel_environment(make: Make, variant: str) -> None:
    check_env_specs(make(SumoParallelEnv, num_workers=2, config=short(**VARIANTS[variant])))


@pytest.mark.parametrize("parallel", [False, True])
def test_specs_below_transforms(make: Make, parallel: bool) -> None:
    base = make(SumoParallelEnv, num_workers=2) if parallel else make()
    transforms = Compose(
        RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")]), StepCounter(max_steps=20)
    )
    check_env_specs(TransformedEnv(base, transforms))


def test_action_spec(make: Make) -> None:
    spec = make(config=short(lane_change=True)).full_action_spec
    assert spec["agents", "action"].space.low.unique().tolist() == [-4.5]
    assert spec["agents", "action"].space.high.unique().tolist() == [pytest.approx(2.6)]
    assert spec["agents", "lane_change"].n == 3


def test_observation_names_count_the_columns(make: Make) -> None:
    for variant in ("default", "blind", "some context observed"):
        env = make(config=short(**VARIANTS[variant]))
        assert len(env.observation_names) == env.observation_spec["agents", "observation"].shape[-1]
        assert len(set(env.observation_names)) == len(env.observation_names)


def test_works_without_arguments() -> None:
    env = EcoDrivingEnv()
    try:
        assert env.reset()["context", "seed"].item() > 0
        assert env.config.control_steps == 1950
    finally:
        env.close()


# -- stepping ----------------------------------------------------------------------------------------------------------


def test_own_stepping_is_torchrls(make: Make) -> None:
    """``step_and_maybe_reset`` gives what TorchRL's own version gives, over the end of an episode."""
    steps = short().control_steps + 5
    env = make()
    ours = play(env, steps)
    env.close()
    env = make()
    state, frames = env.reset(), []
    for _ in range(steps):
        frame, state = EnvBase.step_and_maybe_reset(env, steer(state))
        frames.append(frame)
    theirs = torch.stack(frames, -1)
    assert set(ours.keys(True)) == set(theirs.keys(True))
    assert same(ours, theirs)


def test_rollout_goes_on_with_the_next_episode(make: Make) -> None:
    env = make()
    steps = env.config.control_steps
    frames = env.rollout(2 * steps + 3, policy=steer, break_when_any_done=False)
    assert frames["context", "episode"].flatten().tolist() == [0] * steps + [1] * steps + [2] * 3
    ends = frames["next", "truncated"].flatten().nonzero().flatten().tolist()
    assert ends == [steps - 1, 2 * steps - 1]
    assert frames["next", "metrics", "episode", "steps"].flatten().tolist() == [
        *range(1, steps + 1),
        *range(1, steps + 1),
        *range(1, 4),
    ]
    assert not frames["metrics", "approach", "entered"][steps].any()


def test_an_agent_that_leaves_does_not_end_the_rollout(make: Make) -> None:
    env = make(config=short(horizon_s=100.0))
    frames = env.rollout(env.config.control_steps + 50, policy=defer)
    assert len(frames) == env.config.control_steps
    assert frames["next", "agents", "terminated"].any()


def test_transforms_see_every_episode(make: Make) -> None:
    """Returns and counters begin anew, and each automatic reset begins the next episode of the schedule."""
    env = TransformedEnv(
        make(SumoParallelEnv, num_workers=2),
        Compose(RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")]), StepCounter()),
    )
    steps = env.config.control_steps
    frames = env.rollout(2 * steps, policy=steer, break_when_any_done=False)
    assert frames["context", "episode"].squeeze(-1)[:, ::steps].tolist() == [[0, 2], [1, 3]]
    assert frames["next", "step_count"].squeeze(-1)[0].tolist() == [*range(1, steps + 1), *range(1, steps + 1)]
    total = frames["next", "agents", "reward"][:, :steps].sum((1, 2, 3))
    summed = frames["next", "agents", "episode_reward"][:, steps - 1].sum((1, 2))
    torch.testing.assert_close(summed, total, rtol=1e-4, atol=1e-3)
    assert torch.equal(
        frames["next", "agents", "episode_reward"][:, steps], frames["next", "agents", "reward"][:, steps]
    )


def test_frames_own_their_memory(make: Make) -> None:
    """What was handed out stays as it was when the environment goes on."""
    env = make()
    state = env.reset()
    frame, after = env.step_and_maybe_reset(steer(state))
    kept = frame.clone()
    play(env, 20, steer, after)
    assert same(frame, kept)


def test_vehicles_keep_their_state_in_defaults(make: Make) -> None:
    env = make(config=short(emit=()))
    keys = set(env.reset().keys())
    assert keys == {"agents", "done", "terminated", "truncated"}


# -- resets and seeds --------------------------------------------------------------------------------------------------


def test_partial_reset_touches_only_its_own(make: Make) -> None:
    """The other worker's episode goes on as if nothing had been."""
    env = make(SumoParallelEnv, num_workers=2)
    undisturbed = play(env, 40, steer)
    env.close()
    env = make(SumoParallelEnv, num_workers=2)
    state, frames = env.reset(), []
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


@pytest.mark.parametrize("parallel", [False, True])
def test_an_episode_can_be_played_again(make: Make, parallel: bool) -> None:
    env = make(SumoParallelEnv, num_workers=2) if parallel else make()
    schedule = RoundRobinSchedule([crossing(), crossing(lane_count=1)], 9)
    env.schedule = schedule
    first = [play(env, 30, defer, env.reset()) for _ in range(3)]
    assert len({digest(part) for part in first}) == 3
    numbers = first[1]["context", "episode"][..., 0, :]
    again = env.reset(episode=numbers)
    assert torch.equal(again["context", "episode"], numbers)
    assert digest(play(env, 30, defer, again)) == digest(first[1])
    # The schedule goes on where it was.
    expected = [6, 7] if parallel else [3]
    assert env.reset()["context", "episode"].flatten().tolist() == expected


def test_reset_to_any_context_and_seed(make: Make) -> None:
    env = make()
    other = crossing(adoption=1.0, temperature_c=-5.0)
    state = env.reset(context=other, seed=77)
    assert state["context", "seed"].item() == 77
    assert state["context", "adoption"].item() == 1.0
    assert state["context", "temperature_c"].item() == -5.0
    assert state["context", "context_id"].item() == -1


def test_context_keys_say_what_is_played(make: Make) -> None:
    env = make(contexts=RoundRobinSchedule([crossing(), crossing(engine="electric", adoption=0.25)], 4))
    engines, adoptions, seeds = [], [], []
    for number in range(3):
        context = env.reset()["context"]
        engines.append(context["engine"].item())
        adoptions.append(context["adoption"].item())
        seeds.append(context["seed"].item() == env.schedule(number)[1])
    assert engines == [0.0, 1.0, 0.0] and adoptions == [0.5, 0.25, 0.5] and all(seeds)


def test_set_seed(make: Make) -> None:
    """The base seed decides; two environments with the same one play the same."""
    digests = []
    for seed in (1, 1, 2):
        env = make()
        env.set_seed(seed)
        digests.append(digest(play(env, 30, defer)))
        env.close()
    assert digests[0] == digests[1] != digests[2]


def test_workers_share_a_schedule(make: Make) -> None:
    contexts = ContextList([crossing(), crossing(lane_count=1)])
    env = make(contexts=contexts, worker=1, num_workers=3, seed=8)
    assert [env.reset()["context", "episode"].item() for _ in range(3)] == [1, 4, 7]


# -- errors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parallel", [False, True])
def test_step_before_reset(make: Make, parallel: bool) -> None:
    env = make(SumoParallelEnv, num_workers=2) if parallel else make()
    action = env.full_action_spec.zero()
    with pytest.raises(IzooError, match="before reset"):
        env.step(action)
    assert env.reset()["agents", "mask"].shape[-1] == 64


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


def test_two_in_one_process(make: Make) -> None:
    one, two = make(), make()
    one.reset()
    with pytest.raises(IzooError, match=r"one simulation per process.*SumoParallelEnv"):
        two.reset()
    play(one, 5, steer, one.reset())
    one.close()
    assert two.reset() is not None


def test_a_forgotten_environment_gives_libsumo_back() -> None:
    """Rebinding the name of an environment, as one does in a notebook, is enough."""
    env = EcoDrivingEnv(crossing(), config=short())
    env.reset()
    env = EcoDrivingEnv(crossing(), config=short())
    try:
        env.reset()
    finally:
        env.close()


def test_usable_after_close(make: Make) -> None:
    """A closed environment that is used again either works or says so."""
    env = make()
    first = digest(play(env, 10))
    env.close()
    assert env.is_closed
    env.close()
    fresh = make()
    assert digest(play(fresh, 10)) == first


def test_too_few_approaches(make: Make) -> None:
    env = make(config=short(num_approaches=2))
    with pytest.raises(IzooError, match="set it to 4 or more"):
        env.reset()


def test_worker_processes_do_not_import_torch() -> None:
    """Starting sixteen of them must not cost sixteen imports of torch."""
    program = "import izoo.envs.sumo.simulator, izoo.envs.sumo.worker, sys; print('torch' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert output.stdout.strip() == "False"


def test_sharing_a_kept_frame_touches_no_other(make: Make) -> None:
    """As putting it into a queue of ``torch.multiprocessing`` does, which moves its memory."""
    env = make()
    kept, state = [], env.reset()
    for _ in range(20):
        frame, state = env.step_and_maybe_reset(steer(state))
        for name, array in (("mask", "mask"), ("reward", "reward"), ("done", "agent_done")):
            assert (frame["next", "agents", name].flatten().numpy() == env.frames[array].flatten()).all(), name
        kept.append((frame, frame.clone()))
        frame["next", "agents", "mask"].share_memory_()
    assert all(same(frame, as_it_was) for frame, as_it_was in kept)


def test_observed_features_have_one_order(make: Make) -> None:
    for observed in (("adoption", "green_s"), ("green_s", "adoption")):
        env = make(config=short(observed=observed))
        state = env.reset()
        present = state["agents", "observation"][state["agents", "mask"]]
        columns = {name: present[:, k] for k, name in enumerate(env.observation_names)}
        assert env.config.observed == ("adoption", "green_s")
        assert (columns["context_adoption"] == 0.5).all() and (columns["context_green_s"] < 1.0).all()
        env.close()


def test_more_exits_than_rows_are_refused(make: Make, dataset: ContextList) -> None:
    context = next(context for context in dataset if context.intersection.name.endswith("/114"))
    with pytest.raises(IzooError, match=r"3 approaches and 4 exits, but env.num_approaches is 3; set it to 4 or more"):
        make(contexts=context, config=short(num_approaches=3)).reset()


@pytest.mark.parametrize("build", [(EcoDrivingEnv,), (SumoParallelEnv, None, 2)])
def test_an_episode_that_has_ended_goes_no_further(make: Make, build: tuple[Any, ...]) -> None:
    env = make(*build, config=short(horizon_s=6.0))
    state = env.reset()
    for _ in range(env.config.control_steps):
        state = env.step(defer(state))["next"]
    assert state["done"].all()
    with pytest.raises(IzooError, match=r"the episode ended after 2 steps; call reset\(\)"):
        env.step(defer(state))
    assert not env.step(defer(env.reset()))["next", "done"].any()
