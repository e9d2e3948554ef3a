"""Workers that die, hang or meet a broken net; parents that end in every way; memory."""

from __future__ import annotations

import functools
import gc
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ObservationNorm, TransformedEnv

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, SumoParallelEnv
from izoo.envs.sumo import simulator
from izoo.envs.sumo.worker import POLL_S
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic, write_routes
from tests.envs.worlds import crossing, defer, digest, play, play_on, process_of, same, set_action, short, steer

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc and sends signals")


@dataclass(frozen=True)
class FixedSchedule:
    """Plays the given pairs of a context and a seed, again and again."""

    pairs: Sequence[tuple[Context, int]]

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.pairs[episode % len(self.pairs)]


@pytest.fixture
def pair() -> Iterator[SumoParallelEnv]:
    env = SumoParallelEnv(2, crossing(), config=short(watchdog_s=2.0), seed=6)
    yield env
    env.close()


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def wait_until_gone(pids: set[int], patience_s: float = 10.0) -> set[int]:
    end = time.monotonic() + patience_s
    while time.monotonic() < end and any(alive(pid) for pid in pids):
        time.sleep(0.05)
    return {pid for pid in pids if alive(pid)}


@functools.cache
def undisturbed(steps: int) -> TensorDict:
    """The first steps of the two workers of :func:`pair`, which nobody kills."""
    env = SumoParallelEnv(2, crossing(), config=short(), seed=6)
    try:
        return play(env, steps)
    finally:
        env.close()


@pytest.mark.parametrize("poll_s", [0.0, POLL_S])
def test_frames_do_not_depend_on_who_stays_awake(pair: SumoParallelEnv, poll_s: float) -> None:
    prepare, prepared = pair.reader.prepare, []
    pair.backend._poll_s = [poll_s, poll_s]
    pair.reader.prepare = lambda: prepared.append(prepare())
    played = play(pair, 101)
    assert [digest(row) for row in played] == [digest(row) for row in undisturbed(101)]
    assert bool(prepared) == (poll_s > 0.0)


# -- workers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "limit_s", "index"),
    [
        pytest.param(signal.SIGKILL, 1.0, 0, marks=pytest.mark.slow),
        pytest.param(signal.SIGSTOP, 4.0, 0, marks=pytest.mark.slow),
        (signal.SIGSTOP, 4.0, 1),
    ],
)
def test_a_lost_worker_costs_its_episode_alone(pair: SumoParallelEnv, number: int, limit_s: float, index: int) -> None:
    before, state = play_on(pair, 60, steer, pair.reset())
    lost, other = process_of(pair, index), 1 - index
    os.kill(lost, number)
    began = time.monotonic()
    frame = pair.step(steer(state.clone()))
    assert time.monotonic() - began < limit_s
    # The lost step: truncated, nothing terminated, nobody paid, the last observation once more.
    row = frame["next"][index]
    assert row["truncated"].item() and row["done"].item() and not row["terminated"].item()
    mask = state["agents", "mask"][index]
    assert mask.any() and torch.equal(row["agents", "mask"], mask)
    assert torch.equal(row["agents", "truncated"].squeeze(-1), mask)
    assert not row["agents", "terminated"].any() and not row["agents", "reward"].any()
    assert torch.equal(row["agents", "observation"], state["agents", "observation"][index])
    assert not frame["next"][other]["done"].item()
    assert pair.restarts == 1 and not alive(lost)
    for name, value in frame["next"].items(True, True):
        assert torch.isfinite(value.float()).all(), name
    # The run goes on: the lost worker with its next episode, the other as if nothing had been.
    state = pair.maybe_reset(frame["next"].exclude("reward", ("agents", "reward")))
    assert state["context", "episode"].flatten().tolist() == [[2, 1], [0, 3]][index]
    after, _ = play_on(pair, 40, steer, state)
    assert after["context", "episode"][index].unique().tolist() == [index + 2]
    assert not after["next", "done"][index].any()
    whole = torch.cat([before[other], frame[other].unsqueeze(0), after[other]], 0)
    assert digest(whole) == digest(undisturbed(101)[other])


