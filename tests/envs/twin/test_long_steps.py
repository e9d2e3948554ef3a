"""Steps of 1 s on short approaches: with commands or without, the twin drops no vehicle that SUMO keeps."""

from __future__ import annotations

import contextlib
import dataclasses

import pytest
import torch

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig
from tests.envs.worlds import Driver, at_random, crossing, defer, set_action

CONFIG = EnvConfig(horizon_s=120.0, warmup_s=10.0, step_s=1.0, num_vehicles=128, emit=("metrics",))
LARGEST_DIFFERENCE = 0.1


def short_approaches(length_m: float, lanes: int, source_m: float) -> Context:
    context = crossing(lane_count=lanes, lane_length_m=max(length_m, 60.0), adoption=1.0)
    spec = context.intersection
    legs = tuple(
        dataclasses.replace(leg, approach=dataclasses.replace(leg.approach, length_m=length_m)) if leg.approach else leg
        for leg in spec.legs
    )
    ghosts = dataclasses.replace(spec.ghosts, straight_source_length_m=source_m, turning_source_length_m=source_m)
    return context.replace(intersection=dataclasses.replace(spec, name="short", source="osm", legs=legs, ghosts=ghosts))


def full_speed() -> Driver:
    return lambda state: set_action(state, torch.full((*state["agents", "mask"].shape, 1), 2.6))


@pytest.mark.parametrize(
    ("length_m", "lanes", "source_m"), [(25.0, 1, 25.0), (25.0, 2, 10.0), (25.0, 4, 25.0), (60.0, 2, 60.0)]
)
@pytest.mark.parametrize("drive", [lambda: at_random(3), full_speed, lambda: defer], ids=["random", "full", "human"])
def test_nobody_is_dropped_and_jams_are_alike(length_m: float, lanes: int, source_m: float, drive) -> None:  # type: ignore[no-untyped-def]
    context, sums = short_approaches(length_m, lanes, source_m), {}
    for simulator in ("sumo", "twin"):
        with contextlib.closing(EcoDrivingEnv(context, config=CONFIG, simulator=simulator)) as env:
            state, act = env.reset(context=context, seed=4), drive()
            while not state["done"].item():
                state = env.step_lean(act(state))
            approach = state["metrics", "approach"]
            sums[simulator] = {name: float(approach[name].sum()) for name in ("dropped", "entered", "waiting")}
    assert sums["sumo"]["dropped"] == sums["twin"]["dropped"] == 0.0
    for name in ("entered", "waiting"):
        assert abs(sums["sumo"][name] - sums["twin"][name]) <= LARGEST_DIFFERENCE * sums["sumo"]["entered"], name
