"""Vehicles placed on the hand-written net, and environments that are closed after the test."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from izoo.envs import EcoDrivingEnv, SumoParallelEnv, TwinEnv
from izoo.networks.road import RoadNet
from tests.envs.placed import Scene
from tests.envs.worlds import crossing, short

Make = Callable[..., Any]
MakeTwin = Callable[..., TwinEnv]


@pytest.fixture
def scene(road: RoadNet) -> Scene:
    return Scene(road)


@pytest.fixture
def make() -> Iterator[Make]:
    """Build ``make(simulator, num_envs, contexts, **options)``; without ``num_envs`` a single environment."""
    with contextlib.ExitStack() as stack:

        def build(simulator: str = "sumo", num_envs: int | None = None, contexts: Any = None, **options: Any) -> Any:
            options = {"contexts": crossing() if contexts is None else contexts, "config": short(), **options}
            if num_envs is None:
                env: Any = EcoDrivingEnv(simulator=simulator, **options)
            elif simulator == "twin":
                env = TwinEnv(num_envs, **{"threads": 1, **options})
            else:
                env = SumoParallelEnv(num_envs, **options)
            return stack.enter_context(contextlib.closing(env))

        yield build


@pytest.fixture
def make_twin(make: Make) -> MakeTwin:
    """Build several environments on the twin: ``make_twin(num_envs, contexts, **options)``."""
    return lambda num_envs=2, contexts=None, **options: make("twin", num_envs, contexts, **options)
