"""The state of an environment at one time, for pictures, recordings and views; only NumPy is needed here."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from izoo.contexts.context import Context
from izoo.networks.road import RoadNet


class Scene(NamedTuple):
    """The present state of an environment, whether or not it is emitted.

    Attributes:
        context: what is being played.
        road: its road net.
        time_s: simulated time, warm-up included.
        vehicles: the columns of ``("vehicles", name)``, ``[n]`` each: all vehicles in the region.
        colour: ``[P, Q]`` 0 green, 1 yellow, 2 red.
        approach_metrics: ``[P, M]`` sums so far, columns :data:`izoo.envs.mdp.metric_sums.APPROACH_METRICS`.
    """

    context: Context
    road: RoadNet
    time_s: float
    vehicles: dict[str, np.ndarray]
    colour: np.ndarray
    approach_metrics: np.ndarray
