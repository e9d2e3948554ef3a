"""A net written by hand, vehicles placed on it, and environments on the twin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from izoo.envs import TwinEnv
from izoo.networks.road import RoadNet, read_road
from tests.envs.placed import Scene
from tests.envs.worlds import crossing, short
from tests.networks.handmade import write_handmade

MakeTwin = Callable[..., TwinEnv]


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> RoadNet:
    return read_road(write_handmade(tmp_path_factory.mktemp("net")))


@pytest.fixture
def scene(road: RoadNet) -> Scene:
    return Scene(road)


@pytest.fixture
def make_twin() -> Iterator[MakeTwin]:
    """Build environments on the twin and close them in the end."""
    made: list[TwinEnv] = []

    def build(num_envs: int = 2, contexts: Any = None, **options: Any) -> TwinEnv:
        contexts = crossing() if contexts is None else contexts
        env = TwinEnv(num_envs, contexts, **({"config": short(), "threads": 1} | options))
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()
