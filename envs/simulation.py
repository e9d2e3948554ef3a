"""Simulators that play one intersection at a time, in this process: all that a backend of them needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from izoo.compiling import compiling_once
from izoo.emissions.weights import load_weights
from izoo.envs.backend import Play, clear_ended, episode_traffic
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.episode import Episode
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.mdp.step import make_frame
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road


class Simulation:
    """One episode on a simulator, from its first frame on: subclasses play the warm-up when they are made.

    Attributes:
        config: the environment's settings.
        net, road: file of the net, and what it says.
        episode: turns what the simulator reports into frames.
        traffic: what is to be simulated.
    """

    def __init__(self, config: EnvConfig, frame: dict[str, np.ndarray], play: Play) -> None:
        self.config = config
        self.net = build_net(play.context.intersection)
        self.road = read_road(self.net)
        self.traffic = episode_traffic(config, play.context, self.road, play.seed)
        self.episode = Episode(config, frame, load_weights(), *play, self.road, self.traffic)

    def step(self) -> None:
        """Carry out the episode's commands, simulate one step, and let the episode write the frame."""
        raise NotImplementedError

    def close(self) -> None:
        """Remove what the simulation has left; nothing by default."""


class Simulations:
    """A :class:`~izoo.envs.backend.Backend` of ``N`` environments, each a :class:`Simulation` in this process.

    Args:
        config: the environments' settings.
        num_envs: ``N``.
        frames: the arrays ``[N, ...]`` of their frames; ``None``: they are made.
        threads, surrogate: of simulators that step environments side by side; this one has no use for them.

    Attributes:
        kind: makes the simulation of one episode of the settings, the frame's arrays and a play.
        simulations: the present ones.
    """

    kind: Callable[[EnvConfig, dict[str, np.ndarray], Play], Simulation]
    closed = False

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int = 1,
        frames: dict[str, np.ndarray] | None = None,
        *,
        threads: int | None = None,
        surrogate: str | None = None,
    ) -> None:
        self.config = config
        self.frames = (
            map_frames(bytearray(frame_bytes(config, num_envs)), config, num_envs) if frames is None else frames
        )
        self.simulations: list[Simulation | None] = [None] * num_envs

    @property
    def started(self) -> bool:
        """Whether every environment has begun an episode."""
        return None not in self.simulations

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin episodes in some environments, and write their first frames."""
        with compiling_once(make_frame):
            for index, play in plays.items():
                self._end(index)
                self.simulations[index] = self.kind(self.config, row_of(self.frames, index), play)

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Simulate one decision of every environment whose episode has not ended."""
        for index in np.flatnonzero(~clear_ended(self.config, self.frames)).tolist():
            simulation = self.simulation(index)
            simulation.step()
            while not simulation.episode.between_decisions:
                simulation.step()
        return ()

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment."""
        return self.simulation(index).episode.scene()

    def close(self) -> None:
        """End all simulations; later ones may begin."""
        for index in range(len(self.simulations)):
            self._end(index)

    def simulation(self, index: int = 0) -> Simulation:
        """Return the present simulation of an environment; raises :class:`IzooError` before it has begun."""
        simulation = self.simulations[index]
        if simulation is None:
            raise IzooError("no episode has begun; call reset() first.")
        return simulation

    def _end(self, index: int) -> None:
        simulation, self.simulations[index] = self.simulations[index], None
        if simulation is not None:
            simulation.close()
