"""The nets of environments that begin together are built in one call of netconvert."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import SumoParallelEnv
from izoo.errors import IzooError
from izoo.files import CACHE_ENV
from izoo.networks.net import netconvert
from tests.envs.conftest import MakeTwin
from tests.envs.worlds import crossing, short

GOOD = [crossing(lane_length_m=150.0 + number) for number in range(7)]
BAD = crossing(lane_length_m=30.0, lane_count=4, phase_count=2)


@pytest.fixture(autouse=True)
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What netconvert is called for, in this process and with an empty cache."""
    monkeypatch.setenv(CACHE_ENV, str(tmp_path))
    made: list[str] = []
    run = netconvert._run
    monkeypatch.setattr(netconvert, "_run", lambda name, *rest: made.append(name) or run(name, *rest))
    return made


def test_the_twin_builds_the_nets_of_all_next_episodes_in_one_call(make_twin: MakeTwin, calls: list[str]) -> None:
    env = make_twin(3, RoundRobinSchedule(GOOD[:6]), config=short())
    env.reset()
    assert calls[0] == "1 of 3"
    env.backend._preparer.submit(lambda: None).result()
    # The first that is to come may be begun before the others wait.
    assert 2 <= len(calls) <= 3
    calls.clear()
    env.reset()
    assert calls == []


def test_a_context_without_a_net_raises_when_it_is_played(make_twin: MakeTwin) -> None:
    env = make_twin(2, RoundRobinSchedule([*GOOD[:2], BAD, *GOOD[2:]]), config=short())
    env.reset()
    with pytest.raises(IzooError, match=f"intersection {BAD.intersection.name}: leg A is too short"):
        env.reset()
    env.reset()
    assert [play.context for play in env.backend.plays()] == GOOD[3:5]


def test_nets_are_built_in_one_call_for_all_workers(calls: list[str]) -> None:
    with contextlib.closing(SumoParallelEnv(2, RoundRobinSchedule([*GOOD[:2], BAD, GOOD[2]]), config=short())) as env:
        env.reset()
        assert calls == ["1 of 2"]
        with pytest.raises(IzooError, match=f"intersection {BAD.intersection.name}: leg A is too short"):
            env.reset()
        env.reset()
