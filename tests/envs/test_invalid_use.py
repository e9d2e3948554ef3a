"""Invalid options and calls: refused with a message, and the environment stays as it was."""

import locale
import os
import subprocess
import sys
import threading
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from izoo.envs import SIMULATORS, EcoDrivingEnv, SumoParallelEnv
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.envs.env import EcoDrivingBase
from izoo.envs.mdp.metric_sums import EPISODE_METRIC
from izoo.errors import IzooError
from tests.envs.conftest import Make
from tests.envs.worlds import crossing, play_on, short, steer

ROOT = Path(__file__).resolve().parents[2]
WRONG: dict[Any, tuple[Any, ...]] = {
    int: ("80", 2.5, True, None, [1], float("nan"), -1),
    float: ("80", True, [0.5], {}, float("nan")),
    bool: ("yes", 1, None),
    tuple[str, ...]: ("green_s", 3, None, [None]),
}
"""Values that no option of a type can have. ``None`` is left out where it is legal."""


@pytest.mark.parametrize("config", [EnvConfig, RewardConfig])
def test_every_option_refuses_values_of_other_types(config: type) -> None:
    for name, kind in typing.get_type_hints(config).items():
        kinds = [kind] if kind in WRONG else [part for part in typing.get_args(kind) if part in WRONG]
        for value in (value for one in kinds for value in WRONG[one]):
            if config is RewardConfig and value == -1:
                continue  # weights may be negative
            with pytest.raises(IzooError, match=name.split("_")[0]):
                config(**{name: value})


def test_numpy_numbers_and_whole_numbers_for_real_ones_are_legal() -> None:
    config = EnvConfig(horizon_s=80, num_agents=np.int64(3), warmup_s=np.float32(5.0), observed=["green_s"])  # type: ignore[arg-type]
    assert config.control_steps == 150 and config.observed == ("green_s",)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EcoDrivingEnv(config={}), "config is a dict; give an izoo.envs.EnvConfig"),
        (lambda: EnvConfig(horizon_s=60.0, warmup_s=59.9), "must be the longer one, by a step of 0.5 s at least"),
        (lambda: EnvConfig(step_s=1 / 3), "step_s is 0.333333.*whole milliseconds. Give 0.333 or 0.334"),
        (lambda: EcoDrivingEnv(seed=None), "seed is None; it must be a whole number"),
        (lambda: EcoDrivingEnv(seed=-1), "seed is -1"),
        (lambda: EcoDrivingEnv(worker=2, num_workers=2), "worker is 2; it must be a whole number from 0 to 1"),
        (lambda: SumoParallelEnv(2.5), "num_workers is 2.5; it must be a whole number from 1"),
        (lambda: SumoParallelEnv(0), "num_workers is 0"),
        (lambda: EcoDrivingEnv(crossing(), simulator="cityflow"), "simulator"),
    ],
)
def test_constructors_refuse(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        make()


def test_a_refused_call_leaves_the_environment_unchanged(make: Make) -> None:
    env = make(seed=4)
    for seed in ("a", 1.5, -1):
        with pytest.raises(IzooError, match="seed is"):
            env.set_seed(seed)
    for episode in (-1, 1.5, [1, 2], True):
        with pytest.raises(IzooError, match=r"reset\(episode="):
            env.reset(episode=episode)
    for wrong in ({"context": "crossing"}, {"seed": -3}, {"seed": "a"}, {"lap": 2}):
        with pytest.raises(IzooError):
            env.reset(**wrong)
    assert env.reset()["context", "episode"].item() == 0 and env.schedule.seed == 4


def moved(env: EcoDrivingBase) -> list[float]:
    """Steps that every environment has taken since its episode began."""
    return env.frames["episode_metrics"][:, EPISODE_METRIC["steps"]].tolist()


def one_ended(env: EcoDrivingBase, state: TensorDictBase) -> TensorDictBase:
    """Play on until the first environment's episode has ended, and the second's has not."""
    state = env.reset(state.set("_reset", torch.tensor([[False], [True]])))
    while not state["done"].any():
        state = env.step(steer(state))["next"]
    assert state["done"].flatten().tolist() == [True, False]
    return steer(state)


REFUSED: tuple[Callable[[EcoDrivingBase, TensorDictBase], TensorDictBase], ...] = (
    lambda env, state: state.set(("agents", "action"), torch.zeros(2, 64, 2)),
    lambda env, state: state.exclude(("agents", "action")),
    lambda env, state: state.set(("agents", "defer"), torch.zeros(2, 64, 2, dtype=torch.bool)),
    one_ended,
)
"""Numbers too many, no action, flags too many, and an environment whose episode has ended."""


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_step_that_one_environment_refuses_moves_none(make: Make, simulator: str) -> None:
    env = make(simulator, 2, config=short(horizon_s=20.0))
    _, state = play_on(env, 5, steer, env.reset())
    for spoil in REFUSED:
        refused = spoil(env, steer(state.clone()))
        before = moved(env)
        with pytest.raises(IzooError):
            env.step(refused)
        assert moved(env) == before and env.backend.started


def played(state: TensorDictBase) -> list[int]:
    """The numbers of the episodes, of every environment."""
    return state["context", "episode"].flatten().tolist()


@pytest.mark.parametrize("workers", [None, 2])
def test_reset_ignores_the_episode_in_its_input(make: Make, workers: int | None) -> None:
    """Passing the last state to ``reset``, as many loops do, begins the next episode."""
    env = make("sumo", workers)
    state = env.reset()
    numbers = [played(state), played(env.reset(state)), played(env.reset(play_on(env, 3, steer, state)[1]))]
    assert numbers == ([[0, 1], [2, 3], [4, 5]] if workers else [[0], [1], [2]])
    state = env.reset(state, episode=[1, 4] if workers else 1)
    assert played(state) == ([1, 4] if workers else [1])
    assert played(env.reset(state)) == ([6, 7] if workers else [3])
    if workers:
        assert played(env.reset(state.set("_reset", torch.tensor([[False], [True]])))) == [6, 9]


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_reset_flags_at_the_root_or_of_all_agents_choose_environments(make: Make, simulator: str) -> None:
    env = make(simulator, 2)
    state = play_on(env, 3, steer, env.reset())[1]
    rows = torch.tensor([[False], [True]])
    flags = rows.expand(2, 64).clone()
    assert played(env.reset(state.clone().set("_reset", rows))) == [0, 3] and moved(env) == [3.0, 0.0]
    key = ("agents", "_reset")
    assert played(env.reset(state.clone().set(key, flags.clone()))) == [0, 5] and moved(env) == [3.0, 0.0]
    flags[0, 5] = True
    with pytest.raises(IzooError, match="some agents of an environment"):
        env.reset(state.clone().set(key, flags))


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_reset_without_any_flag_changes_nothing(make: Make, simulator: str) -> None:
    env = make(simulator)
    _, state = play_on(env, 3, steer, env.reset())
    after = env.reset(state.clone().set("_reset", torch.zeros(1, dtype=torch.bool)))
    assert after["metrics", "episode", "steps"].item() == 3 and played(after) == [0]
    assert torch.equal(after["agents", "observation"], state["agents", "observation"])


def run(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    options: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 200}
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, env={**os.environ, **environment}, **options)


