"""What a user, a second thread or a forked process does to an environment: it answers in words, or stays as it was."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import threading
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from izoo.envs import SIMULATORS, EcoDrivingEnv, SumoParallelEnv, TwinEnv
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.envs.env import EcoDrivingBase
from izoo.envs.mdp.metric_sums import EPISODE_METRIC
from izoo.errors import IzooError
from tests.envs.worlds import crossing, play_on, short, steer

ROOT = Path(__file__).resolve().parents[2]
WRONG: dict[Any, tuple[Any, ...]] = {
    int: ("80", 2.5, True, None, [1], float("nan"), -1),
    float: ("80", True, [0.5], {}, float("nan")),
    bool: ("yes", 1, None),
    tuple[str, ...]: ("green_s", 3, None, [1]),
}
"""Values that an option of a type cannot have, whichever option it is. ``None`` is left out where it is legal."""


def options_of(config: type) -> list[tuple[type, str, Any]]:
    """Every option of a group whose type is in :data:`WRONG`, with each wrong value."""
    found = []
    for name, kind in typing.get_type_hints(config).items():
        kinds = [kind] if kind in WRONG else [part for part in typing.get_args(kind) if part in WRONG]
        found += [(config, name, value) for one in kinds for value in WRONG[one]]
    return found


@pytest.mark.parametrize(("config", "name", "value"), [*options_of(EnvConfig), *options_of(RewardConfig)])
def test_every_option_refuses_what_it_cannot_be(config: type, name: str, value: Any) -> None:
    assert name in {field.name for field in dataclasses.fields(config)}
    if config is RewardConfig and value == -1:
        pytest.skip("weights may be negative")
    with pytest.raises(IzooError, match=name.split("_")[0]):
        config(**{name: value})


def test_numbers_of_numpy_and_whole_numbers_for_real_ones_are_legal() -> None:
    import numpy as np

    config = EnvConfig(horizon_s=80, num_agents=np.int64(3), warmup_s=np.float32(5.0), observed=["green_s"])  # type: ignore[arg-type]
    assert config.control_steps == 150 and config.observed == ("green_s",)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EcoDrivingEnv(config={}), "config is a dict; give an izoo.envs.EnvConfig"),
        (lambda: SumoParallelEnv(2, config={}), "config is a dict"),
        (lambda: EcoDrivingEnv(config=80), "config is a int"),
        (lambda: EnvConfig(horizon_s=60.0, warmup_s=59.9), "must be the longer one, by a step of 0.5 s at least"),
        (lambda: EnvConfig(step_s=1 / 3), "step_s is 0.333333.*whole milliseconds. Give 0.333 or 0.334"),
        (lambda: EnvConfig(step_s=0.0625), "Give 0.062 or 0.063"),
        (lambda: EcoDrivingEnv(seed=None), "seed is None; it must be a whole number"),
        (lambda: EcoDrivingEnv(seed=-1), "seed is -1"),
        (lambda: EcoDrivingEnv(seed="a"), "seed is 'a'"),
        (lambda: EcoDrivingEnv(worker=2, num_workers=2), "worker is 2; it must be a whole number from 0 to 1"),
        (lambda: EcoDrivingEnv(num_workers=0), "num_workers is 0"),
        (lambda: SumoParallelEnv(2.5), "num_workers is 2.5; it must be a whole number from 1"),
        (lambda: SumoParallelEnv(0), "num_workers is 0"),
        (lambda: SumoParallelEnv(2, seed=1.5), "seed is 1.5"),
    ],
)
def test_constructors_refuse(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(IzooError, match=message):
        make()


def test_a_refused_call_leaves_the_environment_as_it_was() -> None:
    env = EcoDrivingEnv(crossing(), config=short(), seed=4)
    try:
        for seed in ("a", 1.5, -1):
            with pytest.raises(IzooError, match="seed is"):
                env.set_seed(seed)
        for episode in (-1, 1.5, [1, 2], True):
            with pytest.raises(IzooError, match=r"reset\(episode="):
                env.reset(episode=episode)
        for wrong in ({"context": "crossing"}, {"seed": -3}, {"seed": "a"}, {"lap": 2}):
            with pytest.raises(IzooError):
                env.reset(**wrong)
        assert env.reset()["context", "episode"].item() == 0
        assert env.schedule.seed == 4  # type: ignore[attr-defined]
    finally:
        env.close()


def moved(env: EcoDrivingBase) -> list[float]:
    """Steps that every environment has taken since its episode began."""
    return env.frames["episode_metrics"][:, EPISODE_METRIC["steps"]].tolist()


def wait_for_the_end(env: EcoDrivingBase, state: TensorDictBase) -> TensorDictBase:
    """Play on until the first environment's episode has ended, and the second's has not."""
    state = env.reset(state.set("_reset", torch.tensor([[False], [True]])))
    while not state["done"].any():
        state = env.step(steer(state))["next"]
    assert state["done"].flatten().tolist() == [True, False]
    return state


REFUSED: dict[str, Callable[[EcoDrivingBase, TensorDictBase], TensorDictBase]] = {
    "one has ended": wait_for_the_end,
    "an action too many": lambda env, state: state.set(("agents", "action"), torch.zeros(2, 64, 2)),
    "no action": lambda env, state: state.exclude(("agents", "action")),
    "whole numbers": lambda env, state: state.set(("agents", "action"), torch.zeros(2, 64, 1, dtype=torch.int64)),
    "flags too many": lambda env, state: state.set(("agents", "defer"), torch.zeros(2, 64, 2, dtype=torch.bool)),
}


@pytest.mark.parametrize("env_class", [SumoParallelEnv, TwinEnv])
@pytest.mark.parametrize("why", REFUSED)
def test_a_step_that_is_refused_for_one_moves_nobody(why: str, env_class: Any) -> None:
    env = env_class(2, crossing(), config=short(horizon_s=20.0))
    try:
        _, state = play_on(env, 5, steer, env.reset())
        state = REFUSED[why](env, steer(state))
        if why == "one has ended":
            steer(state)
        before = moved(env)
        with pytest.raises(IzooError):
            env.step(state)
        assert moved(env) == before and env.backend.started
    finally:
        env.close()


def test_after_a_step_that_failed_for_one_all_begin_anew() -> None:
    """The others may have taken it."""
    env = SumoParallelEnv(2, crossing(), config=short())
    try:
        state = steer(env.reset())
        worker = env.backend._workers[1]
        worker.process.kill(), worker.process.wait()
        state = steer(env.step(state)["next"])
        env.frames["done"][1] = 0  # so that the new process is asked for a step of what it has not begun
        for match in ("no episode has begun", "came before reset", "came before reset"):
            with pytest.raises(IzooError, match=match):
                env.step(state)
        env.step(steer(env.reset()))
    finally:
        env.close()


def played(state: TensorDictBase) -> list[int]:
    """The numbers of the episodes, of every environment."""
    return state["context", "episode"].flatten().tolist()


@pytest.mark.parametrize("workers", [0, 2])
def test_what_an_environment_emitted_is_no_request(workers: int) -> None:
    """Handing the last state to ``reset``, as many loops do, begins the next episode."""
    env: Any = SumoParallelEnv(2, crossing(), config=short()) if workers else EcoDrivingEnv(crossing(), config=short())
    try:
        state = env.reset()
        numbers = [played(state), played(env.reset(state)), played(env.reset(play_on(env, 3, steer, state)[1]))]
        assert numbers == ([[0, 1], [2, 3], [4, 5]] if workers else [[0], [1], [2]])
        state = env.reset(state, episode=[1, 4] if workers else 1)
        assert played(state) == ([1, 4] if workers else [1])
        assert played(env.reset(state)) == ([6, 7] if workers else [3])
        if workers:
            assert played(env.reset(state.set("_reset", torch.tensor([[False], [True]])))) == [6, 9]
    finally:
        env.close()


@pytest.mark.parametrize("key", ["_reset", ("agents", "_reset")])
@pytest.mark.parametrize("env_class", [SumoParallelEnv, TwinEnv])
def test_a_reset_chooses_environments_at_the_root_or_by_all_of_their_agents(key: Any, env_class: Any) -> None:
    env = env_class(2, crossing(), config=short())
    try:
        state = play_on(env, 3, steer, env.reset())[1]
        rows = torch.tensor([[False], [True]])
        flags = rows if key == "_reset" else rows.expand(2, 64).clone()
        assert played(env.reset(state.clone().set(key, flags.clone()))) == [0, 3] and moved(env) == [3.0, 0.0]
        if key != "_reset":
            flags[0, 5] = True
            with pytest.raises(IzooError, match="some agents of an environment"):
                env.reset(state.clone().set(key, flags))
    finally:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a,b", "a${HOME}b", "a;b |&<'\"", "\u4ea4"])
def test_temporary_and_cache_folders_may_have_any_name(name: str, tmp_path: Path) -> None:
    """SUMO itself would take a comma for the end of a path, and replace variables."""
    folder = tmp_path / name
    folder.mkdir()
    program = "import torch; from izoo.envs import EcoDrivingEnv, EnvConfig; from tests.envs.worlds import crossing\n"
    program += "env = EcoDrivingEnv(crossing(), config=EnvConfig(horizon_s=40.0)); print(env.rollout(3).shape[0])"
    told = {**os.environ, "TMPDIR": str(folder), "IZOO_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, env=told)
    assert done.stdout == "3\n", done.stderr
    assert {path.name for path in folder.iterdir()} == {"cache"}


@pytest.mark.skipif(shutil.which("localedef") is None, reason="locales cannot be made here")
def test_a_decimal_comma_is_refused_where_sumo_would_read_it(tmp_path: Path) -> None:
    """Nets are built, and the twin is played, whatever the locale."""
    subprocess.run(["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")], check=True)
    program = """