def test_transforms_see_the_last_observation_of_a_lost_worker_once() -> None:
    base = SumoParallelEnv(2, crossing(), config=short(), seed=6)
    env = TransformedEnv(base, ObservationNorm(loc=1.0, scale=2.0, in_keys=[("agents", "observation")]))
    try:
        state = env.reset()
        for _ in range(40):
            state = env.step(set_action(state, torch.zeros(base.reader.action_shape)))["next"]
        os.kill(process_of(base, 0), signal.SIGKILL)
        after = env.step(set_action(state.clone(), torch.zeros(base.reader.action_shape)))["next"]
        assert after["truncated"].flatten().tolist() == [True, False]
        assert state["agents", "mask"][0].any()
        assert torch.equal(after["agents", "observation"][0], state["agents", "observation"][0])
    finally:
        env.close()


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C raises, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_in_a_step_leaves_no_answer_unread(pair: SumoParallelEnv) -> None:
    _, state = play_on(pair, 10, steer, pair.reset())
    stopped = process_of(pair, 0)
    os.kill(stopped, signal.SIGSTOP)
    threading.Timer(0.3, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        pair.step(steer(state.clone()))
    assert not alive(stopped)
    with pytest.raises(IzooError, match=r"before reset\(\)"):
        pair.step(steer(state.clone()))
    again = pair.reset(episode=[0, 1])
    played, _ = play_on(pair, 101, steer, again)
    assert [digest(row) for row in played] == [digest(row) for row in undisturbed(101)]


def run_out_of_memory() -> None:
    raise RuntimeError("no memory")


@pytest.mark.slow
def test_a_failure_of_the_parent_leaves_no_answer_unread(
    pair: SumoParallelEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks like one of a worker's, but no answer was read."""
    _, state = play_on(pair, 10, steer, pair.reset())
    pair.backend._poll_s = [POLL_S, POLL_S]
    stopped = process_of(pair, 0)
    os.kill(stopped, signal.SIGSTOP)
    with monkeypatch.context() as patch:
        patch.setattr(pair.reader, "prepare", run_out_of_memory)
        with pytest.raises(RuntimeError, match="no memory"):
            pair.step(steer(state.clone()))
    assert not alive(stopped)
    again = pair.reset(episode=[0, 1])
    played, _ = play_on(pair, 101, steer, again)
    assert [digest(row) for row in played] == [digest(row) for row in undisturbed(101)]


def test_automatic_reset_after_a_lost_worker(pair: SumoParallelEnv) -> None:
    """The environment's own stepping begins the lost worker's next episode, and keeps the other's state."""
    _, state = play_on(pair, 30, steer, pair.reset())
    os.kill(process_of(pair, 0), signal.SIGKILL)
    frame, after = pair.step_and_maybe_reset(steer(state))
    assert frame["next", "truncated"].flatten().tolist() == [True, False]
    assert after["context", "episode"].flatten().tolist() == [2, 1]
    assert after["metrics", "episode", "steps"].flatten().tolist() == [0.0, 31.0]
    assert same(after[1], frame["next"][1].exclude("reward", ("agents", "reward")))
    assert not after["done"].any()


def test_killed_while_it_begins_an_episode(pair: SumoParallelEnv) -> None:
    pair.reset()
    os.kill(process_of(pair, 1), signal.SIGKILL)
    state = pair.reset()
    assert state["context", "episode"].flatten().tolist() == [2, 3] and pair.restarts == 1
    play_on(pair, 5, steer, state)


def survive(kills: int, seed: int) -> None:
    """Kill or stop workers at random moments of one collection; whole episodes are as in an undisturbed run."""
    chance = random.Random(seed)
    config = short(horizon_s=20.0, watchdog_s=2.0)
    env = SumoParallelEnv(2, crossing(), config=config, seed=6)
    done: dict[int, str] = {}
    lost = 0
    try:
        state = env.reset()
        pieces: list[list[TensorDict]] = [[], []]
        wait = 5
        while lost < kills or len(done) < 4:
            wait -= 1
            if wait <= 0 and lost < kills:
                os.kill(process_of(env, chance.randrange(2)), signal.SIGKILL)
                lost += 1
                wait = chance.randrange(1, 60)
            frame, state = env.step_and_maybe_reset(steer(state))
            for index in range(2):
                pieces[index].append(frame[index])
                if frame["next", "truncated"][index].item():
                    whole = len(pieces[index]) == config.control_steps
                    assert frame["next", "metrics", "episode", "steps"][index].item() <= config.control_steps
                    if whole and frame["next", "metrics", "episode", "steps"][index].item() == config.control_steps:
                        done[int(frame["context", "episode"][index])] = digest(torch.stack(pieces[index]))
                    pieces[index] = []
        assert env.restarts == lost
    finally:
        env.close()
    single = SumoParallelEnv(1, crossing(), config=config, seed=6)
    try:
        for number in sorted(done)[:6]:
            start = single.reset(episode=number)
            assert digest(play(single, config.control_steps, steer, start)[0]) == done[number]
    finally:
        single.close()


@pytest.mark.slow
def test_fifty_random_kills_lose_only_the_killed_episodes() -> None:
    survive(kills=50, seed=2)


@pytest.fixture
def broken(tmp_path: Path) -> Context:
    """A context whose net is read well, and refused by SUMO."""
    net = tmp_path / "net.net.xml"
    text = Path(build_net(crossing().intersection)).read_text()
    assert 'id="A2TL_0"' in text
    net.write_text(text.replace("<junction ", '<junction id="TL" type="nonsense" x="a"/><junction ', 1))
    from dataclasses import replace

    return crossing().replace(intersection=replace(crossing().intersection, name="broken/1", net_path=str(net)))


def test_a_bad_net_is_an_error_with_its_name(broken: Context) -> None:
    """The others are unharmed, and the environment goes on with the next episodes."""
    good = crossing()
    env = SumoParallelEnv(
        2, FixedSchedule([(good, 1), (good, 2), (broken, 3), (good, 4), (good, 5), (good, 6)]), config=short()
    )
    try:
        play(env, 5)
        pids = {process_of(env, 0), process_of(env, 1)}
        with pytest.raises(IzooError, match=r"context broken/1: SUMO could not load.*junction 'TL'"):
            env.reset()
        state = env.reset()
        assert state["context", "episode"].flatten().tolist() == [4, 5]
        assert {process_of(env, 0), process_of(env, 1)} == pids and env.restarts == 0
        frames, _ = play_on(env, 5, steer, state)
        assert frames["metrics", "episode", "steps"][:, -1].flatten().tolist() == [4.0, 4.0]
    finally:
        env.close()


def test_a_bad_net_in_the_own_process(broken: Context) -> None:
    env = EcoDrivingEnv(FixedSchedule([(broken, 1), (crossing(), 2)]), config=short())
    try:
        with pytest.raises(IzooError, match=r"context broken/1: SUMO could not load.*junction 'TL'"):
            env.reset()
        state = env.reset()
        assert state["context", "episode"].item() == 1
        play(env, 5, steer, state)
    finally:
        env.close()


# -- the end -----------------------------------------------------------------------------------------------------------


def shared_segments(pids: set[int]) -> set[Path]:
    """Return the named shared memory that processes map."""
    lines = [line for pid in pids for line in Path(f"/proc/{pid}/maps").read_text().splitlines()]
    return {Path(line.split()[-1]) for line in lines if line.split()[-1].startswith("/dev/shm/")}


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def write_long_routes(traffic: Traffic, road: RoadNet, path: Path) -> None:
    """Write 2 MiB of nothing, more than SUMO reads at once, before the vehicles that depart after 200 s."""
    write_routes(traffic, road, path)
    lines = path.read_text().splitlines(keepends=True)
    departs = [float(found[1]) if (found := re.search(r'depart="([\d.]+)"', line)) else -1.0 for line in lines]
    late = next(k for k, depart in enumerate(departs) if depart > 200.0)
    path.write_text("".join([*lines[:late], " " * 2**21, "\n", *lines[late:]]))


def test_episodes_keep_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "write_routes", write_long_routes)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    env = EcoDrivingEnv(FixedSchedule([(crossing(), 1)]), config=short(horizon_s=420.0, step_s=1.0))
    try:
        state = env.reset()
        assert list(tmp_path.iterdir()) == []
        # SUMO reads 200 s of traffic at a time, the rest here from a file that has no name any more.
        assert play(env, 400, defer, state)[-1]["vehicles", "present"].any()
    finally:
        env.close()


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
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell are born deaf to it
from tests.envs.worlds import crossing, play, short
from izoo.envs import SumoParallelEnv
env = SumoParallelEnv(2, crossing(), config=short(horizon_s=500.0))
env.reset()
print(*(worker.process.pid for worker in env.backend._workers), flush=True)
{ending}
"""
ENDINGS = {
    "killed in the middle of steps": ("play(env, 10**6)", signal.SIGKILL),
    "killed while idle": ("time.sleep(100)", signal.SIGKILL),
    "Ctrl-C": ("play(env, 10**6)", signal.SIGINT),
    "terminated": ("play(env, 10**6)", signal.SIGTERM),
    "an exception": ("raise RuntimeError('on purpose')", None),
    "falling off the end": ("", None),
}


@pytest.mark.parametrize(
    "ending",
    [pytest.param(name, marks=() if name == "killed in the middle of steps" else pytest.mark.slow) for name in ENDINGS],
)
def test_no_orphans_and_nothing_left(ending: str, tmp_path: Path) -> None:
    code, number = ENDINGS[ending]
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT.format(ending=code)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        text=True,
    )
    try:
        assert parent.stdout is not None
        pids = {int(word) for word in parent.stdout.readline().split()}
        assert len(pids) == 2
        # Whatever has no name in the file system ends with the processes.
        segments = shared_segments({*pids, parent.pid} if number is not None else set())
        if number is not None:
            time.sleep(0.3)
            assert all(alive(pid) for pid in pids)
            parent.send_signal(number)
        parent.wait(20)
    finally:
        parent.kill()
        parent.communicate()
    assert not wait_until_gone(pids), "workers have outlived their parent"
    assert not any(path.exists() for path in segments)
    assert list(tmp_path.iterdir()) == []