@pytest.mark.slow
def test_temporary_and_cache_folders_may_have_any_name(tmp_path: Path) -> None:
    """SUMO itself would take a comma for the end of a path, and replace variables."""
    folder = tmp_path / "a,b${HOME};b |&<'\"\u4ea4"
    folder.mkdir()
    program = "import torch; from izoo.envs import EcoDrivingEnv, EnvConfig; from tests.envs.worlds import crossing\n"
    program += "env = EcoDrivingEnv(crossing(), config=EnvConfig(horizon_s=40.0)); print(env.rollout(3).shape[0])"
    done = run(program, TMPDIR=str(folder), IZOO_CACHE_DIR=str(folder / "cache"))
    assert done.stdout == "3\n", done.stderr
    assert {path.name for path in folder.iterdir()} == {"cache"}


def test_sumo_refuses_a_locale_with_decimal_comma(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locale, "localeconv", lambda: {"decimal_point": ","})
    with pytest.raises(IzooError, match="numbers have a decimal comma"):
        make().reset()


PARALLEL = """
from torchrl.envs import ParallelEnv
from izoo.envs import EcoDrivingEnv, SumoParallelEnv, TwinEnv
from tests.envs.worlds import crossing, short
if __name__ == '__main__':
    env = ParallelEnv(2, {makers}, mp_start_method='spawn')
    print(env.reset()['context', 'seed'].flatten().unique().numel())
    env.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("makers", "distinct"),
    [
        ("lambda: EcoDrivingEnv(crossing(), config=short())", 1),
        ("[lambda k=k: EcoDrivingEnv(crossing(), config=short(), worker=k, num_workers=2) for k in range(2)]", 2),
        ("lambda: TwinEnv(2, crossing(), config=short())", 2),
        ("[lambda k=k: TwinEnv(2, crossing(), config=short(), shard=k, num_shards=2) for k in range(2)]", 4),
    ],
)
def test_torchrls_workers_warn_if_they_play_the_same_episodes(makers: str, distinct: int, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PARALLEL.format(makers=makers))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=200, env=environment)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) == distinct
    assert ("plays the same episodes" in done.stderr.replace("\n", " ")) == ("k=k" not in makers)


def test_a_second_thread_is_refused(make: Make) -> None:
    """It would read the answers that the first one waits for."""
    env = make("sumo", 2)
    state = steer(env.reset())
    asking, go_on, real = threading.Event(), threading.Event(), env.backend.step

    def held(meanwhile: Any = None) -> Any:
        asking.set()
        go_on.wait(30)
        return real(meanwhile)

    env.backend.step = held
    first = threading.Thread(target=env.step, args=(state.clone(),))
    first.start()
    try:
        assert asking.wait(30)
        for call in (lambda: env.step(state.clone()), env.reset):
            with pytest.raises(IzooError, match="another thread"):
                call()
    finally:
        go_on.set()
        first.join(60)
    env.backend.step = real
    env.step(state)
    assert played(env.reset()) == [2, 3], "the refused reset has used up no episodes"