import locale
from izoo.envs import EcoDrivingEnv
from izoo.errors import IzooError
from tests.envs.worlds import crossing, short
locale.setlocale(locale.LC_ALL, "de_DE.UTF-8")
EcoDrivingEnv(crossing(), config=short(), simulator="twin").reset()
env = EcoDrivingEnv(crossing(), config=short())
try:
    env.reset()
except IzooError as error:
    print(error)
locale.setlocale(locale.LC_NUMERIC, "C")
env.reset()
"""
    told = {**os.environ, "LOCPATH": str(tmp_path), "IZOO_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, env=told)
    assert done.returncode == 0 and "numbers have a decimal comma" in done.stdout, done.stderr


def test_a_path_that_the_locale_cannot_spell_is_named(tmp_path: Path) -> None:
    from izoo.envs.sumo.session import SumoSession, sumo_arguments

    path = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.net.xml")
    with pytest.raises(IzooError, match=r"cannot spell the path '.*/caf.udce9.net.xml'; set IZOO_CACHE_DIR and TMPDIR"):
        SumoSession().load(sumo_arguments(path, tmp_path / "a.rou.xml", 0, 0.5))


def test_a_second_thread_is_refused() -> None:
    """It would read the answers that the first one waits for."""
    env = SumoParallelEnv(2, crossing(), config=short())
    try:
        state = steer(env.reset())
        answers: list[Exception | None] = []
        asking, go_on = threading.Event(), threading.Event()
        real = env.backend.step

        def held(meanwhile: Any = None) -> Any:
            asking.set()
            go_on.wait(30)
            return real(meanwhile)

        env.backend.step = held  # type: ignore[method-assign]
        first = threading.Thread(target=env.step, args=(state.clone(),))
        first.start()
        assert asking.wait(30)
        for call in (lambda: env.step(state.clone()), env.reset):
            try:
                call()
                answers.append(None)
            except IzooError as error:
                answers.append(error)
        go_on.set()
        first.join(60)
        assert not first.is_alive()
        assert all("another thread" in str(answer) for answer in answers), answers
        env.backend.step = real  # type: ignore[method-assign]
        env.step(state)  # one after the other they may
        assert played(env.reset()) == [2, 3], "the refused reset has used up no episodes"
    finally:
        env.close()


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_reset_of_nobody_changes_nothing(simulator: str) -> None:
    env = EcoDrivingEnv(crossing(), config=short(), simulator=simulator)
    try:
        _, state = play_on(env, 3, steer, env.reset())
        after = env.reset(state.clone().set("_reset", torch.zeros(1, dtype=torch.bool)))
        assert after["metrics", "episode", "steps"].item() == 3 and played(after) == [0]
        assert torch.equal(after["agents", "observation"], state["agents", "observation"])
    finally:
        env.close()


def test_past_commands_are_not_kept() -> None:
    """Nor the graph that they come from."""
    env = EcoDrivingEnv(crossing(), config=short(), simulator="twin")
    try:
        weight = torch.nn.Parameter(torch.zeros(env.reader.action_shape))
        state = env.reset()
        for _ in range(3):
            state.set(("agents", "defer"), torch.zeros(weight.shape[:-1], requires_grad=True))
            state = env.step(state.set(("agents", "action"), weight * 2.0))["next"]
        assert not any(tensor.requires_grad for tensor in env.reader.tensors.values())
        assert not env.reader._action.requires_grad
    finally:
        env.close()


FORK = """
import os, sys
from izoo.envs import SumoParallelEnv
from tests.envs.worlds import crossing, play_on, short, steer
env = SumoParallelEnv(2, crossing(), config=short())
_, state = play_on(env, 3, steer, env.reset())
child = os.fork()
if child == 0:
    sys.exit(0)
