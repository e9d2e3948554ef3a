"""Whole episodes on the twin, many side by side, and what their scored approaches add up to."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.scripted import make_driver
from izoo.contexts.context import Context
from izoo.envs import EnvConfig, TwinEnv
from izoo.evaluation.table import scored_approaches

Play = tuple[Context, int]
"""A context and an episode seed."""
Driver = Callable[[TensorDictBase], TensorDictBase]
Sums = dict[str, np.ndarray]


def scripted(name: str, env: EnvConfig) -> Callable[[TwinEnv], Driver]:
    """Return what makes a scripted driver for a world."""
    return lambda world: make_driver(name, env)


def played(plays: Sequence[Play], env: EnvConfig, threads: int | None, make: Callable[[TwinEnv], Driver]) -> Sums:
    """Play whole episodes, and return sums of each over its scored approaches, ``[n]``, by name.

    Args:
        plays: ``n`` contexts and seeds.
        env: the environment.
        threads: of the twin; ``None``: one per core.
        make: makes what drives, once the episodes have begun; a policy acts without exploring.
    """
    world = TwinEnv(
        len(plays), lambda number: plays[number % len(plays)], config=env, threads=threads, surrogate="compiled"
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = world.reset()
        act = make(world)
        while True:
            following = world.step_lean(act(state))
            if following.get("done").any():
                break
            state = following.exclude(("agents", "reward"))
    approaches = world.reader.metrics().get("approach")
    roads = [world.scene(k).road for k in range(len(plays))]
    chosen = [
        [road.approaches.index(leg) for leg in scored_approaches(context)]
        for road, (context, _) in zip(roads, plays, strict=True)
    ]
    sums = {
        name: np.array([float(approaches.get(name)[k, legs].sum()) for k, legs in enumerate(chosen)])
        for name in ("emission_g", "crossed", "waiting")
    }
    world.close()
    sums["lanes"] = np.array([int(max(road.lane_count[legs])) for road, legs in zip(roads, chosen, strict=True)])
    return sums
