"""Episodes that are prepared ahead are the same by a thread or by processes."""

import contextlib
import functools
from concurrent.futures import wait

import pytest

from izoo.envs import EnvConfig
from izoo.envs.backend import Play
from izoo.envs.twin.runtime import preparers
from izoo.envs.twin.runtime.layout import WORKING
from izoo.envs.twin.runtime.preparers import Preparers
from izoo.envs.twin.runtime.scratch import Desk
from tests.envs.worlds import crossing, short


def play(number: int) -> Play:
    return Play(crossing(), number, number)


def prepared(processes: int, config: EnvConfig, count: int = 3) -> list[preparers.Prepared]:
    with contextlib.closing(Preparers(config, processes)) as ahead:
        futures = [ahead.submit(functools.partial(play, number)) for number in range(count)]
        wait(futures)
    return [future.result() for future in futures]


@pytest.mark.slow
def test_processes_prepare_what_a_thread_does() -> None:
    config = short()
    for one, other in zip(prepared(0, config), prepared(2, config), strict=True):
        assert one.play == other.play and one.road.sha256 == other.road.sha256
        other.driving.move_to(Desk())
        for name, array in one.driving.state._asdict().items():
            own = getattr(other.driving.state, name)
            assert own.shape == array.shape
            assert name in WORKING or own.tobytes() == array.tobytes(), name
        assert one.driving.addresses != other.driving.addresses
