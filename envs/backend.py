"""The interface of a simulator: it plays episodes and writes frames.

A :class:`Backend` owns the simulations of one or several environments and writes their frames
(:mod:`izoo.envs.mdp.frame`); the TorchRL environments (:mod:`izoo.envs.env`) and the other views drive it without
knowing which one it is. A backend reports the vehicles' positions to one :class:`~izoo.envs.mdp.episode.Episode` per
environment, which computes observations, rewards and metrics, or calls the compiled functions for many at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.frame import TEAM_REWARD
from izoo.envs.mdp.metric_sums import EPISODE_METRIC
from izoo.envs.mdp.snapshot import Scene
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import INSIDE, RoadNet, read_road
from izoo.traffic.sampling import Traffic, sample_traffic, with_late_vehicle

CLOSED = "this environment is closed; make another one."
_OF_SLOTS = (
    *("observation", "reward", "reward_vector", "mask", "decides"),
    *("agent_terminated", "agent_truncated", "agent_done"),
)


class Play(NamedTuple):
    """An episode to be played: its context, its seed, and its number in the schedule (-1: it has none)."""

    context: Context
    seed: int
    number: int


def episode_traffic(config: EnvConfig, context: Context, road: RoadNet, seed: int) -> Traffic:
    """Return the vehicles of an episode, the same for every simulator."""
    traffic = sample_traffic(context, road, seed, config.horizon_s)
    return with_late_vehicle(traffic, config.late_vehicle, config.step_s)


class Backend(Protocol):
    """The simulations behind ``N`` frames; environment ``k`` writes row ``k``.

    A simulator that plays one intersection at a time needs a :class:`~izoo.envs.simulation.Simulation` alone.

    Attributes:
        frames: the arrays ``[N, ...]`` (:func:`izoo.envs.mdp.frame.map_frames`).
    """

    frames: dict[str, np.ndarray]

    @property
    def started(self) -> bool:
        """Whether every environment has begun an episode."""

    @property
    def closed(self) -> bool:
        """Whether all simulations were ended permanently."""

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin episodes in some environments, play their warm-up, and write their first frames.

        Raises:
            IzooError: a context cannot be simulated, or its intersection does not fit the frame.
            RuntimeError: a simulation was lost repeatedly.
        """

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Take the commands from the frames, simulate one decision of every environment, and write the next frames.

        A decision is ``config.hold_steps`` steps, or fewer where the horizon or the end of the episode comes first or,
        with a ``config.decide`` other than ``step``, a CV of that environment must decide. Where episodes are played
        out, each environment ends by itself, and its frame stays as it is while others go on.

        Args:
            meanwhile: may be called once while a simulation is waited for.

        Returns:
            Environments whose simulation was lost and replaced in this step. They need :meth:`begin`; of their frames
            only the agents' observation, mask and vehicles are valid, and are those before the step.

        Raises:
            IzooError: all episodes have ended, or one where episodes end at their horizon.
        """

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment."""

    def close(self) -> None:
        """End all simulations."""


def clear_ended(config: EnvConfig, frames: dict[str, np.ndarray]) -> np.ndarray:
    """Return which environments have ended while others are played out, ``[N]`` bool; empty their slots.

    Raises:
        IzooError: all have ended, or one has where episodes end at their horizon.
    """
    ended: np.ndarray = frames["done"][:, 0] != 0
    if not ended.any():
        return ended
    if ended.all() or not config.drain_steps:
        steps = frames["episode_metrics"][np.flatnonzero(ended)[0], EPISODE_METRIC["steps"]]
        raise IzooError(f"the episode ended after {steps:.0f} steps; call reset() before the next step.")
    for name in (*_OF_SLOTS, TEAM_REWARD):
        frames[name][ended] = 0
    frames["number"][ended] = -1
    return ended


def scene_from_frame(config: EnvConfig, context: Context, frame: dict[str, np.ndarray]) -> Scene:
    """Return the present state of an environment from its frame, for simulations in other processes.

    Raises:
        IzooError: the frame holds no vehicles or no signals.
    """
    missing = {"vehicles", "signal"} - set(config.emit)
    if missing:
        raise IzooError(f"EnvConfig.emit lacks {', '.join(sorted(missing))}; the state cannot be read without.")
    road = read_road(build_net(context.intersection))
    flags = dict(zip(VEHICLE_FLAGS, frame["vehicle_flags"].T.astype(bool), strict=True))
    there = flags["present"]
    columns = dict(zip(VEHICLE_FLOATS, frame["vehicle_floats"].T, strict=True))
    columns |= zip(VEHICLE_INTS, frame["vehicle_ints"].T, strict=True)
    vehicles = {name: column[there] for name, column in (columns | flags).items()}
    p, q = road.movement_turn.shape
    steps = config.warmup_steps + round(float(frame["episode_metrics"][EPISODE_METRIC["steps"]]))
    colour, metrics = frame["signal_colour"][:p, :q].copy(), frame["approach_metrics"].astype(float)
    return Scene(context, road, steps * config.step_s, vehicles, colour, metrics)


def entry_edges(road: RoadNet, approaches: Sequence[str], step_s: float) -> list[str]:
    """Return the edges on which vehicles are first seen in the region."""
    entering = [road.approaches.index(name) for name in approaches]
    edges = [edge for p in entering for edge in road.incoming_edges[p]]
    # Vehicles that pass a short approach within a step are first seen inside the junction.
    short = [p for p in entering if road.lane_length_m[p] < road.speed_limit_mps[p] * step_s]
    first_seen = (road.lane_location == INSIDE) & np.isin(road.lane_approach, short)
    inside = [road.lane_ids[lane].rsplit("_", 1)[0] for lane in np.flatnonzero(first_seen)]
    return [*edges, *dict.fromkeys(inside)]
