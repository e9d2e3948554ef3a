"""One environment on SUMO, in this process: loads episodes, applies commands, and reports positions."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from itertools import filterfalse
from pathlib import Path

import numpy as np

from izoo.compiling import compiling_once
from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights
from izoo.emissions.weights import load_weights
from izoo.envs.backend import Play, entry_edges, episode_traffic
from izoo.envs.config import KEEP_LANE, EnvConfig
from izoo.envs.mdp.commands import LANE_CHANGE_BRAKING_MPS2
from izoo.envs.mdp.episode import DemandAtHorizon, Episode, Reading
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.mdp.step import make_frame
from izoo.envs.sumo.session import SumoSession, readable_paths, sumo_arguments
from izoo.envs.sumo.vehicle_ids import VehicleIds
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import Traffic, write_routes


class SumoSimulator:
    """A :class:`~izoo.envs.backend.Backend` of one environment.

    Args:
        config: the environment's settings.
        frame: the arrays of its frame (:func:`izoo.envs.mdp.frame.map_frames`, one row).
        weights: the emission surrogates.
    """

    def __init__(self, config: EnvConfig, frame: dict[str, np.ndarray], weights: KernelWeights) -> None:
        self.config, self.frame, self._weights = config, frame, weights
        self.session = SumoSession(gui=config.gui)
        self._episode: Episode | None = None
        self._routes: Path | None = None

    @property
    def started(self) -> bool:
        """Whether an episode has begun."""
        return self._episode is not None

    @property
    def closed(self) -> bool:
        """Never: after :meth:`close`, the next episode starts SUMO again."""
        return False

    @property
    def episode(self) -> Episode:
        """The present episode."""
        if self._episode is None:
            raise IzooError("no episode has begun; call reset() first.")
        return self._episode

    def scene(self, index: int = 0) -> Scene:
        """Return the present state."""
        return self.episode.scene()

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin an episode, run its warm-up, and write the first frame."""
        with compiling_once(make_frame):
            for play in plays.values():
                self._begin(*play)

    def _begin(self, context: Context, seed: int, number: int) -> None:
        config = self.config
        net = build_net(context.intersection)
        road = read_road(net)
        traffic = episode_traffic(config, context, road, seed)
        episode = Episode(config, self.frame, self._weights, context, seed, number, road, traffic)
        self._episode = None  # none is running until this one is loaded
        self._load(net, episode, traffic)
        self._episode, self.ids = episode, VehicleIds()
        self._lane_numbers = {name: number for number, name in enumerate(road.lane_ids)}
        self._entry_edges = entry_edges(road, context.demand_approaches, config.step_s)
        self._is_entry_lane = np.array([name.rsplit("_", 1)[0] in self._entry_edges for name in road.lane_ids])
        self._due = _due_by_step(traffic.depart_s, config)
        self._elapsed = 0
        self._departed: set[str] = set()
        self._collided: set[tuple[str, str]] = set()
        self._lane_commanded: set[str] = set()
        self._warm_up()

    def _load(self, net: Path, episode: Episode, traffic: Traffic) -> None:
        """Begin the episode in SUMO, which keeps the route file open, so that the file can be removed at once."""
        self._remove_routes()
        descriptor, name = tempfile.mkstemp(prefix="izoo-", suffix=".rou.xml")
        os.close(descriptor)
        self._routes = Path(name)
        try:
            write_routes(traffic, episode.road, self._routes)
            with readable_paths(net, self._routes) as (net_file, route_file):
                self.session.load(sumo_arguments(net_file, route_file, episode.seed, self.config.step_s))
        except IzooError as error:
            self._remove_routes()
            raise IzooError(f"context {episode.context.name}: {error}") from error
        if not self.config.gui:  # sumo-gui can reload its files
            self._remove_routes()

    def _warm_up(self) -> None:
        """Simulate the warm-up, and register the vehicles in the region at its end."""
        session, road = self.session, self.episode.road
        arrived: list[str] = []
        for _ in range(self.config.warmup_steps):
            self._advance()
            arrived += session.arrived()
        for edge in dict.fromkeys(lane.rsplit("_", 1)[0] for lane in road.lane_ids):
            for name in session.on_edge(edge):
                self._register(name, counted=False)
        self._early = [int(name) for name in (*arrived, *self.ids.members)]
        self.episode.begin(session.read(self.ids.members, self._lane_numbers), session.time_s, self._early)

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Apply the frame's actions, simulate the steps of one decision, and write the next frame."""
        self._step()
        while not self.episode.between_decisions:
            self._step()
        return ()

    def _step(self) -> None:
        episode, session = self.episode, self.session
        self._apply_commands()
        self._advance()
        leavers = [name for name in session.arrived() if name in self.ids.row_of]
        for name in leavers:
            episode.release(self.ids.row_of[name])
        if leavers:
            self.ids.remove(leavers)
        reading = self._read_with_newcomers()
        for rear, other in session.collisions():
            if (rear, other) not in self._collided and rear in self.ids.row_of:
                self._collided.add((rear, other))
                episode.count_collision(self.ids.row_of[rear])
        wrong_lane_agents = episode.write_frame(reading, session.is_empty)
        self.ids.free_rows(leavers)
        episode.mark_yielding(self._slowed(wrong_lane_agents) if len(wrong_lane_agents) else ())
        episode.end_step(self._demand_at_horizon, session.is_empty)

    def _advance(self) -> None:
        """Simulate one step, and record the departures."""
        session = self.session
        if self._due[self._elapsed] > len(self._departed) + session.dropped:
            session.advance_departing()
            self._departed.update(session.departed())
        else:
            session.advance()
        self._elapsed += 1

    def _apply_commands(self) -> None:
        command, target_mps, release, capped, cap_mps = self.episode.commands()
        if len(release):
            self.session.command_speeds(self.ids.of(release.tolist()), [-1.0] * len(release))
        self.session.command_speeds(self.ids.of(command.tolist()), target_mps.tolist())
        if len(capped):
            self.session.limit_speeds(self.ids.of(capped.tolist()), cap_mps.tolist())
        if self.config.lane_change:
            self._apply_lane_changes()

    def _apply_lane_changes(self) -> None:
        """Apply lane-change commands; a deferred CV changes lanes by SUMO's default."""
        frame, tables, session = self.frame, self.episode.tables, self.session
        deferred = (frame["defer"] != 0) | np.isnan(frame["action"][:, 0]) | (tables.acting < 0)
        slots = np.flatnonzero(tables.agent_row >= 0).tolist()
        for a, name in zip(slots, self.ids.of(tables.agent_row[slots].tolist()), strict=True):
            change = int(frame["lane_change"][a])
            if deferred[a] and name in self._lane_commanded:
                self._lane_commanded.remove(name)
                session.restore_lane_changes(name)
            elif not deferred[a] and name not in self._lane_commanded:
                self._lane_commanded.add(name)
                session.restrict_lane_changes(name)
            if change != KEEP_LANE and not tables.vehicles["deferred"][tables.agent_row[a]]:
                session.change_lane(name, change - 1, self.config.step_s)

    def _read_with_newcomers(self) -> Reading:
        """Read all vehicles in the region; if the entry edges hold vehicles without a row, register them."""
        session, ids = self.session, self.ids
        reading = session.read(ids.members, self._lane_numbers)
        if session.count_on(self._entry_edges) == np.count_nonzero(self._is_entry_lane[reading[0]]):
            return reading
        entered = [
            name for edge in self._entry_edges for name in filterfalse(ids.row_of.__contains__, session.on_edge(edge))
        ]
        for name in entered:
            self._register(name, counted=True)
        lane, position, speed, signals = map(
            np.concatenate, zip(reading, session.read(entered, self._lane_numbers), strict=True)
        )
        return lane, position, speed, signals

    def _register(self, name: str, counted: bool) -> None:
        """Give a vehicle that has entered the region a row."""
        row = self.episode.admit(int(name), self.session.acceleration(name), counted)
        self.ids.add(name, row)
        if self.episode.is_agent(row):
            self.session.check_all_speeds(name)

    def _slowed(self, rows: np.ndarray) -> list[int]:
        """Return which of these rows SUMO slows down for a lane change."""
        vehicles, step_s, slowed = self.episode.tables.vehicles, self.config.step_s, []
        for row, name in zip(rows.tolist(), self.ids.of(rows.tolist()), strict=True):
            before = vehicles["speed_mps"][row] - vehicles["accel_mps2"][row] * step_s
            if (before - self.session.free_speed(name)) / step_s > LANE_CHANGE_BRAKING_MPS2:
                slowed.append(row)
        return slowed

    def _demand_at_horizon(self) -> DemandAtHorizon:
        """Return the demand that has not reached the region."""
        session, due = self.session, range(self._due[self._elapsed - 1])
        waiting = {int(name) for name in session.waiting()}
        outside = [int(name) for name in session.driving() if name not in self.ids.row_of]
        departed = {int(name) for name in self._departed}
        dropped = [number for number in due if number not in departed and number not in waiting]
        return DemandAtHorizon(due, dropped, sorted(waiting), outside, self._early)

    def close(self) -> None:
        """End SUMO."""
        self.session.close()
        self._remove_routes()
        self._episode = None

    def _remove_routes(self) -> None:
        if self._routes is not None:
            with contextlib.suppress(OSError):
                self._routes.unlink(missing_ok=True)
            self._routes = None


def _due_by_step(depart_s: np.ndarray, config: EnvConfig) -> list[int]:
    """Return how many departures are due by each step of an episode; SUMO inserts at the begin of a step."""
    begin_s = np.arange(config.warmup_steps + config.total_steps) * config.step_s
    # SUMO reads times in whole milliseconds.
    return np.searchsorted(np.round(depart_s, 3), begin_s + 1e-6, side="right").tolist()  # type: ignore[no-any-return]


def single(config: EnvConfig) -> tuple[dict[str, np.ndarray], SumoSimulator]:
    """Return the frames and the backend of one environment in this process."""
    frames = map_frames(bytearray(frame_bytes(config, 1)), config, 1)
    return frames, SumoSimulator(config, row_of(frames, 0), load_weights())
