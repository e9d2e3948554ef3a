"""Episodes that are prepared ahead, by a thread or by processes, are the same, and so are their failures."""

import contextlib
import dataclasses
import functools
from concurrent.futures import wait

import pytest

from izoo.envs import EnvConfig
from izoo.envs.backend import Play
from izoo.envs.twin.runtime import preparers
from izoo.envs.twin.runtime.layout import WORKING
from izoo.envs.twin.runtime.preparers import Preparers
from izoo.envs.twin.runtime.scratch import Desk
from izoo.errors import IzooError
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


@pytest.mark.slow
def test_failures_come_back_and_a_lost_process_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    helpers: list[preparers._Helper] = []
    begin = preparers._Helper.__init__

    def noted(helper: preparers._Helper, config: EnvConfig) -> None:
        begin(helper, config)
        helpers.append(helper)

    monkeypatch.setattr(preparers._Helper, "__init__", noted)
    wrong = dataclasses.replace(crossing().intersection, net_path="/nowhere.net.xml")
    lost = Play(dataclasses.replace(crossing(), intersection=wrong), 0, 0)
    with contextlib.closing(Preparers(short(), 1)) as ahead:
        with pytest.raises(IzooError, match="does not exist"):
            ahead.submit(lambda: lost).result(timeout=300)
        helpers[0].process.kill()
        assert ahead.submit(functools.partial(play, 1)).result(timeout=300).play.seed == 1
        assert ahead.submit(functools.partial(play, 2)).result(timeout=300).play.seed == 2
    assert len(helpers) == 2 and all(helper.process.poll() is not None for helper in helpers)
