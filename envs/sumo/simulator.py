"""One environment on SUMO, in this process."""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
from itertools import filterfalse
from pathlib import Path

import numpy as np

from izoo.envs.backend import Play, entry_edges
from izoo.envs.config import KEEP_LANE, EnvConfig
from izoo.envs.mdp.commands import LANE_CHANGE_BRAKING_MPS2
from izoo.envs.mdp.episode import DemandAtHorizon, Reading
from izoo.envs.simulation import Simulation, Simulations
from izoo.envs.sumo.session import SumoSession, readable_paths, sumo_arguments
from izoo.errors import IzooError
from izoo.traffic.sampling import write_routes

CHECK_ALL = 31
"""Speed mode: safe speed, own acceleration and deceleration limits, right of way, red lights."""
LANES_BY_ROUTE, LANES_BY_DEFAULT = 0b001000000001, 0b011001010101
"""Lane-change modes: SUMO changes lanes only where the route needs it, and commands obey safety gaps; its default."""


class SumoSimulator(Simulations):
    """A :class:`~izoo.envs.backend.Backend` of one environment; see :class:`~izoo.envs.simulation.Simulations`."""

    def __init__(self, config: EnvConfig, num_envs: int = 1, frames: dict[str, np.ndarray] | None = None) -> None:
        super().__init__(config, num_envs, frames)
        self.session = SumoSession(gui=config.gui)
        self.kind = functools.partial(SumoSimulation, self.session)

    def close(self) -> None:
        """End SUMO; the next episode starts it again."""
        super().close()
        self.session.close()


