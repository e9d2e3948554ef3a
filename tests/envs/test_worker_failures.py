"""Worker processes that die, hang or meet a broken net, and parents that end in every way."""

import contextlib
import dataclasses
import functools
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig, SumoParallelEnv
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from tests.envs.worlds import crossing, defer, digest, play, play_on, process_of, short, steer

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc and sends signals")


WATCHDOG_S = 4.0


@pytest.fixture
def pair() -> Iterator[SumoParallelEnv]:
    with contextlib.closing(SumoParallelEnv(2, crossing(), config=short(watchdog_s=WATCHDOG_S), seed=6)) as env:
        yield env


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_until_gone(pids: set[int], timeout_s: float = 10.0) -> set[int]:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end and any(alive(pid) for pid in pids):
        time.sleep(0.05)
    return {pid for pid in pids if alive(pid)}


@functools.cache
def undisturbed(steps: int) -> TensorDict:
    """The first steps of the two environments of :func:`pair`."""
    with contextlib.closing(SumoParallelEnv(2, crossing(), config=short(), seed=6)) as env:
        return play(env, steps)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "limit_s", "index"), [(signal.SIGKILL, 5.0, 0), (signal.SIGSTOP, WATCHDOG_S + 10.0, 1)]
)
def test_a_lost_worker_costs_only_its_episode(pair: SumoParallelEnv, number: int, limit_s: float, index: int) -> None:
    before, state = play_on(pair, 60, steer, pair.reset())
    lost, other = process_of(pair, index), 1 - index
    os.kill(lost, number)
    began = time.monotonic()
    frame = pair.step(steer(state.clone()))
    assert time.monotonic() - began < limit_s
    # The lost step: truncated, nothing terminated, no reward, the last observation once more.
    row = frame["next"][index]
    assert row["truncated"].item() and row["done"].item() and not row["terminated"].item()
    mask = state["agents", "mask"][index]
    assert mask.any() and torch.equal(row["agents", "mask"], mask)
    assert torch.equal(row["agents", "truncated"].squeeze(-1), mask)
    assert not row["agents", "terminated"].any() and not row["agents", "reward"].any()
    assert torch.equal(row["agents", "observation"], state["agents", "observation"][index])
    assert not frame["next"][other]["done"].item()
    assert pair.restarts == 1 and not alive(lost)
    assert all(torch.isfinite(value.float()).all() for value in frame["next"].values(True, True))
    # The run goes on: the lost worker with its next episode, the other undisturbed.
    state = pair.maybe_reset(frame["next"].exclude("reward", ("agents", "reward")))
    assert state["context", "episode"].flatten().tolist() == [[2, 1], [0, 3]][index]
    after, _ = play_on(pair, 40, steer, state)
    assert after["context", "episode"][index].unique().tolist() == [index + 2]
    assert not after["next", "done"][index].any()
    whole = torch.cat([before[other], frame[other].unsqueeze(0), after[other]], 0)
    assert digest(whole) == digest(undisturbed(101)[other])


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_after_ctrl_c_in_a_step_the_next_reset_works(pair: SumoParallelEnv) -> None:
    """No answer of a worker is left unread."""
    _, state = play_on(pair, 10, steer, pair.reset())
    stopped = process_of(pair, 0)
    os.kill(stopped, signal.SIGSTOP)
    threading.Timer(0.3, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        pair.step(steer(state.clone()))
    assert not alive(stopped)
    with pytest.raises(IzooError, match=r"before reset\(\)"):
        pair.step(steer(state.clone()))
    played, _ = play_on(pair, 101, steer, pair.reset(episode=[0, 1]))
    assert [digest(row) for row in played] == [digest(row) for row in undisturbed(101)]


def test_a_worker_killed_while_it_begins_an_episode_is_replaced(pair: SumoParallelEnv) -> None:
    pair.reset()
    os.kill(process_of(pair, 1), signal.SIGKILL)
    state = pair.reset()
    assert state["context", "episode"].flatten().tolist() == [2, 3] and pair.restarts == 1
    play_on(pair, 5, steer, state)


@pytest.fixture
def broken(tmp_path: Path) -> Context:
    """A context whose net can be read, but not by SUMO."""
    net = tmp_path / "net.net.xml"
    text = build_net(crossing().intersection).read_text()
    net.write_text(text.replace("<junction ", '<junction id="TL" type="nonsense" x="a"/><junction ', 1))
    spec = dataclasses.replace(crossing().intersection, name="broken/1", net_path=str(net))
    return crossing().replace(intersection=spec)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_bad_net_is_named_and_the_next_episodes_play(broken: Context, workers: int) -> None:
    bad = 0 if workers == 1 else 2
    schedule: Callable[[int], Any] = lambda number: (broken if number == bad else crossing(), number)  # noqa: E731
    make = EcoDrivingEnv if workers == 1 else functools.partial(SumoParallelEnv, 2)
    with contextlib.closing(make(contexts=schedule, config=short())) as env:
        if workers == 2:
            env.reset()
        pids = {process_of(env, k) for k in range(2)} if workers == 2 else set()
        with pytest.raises(IzooError, match=r"context broken/1: SUMO could not load.*junction 'TL'"):
            env.reset()
        state = env.reset()
        assert state["context", "episode"].flatten().tolist() == ([4, 5] if workers == 2 else [1])
        assert workers == 1 or ({process_of(env, k) for k in range(2)} == pids and env.restarts == 0)
        frames, _ = play_on(env, 5, steer, state)
        assert (frames["metrics", "episode", "steps"].view(workers, -1)[:, -1] == 4.0).all()


@pytest.mark.slow
def test_memory_of_a_worker_does_not_grow() -> None:
    config, resident_kib = EnvConfig(horizon_s=200.0), []
    with contextlib.closing(SumoParallelEnv(1, crossing(), config=config)) as env:
        state = env.reset()
        for _ in range(40):
            _, state = play_on(env, config.control_steps, defer, state)
            lines = Path(f"/proc/{process_of(env, 0)}/status").read_text().splitlines()
            resident_kib += [int(line.split()[1]) for line in lines if line.startswith("VmRSS")]
        assert env.restarts == 0
    assert resident_kib[-1] / resident_kib[14] < 1.03


def shared_segments(pids: set[int]) -> set[Path]:
    """The named shared memory that processes map."""
    lines = [line for pid in pids for line in Path(f"/proc/{pid}/maps").read_text().splitlines()]
    return {Path(line.split()[-1]) for line in lines if line.split()[-1].startswith("/dev/shm/")}


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_close_leaves_nothing() -> None:
    descriptors = open_descriptors()
    env = SumoParallelEnv(2, crossing(), config=short())
    env.reset()
    pids = {process_of(env, 0), process_of(env, 1)}
    assert not shared_segments(pids)
    env.close()
    env.close()
    with pytest.raises(IzooError, match="is closed; make another one"):
        env.reset()
    assert not wait_until_gone(pids)
    del env
    gc.collect()
    assert open_descriptors() <= descriptors


PARENT = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
from tests.envs.worlds import crossing, play, short
from izoo.envs import SumoParallelEnv
env = SumoParallelEnv(2, crossing(), config=short(horizon_s=500.0))
env.reset()
print(*(worker.process.pid for worker in env.backend._workers), flush=True)
{ending}
"""
ENDINGS = {
    "killed": ("play(env, 10**6)", signal.SIGKILL),
    "Ctrl-C": ("play(env, 10**6)", signal.SIGINT),
    "terminated": ("play(env, 10**6)", signal.SIGTERM),
    "an exception": ("raise RuntimeError('on purpose')", None),
}


@pytest.mark.slow
@pytest.mark.parametrize("ending", list(ENDINGS))
def test_workers_end_with_their_parent(ending: str, tmp_path: Path) -> None:
    """And nothing is left in the file system."""
    code, number = ENDINGS[ending]
    command = [sys.executable, "-c", PARENT.format(ending=code)]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, text=True)
    try:
        assert parent.stdout is not None
        pids = {int(word) for word in parent.stdout.readline().split()}
        assert len(pids) == 2
        if number is not None:
            time.sleep(0.3)
            assert all(alive(pid) for pid in pids)
            parent.send_signal(number)
        parent.wait(20)
    finally:
        parent.kill()
        parent.communicate()
    assert not wait_until_gone(pids), "workers have outlived their parent"
    assert list(tmp_path.iterdir()) == []
