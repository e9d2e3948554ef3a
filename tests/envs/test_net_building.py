"""The nets of environments that begin together are built in one call of netconvert."""

from pathlib import Path

import pytest

from izoo.contexts.source import RoundRobinSchedule
from izoo.envs import SIMULATORS
from izoo.errors import IzooError
from izoo.files import CACHE_ENV
from tests.envs.conftest import Make
from tests.envs.worlds import crossing, short

GOOD = [crossing(lane_length_m=150.0 + number) for number in range(5)]
BAD = crossing(lane_length_m=30.0, lane_count=4, phase_count=2)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_nets_are_built_in_one_call_and_a_bad_one_raises_when_it_is_played(
    make: Make, calls: list[str], simulator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_ENV, str(tmp_path))
    env = make(simulator, 2, RoundRobinSchedule([*GOOD[:2], BAD, *GOOD[2:]]), config=short())
    env.reset()
    assert calls[0] == "1 of 2"
    with pytest.raises(IzooError, match=f"intersection {BAD.intersection.name}: leg A is too short"):
        env.reset()
    assert env.reset()["context", "episode"].flatten().tolist() == [4, 5]
