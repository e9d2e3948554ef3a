"""Who stays awake for whom, and what is done meanwhile."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict

from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.sumo import worker
from izoo.envs.sumo.worker import _receive_polling, may_poll

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


@pytest.mark.parametrize(
    ("num_workers", "awake"),
    [(1, [True]), (3, [True] * 3), (4, [False, True, True, True]), (5, [False] * 5)],
)
def test_with_four_cores_processes_stay_awake_that_have_one(
    monkeypatch: pytest.MonkeyPatch, num_workers: int, awake: list[bool]
) -> None:
    monkeypatch.setattr(worker, "usable_cores", lambda: 4)
    assert [may_poll(index, num_workers) for index in range(num_workers)] == awake


def test_what_is_there_already_leaves_no_time_for_other_things(pair: Pair) -> None:
    ours, theirs = pair
    theirs.send(b"k")
    assert _receive_polling(ours, 1.0, lambda: pytest.fail("there was no time")) == b"k"


def test_other_things_are_done_once_while_waiting(pair: Pair) -> None:
    calls: list[int] = []
    assert _receive_polling(pair[0], 0.02, lambda: calls.append(1)) is None
    assert calls == [1]


def test_nobody_stays_awake_longer_than_was_said(pair: Pair) -> None:
    begin = time.perf_counter()
    assert _receive_polling(pair[0], 0.02) is None
    assert 0.02 <= time.perf_counter() - begin < 1.0


def test_frames_prepared_ahead_equal_the_others_and_own_their_memory() -> None:
    env = EcoDrivingEnv(config=EnvConfig(horizon_s=200.0))
    try:
        state = env.reset()
        state["agents", "action"] = torch.ones(*env.reader.action_shape)
        while not (plain := env.step_lean(state))["agents", "mask"].any():
            pass
        env.reader.prepare()
        _, *ahead = env.reader._prepared
        env.reader.prepare()
        prepared, onward = env.reader.read()
        assert prepared is ahead[0] and onward is ahead[1] and env.reader._prepared is None
        assert _same(plain, prepared) and _same(onward, prepared.exclude(("agents", "reward")))
        kept = prepared.clone()
        for _ in range(20):
            env.step_lean(state)
        assert _same(prepared, kept) and not _same(env.reader.read()[0], kept)
    finally:
        env.close()


def _same(one: TensorDict, other: TensorDict) -> bool:
    """Whether two TensorDicts have the same keys, shapes, types and values."""
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(
        one[key].dtype == other[key].dtype and torch.equal(one[key], other[key]) for key in keys
    )
