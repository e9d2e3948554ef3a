"""Memory of long collections, and more workers than cores."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Any

import pytest

from izoo.envs import EnvConfig, SumoParallelEnv
from tests.envs.worlds import crossing, defer, play, play_on, process_of, short

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")


def resident_kib(pid: int) -> int:
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1])


def memory_growth(episodes: int, warm: int, config: EnvConfig, **changes: Any) -> float:
    """Resident memory of one worker after ``episodes`` over that after ``warm``."""
    with contextlib.closing(SumoParallelEnv(1, crossing(**changes), config=config)) as env:
        state, begin = env.reset(), 0
        for number in range(episodes):
            _, state = play_on(env, config.control_steps, defer, state)
            if number + 1 == warm:
                begin = resident_kib(process_of(env, 0))
        assert env.restarts == 0
        return resident_kib(process_of(env, 0)) / begin


@pytest.mark.slow
def test_memory_stays_over_episodes_of_some_length() -> None:
    assert memory_growth(40, 15, EnvConfig(horizon_s=200.0)) < 1.03


@pytest.mark.slow
def test_sixteen_workers() -> None:
    with contextlib.closing(SumoParallelEnv(16, crossing(), config=short())) as env:
        frames = play(env, env.config.control_steps + 5)
        assert frames.shape[0] == 16 and env.restarts == 0
        assert frames["context", "episode"][:, 0].flatten().tolist() == list(range(16))
