"""Steps of 1 s on short approaches: with commands or without, the twin drops no vehicle and jams like SUMO."""

import contextlib
from collections.abc import Callable

import pytest

from izoo.envs import EcoDrivingEnv, EnvConfig
from tests.envs.worlds import Driver, at_random, constant, cramped, defer

CONFIG = EnvConfig(horizon_s=120.0, warmup_s=10.0, step_s=1.0, num_vehicles=128, emit=("metrics",))
LARGEST_DIFFERENCE = 0.1


@pytest.mark.parametrize("road", [(1, 25.0, 25.0), (2, 25.0, 10.0), (4, 25.0, 25.0), (2, 60.0, 60.0)])
@pytest.mark.parametrize("driver", [lambda: at_random(3), lambda: constant(2.6), lambda: defer])
def test_no_vehicle_is_dropped_and_jams_are_alike(road: tuple[int, float, float], driver: Callable[[], Driver]) -> None:
    context, sums = cramped(*road).replace(adoption=1.0), {}
    for simulator in ("sumo", "twin"):
        with contextlib.closing(EcoDrivingEnv(context, config=CONFIG, simulator=simulator)) as env:
            state, act = env.reset(context=context, seed=4), driver()
            while not state["done"].item():
                state = env.step_lean(act(state))
            approach = state["metrics", "approach"]
            sums[simulator] = {name: float(approach[name].sum()) for name in ("dropped", "entered", "waiting")}
    assert sums["sumo"]["dropped"] == sums["twin"]["dropped"] == 0.0
    for name in ("entered", "waiting"):
        assert abs(sums["sumo"][name] - sums["twin"][name]) <= LARGEST_DIFFERENCE * sums["sumo"]["entered"], name
