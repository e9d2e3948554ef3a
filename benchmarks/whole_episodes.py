"""Whole episodes on the twin, many side by side, and what their scored approaches add up to."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.scripted import make_driver
from izoo.contexts.context import Context
from izoo.envs import EnvConfig, TwinEnv
from izoo.evaluation.table import scored_approaches
from izoo.metrics.benefit import BURNED

Play = tuple[Context, int]
"""A context and an episode seed."""
Driver = Callable[[TensorDictBase], TensorDictBase]
Sums = dict[str, np.ndarray]
WHOLE_DEMAND = (
    "CO2 of the whole demand up to the stop line, also of those who have not crossed or are held up outside, per "
    "vehicle that crosses; where nobody does, as if one had."
)
"""What the figures of whole episodes are of, for their readers."""


def scripted(name: str, env: EnvConfig) -> Callable[[TwinEnv], Driver]:
    """Return what makes a scripted driver for a world."""
    return lambda world: make_driver(name, env)


def played(plays: Sequence[Play], env: EnvConfig, threads: int | None, make: Callable[[TwinEnv], Driver]) -> Sums:
    """Play whole episodes, and return sums of each over its scored approaches, ``[n]``, by name.

    ``demand_emission_g`` is the CO2 of all who came to cross (:data:`izoo.metrics.benefit.FORMS`), ``crossed`` and
    ``waiting`` are vehicles, and ``lanes`` is the largest number of lanes.

    Args:
        plays: ``n`` contexts and seeds.
        env: the environment.
        threads: of the twin; ``None``: one per core.
        make: makes what drives, once the episodes have begun; a policy acts without exploring.
    """
    world = TwinEnv(
        len(plays),
        lambda number: plays[number % len(plays)],
        config=env,
        threads=threads,
        surrogate="compiled",
        shard=0,
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
    parts = {"demand_emission_g": BURNED["demand_"], "crossed": ("crossed",), "waiting": ("waiting",)}
    sums = {
        name: np.array(
            [sum(float(approaches.get(column)[k, legs].sum()) for column in columns) for k, legs in enumerate(chosen)]
        )
        for name, columns in parts.items()
    }
    world.close()
    sums["lanes"] = np.array([int(max(road.lane_count[legs])) for road, legs in zip(roads, chosen, strict=True)])
    return sums


def per_vehicle_g(demand_emission_g: ArrayLike, crossed: ArrayLike) -> NDArray[np.float64]:
    """Return the CO2 of the whole demand per vehicle that crosses, in g; as if one had, where nobody does.

    Args:
        demand_emission_g, crossed: of any shape, as :func:`played` returns them.
    """
    return np.asarray(demand_emission_g, float) / np.maximum(np.asarray(crossed, float), 1.0)
