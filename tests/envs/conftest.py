"""A net written by hand, and vehicles placed on it."""

from __future__ import annotations

import pytest

from izoo.networks.road import RoadNet, read_road
from tests.envs.placed import Scene
from tests.networks.handmade import write_handmade


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> RoadNet:
    return read_road(write_handmade(tmp_path_factory.mktemp("net")))


@pytest.fixture
def scene(road: RoadNet) -> Scene:
    return Scene(road)