assert os.waitpid(child, 0)[1] == 0
play_on(env, 3, steer, state)
assert env.restarts == 0, 'the forked process ended its parent\\'s workers'
env.close()
"""


@pytest.mark.slow
def test_a_forked_process_that_ends_leaves_its_parents_workers_alone() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


DOUBLES = """
import warnings
from torchrl.envs import ParallelEnv
from izoo.envs import EcoDrivingEnv, SumoParallelEnv, TwinEnv
from tests.envs.worlds import crossing, short
if __name__ == '__main__':
    makers = {makers}
    env = ParallelEnv(2, makers, mp_start_method='spawn')
    print(env.reset()['context', 'seed'].flatten().unique().numel())
    env.close()
"""
TOLD = "[lambda k=k: EcoDrivingEnv(crossing(), config=short(), worker=k, num_workers=2) for k in range(2)]"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("makers", "distinct"),
    [
        ("lambda: EcoDrivingEnv(crossing(), config=short())", 1),
        (TOLD, 2),
        ("lambda: TwinEnv(2, crossing(), config=short())", 2),
        ("[lambda k=k: TwinEnv(2, crossing(), config=short(), shard=k, num_shards=2) for k in range(2)]", 4),
    ],
)
def test_torchrls_own_workers_are_told_that_they_play_the_same(makers: str, distinct: int, tmp_path: Any) -> None:
    program = tmp_path / "program.py"
    program.write_text(DOUBLES.format(makers=makers))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=200, env=environment)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) == distinct
    told = "shard=k" in makers or "worker=k" in makers
    assert ("plays the same episodes" in done.stderr.replace("\n", " ")) == (not told)