class SumoSimulation(Simulation):
    """An episode on SUMO: loads it, applies commands, and reports positions.

    A vehicle's id is its number in the episode's demand, as a decimal string.

    Args:
        session: the simulation of this process.
        config, frame, play: as for :class:`~izoo.envs.simulation.Simulation`.

    Attributes:
        row_of: row of each vehicle in the region by its id, in order of arrival, until the end of the step in which it
            left.
        members: ids of the vehicles in the region, in the same order.
    """

    def __init__(self, session: SumoSession, config: EnvConfig, frame: dict[str, np.ndarray], play: Play) -> None:
        super().__init__(config, frame, play)
        self.session = session
        self.row_of: dict[str, int] = {}
        self.members: list[str] = []
        self._id_of: dict[int, str] = {}
        self._routes: Path | None = None
        self._load()
        self._lane_numbers = {name: number for number, name in enumerate(self.road.lane_ids)}
        self._entry_edges = entry_edges(self.road, play.context.demand_approaches, config.step_s)
        self._is_entry_lane = np.array([name.rsplit("_", 1)[0] in self._entry_edges for name in self.road.lane_ids])
        self._due = _due_by_step(self.traffic.depart_s, config)
        self._elapsed = 0
        self._departed: set[str] = set()
        self._collided: set[tuple[str, str]] = set()
        self._lane_commanded: set[str] = set()
        self._warm_up()

    def _load(self) -> None:
        """Begin the episode in SUMO, which keeps the route file open, so that the file can be removed at once."""
        episode = self.episode
        descriptor, name = tempfile.mkstemp(prefix="izoo-", suffix=".rou.xml")
        os.close(descriptor)
        self._routes = Path(name)
        try:
            write_routes(self.traffic, self.road, self._routes)
            with readable_paths(self.net, self._routes) as (net_file, route_file):
                self.session.load(sumo_arguments(net_file, route_file, episode.seed, self.config.step_s))
        except BaseException as error:
            self.close()
            if isinstance(error, IzooError):
                raise IzooError(f"context {episode.context.name}: {error}") from error
            raise
        if not self.config.gui:  # sumo-gui can reload its files
            self.close()

    def _warm_up(self) -> None:
        """Simulate the warm-up, and register the vehicles in the region at its end."""
        session, road = self.session, self.road
        arrived: list[str] = []
        for _ in range(self.config.warmup_steps):
            self._advance()
            arrived += session.arrived()
        for edge in dict.fromkeys(lane.rsplit("_", 1)[0] for lane in road.lane_ids):
            for name in session.on_edge(edge):
                self._register(name, counted=False)
        self._early = [int(name) for name in (*arrived, *self.members)]
        self.episode.begin(session.read(self.members, self._lane_numbers), session.time_s, self._early)

    def step(self) -> None:
        """Apply the frame's actions, simulate one step, and write the next frame."""
        episode, session = self.episode, self.session
        self._apply_commands()
        self._advance()
        leavers = [name for name in session.arrived() if name in self.row_of]
        for name in leavers:
            episode.release(self.row_of[name])
            self.members.remove(name)
        reading = self._read_with_newcomers()
        for rear, other in session.collisions():
            if (rear, other) not in self._collided and rear in self.row_of:
                self._collided.add((rear, other))
                episode.count_collision(self.row_of[rear])
        wrong_lane_agents = episode.write_frame(reading, session.is_empty)
        for name in leavers:
            del self._id_of[self.row_of.pop(name)]
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
        self.session.command_speeds(self._ids(release), [-1.0] * len(release))
        self.session.command_speeds(self._ids(command), target_mps.tolist())
        for name, speed_mps in zip(self._ids(capped), cap_mps.tolist(), strict=True):
            self.session.limit_speed(name, speed_mps)
        if self.config.lane_change:
            self._apply_lane_changes()

    def _apply_lane_changes(self) -> None:
        """Apply lane-change commands; a deferred CV changes lanes by SUMO's default."""
        frame, tables, session = self.episode.frame, self.episode.tables, self.session
        deferred = (frame["defer"] != 0) | np.isnan(frame["action"][:, 0]) | (tables.acting < 0)
        slots = np.flatnonzero(tables.agent_row >= 0)
        for a, name in zip(slots.tolist(), self._ids(tables.agent_row[slots]), strict=True):
            change = int(frame["lane_change"][a])
            if deferred[a] and name in self._lane_commanded:
                self._lane_commanded.remove(name)
                session.set_lane_change_mode(name, LANES_BY_DEFAULT)
            elif not deferred[a] and name not in self._lane_commanded:
                self._lane_commanded.add(name)
                session.set_lane_change_mode(name, LANES_BY_ROUTE)
            if change != KEEP_LANE and not tables.vehicles["deferred"][tables.agent_row[a]]:
                session.change_lane(name, change - 1, self.config.step_s)

    def _read_with_newcomers(self) -> Reading:
        """Read all vehicles in the region; if the entry edges hold vehicles without a row, register them."""
        session = self.session
        reading = session.read(self.members, self._lane_numbers)
        if session.count_on(self._entry_edges) == np.count_nonzero(self._is_entry_lane[reading[0]]):
            return reading
        entered = [
            name for edge in self._entry_edges for name in filterfalse(self.row_of.__contains__, session.on_edge(edge))
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
        self.row_of[name], self._id_of[row] = row, name
        self.members.append(name)
        if self.episode.is_agent(row):
            self.session.set_speed_mode(name, CHECK_ALL)

    def _ids(self, rows: np.ndarray) -> list[str]:
        """Return the ids of the vehicles in some rows."""
        return [self._id_of[row] for row in rows.tolist()]

    def _slowed(self, rows: np.ndarray) -> list[int]:
        """Return which of these rows SUMO slows down for a lane change."""
        vehicles, step_s, slowed = self.episode.tables.vehicles, self.config.step_s, []
        for row, name in zip(rows.tolist(), self._ids(rows), strict=True):
            before = vehicles["speed_mps"][row] - vehicles["accel_mps2"][row] * step_s
            if (before - self.session.free_speed(name)) / step_s > LANE_CHANGE_BRAKING_MPS2:
                slowed.append(row)
        return slowed

    def _demand_at_horizon(self) -> DemandAtHorizon:
        """Return the demand that has not reached the region."""
        session, due = self.session, range(self._due[self._elapsed - 1])
        waiting = {int(name) for name in session.waiting()}
        outside = [int(name) for name in session.driving() if name not in self.row_of]
        departed = {int(name) for name in self._departed}
        dropped = [number for number in due if number not in departed and number not in waiting]
        return DemandAtHorizon(due, dropped, sorted(waiting), outside, self._early)

    def close(self) -> None:
        """Remove the route file."""
        if self._routes is not None:
            with contextlib.suppress(OSError):
                self._routes.unlink(missing_ok=True)
            self._routes = None


def _due_by_step(depart_s: np.ndarray, config: EnvConfig) -> list[int]:
    """Return how many departures are due by each step of an episode; SUMO inserts at the begin of a step."""
    begin_s = np.arange(config.warmup_steps + config.total_steps) * config.step_s
    # SUMO reads times in whole milliseconds.
    return np.searchsorted(np.round(depart_s, 3), begin_s + 1e-6, side="right").tolist()  # type: ignore[no-any-return]
