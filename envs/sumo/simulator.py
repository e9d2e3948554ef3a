"""One environment without TorchRL: episodes of a context on SUMO, frames in arrays."""

from __future__ import annotations

import contextlib
import os
import tempfile
from itertools import filterfalse
from pathlib import Path

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.emissions.kernel import KernelWeights
from izoo.envs import accounting
from izoo.envs.config import KEEP_LANE, NEIGHBOURS, EnvConfig
from izoo.envs.context_table import observed_table
from izoo.envs.fused import ClockArrays, Frame, Rules, Tables, command_agents, hold, make_frame
from izoo.envs.kernel_cache import compiling_once
from izoo.envs.kernels import read_clock, road_arrays
from izoo.envs.layout import (
    ACCEL,
    APPROACH,
    DEFERRED,
    EPISODE_METRIC,
    EXIT,
    IS_CV,
    JUNCTION_M,
    METRIC,
    SPEED,
    VEHICLE_FLAGS,
    VEHICLE_FLOATS,
    VEHICLE_INTS,
)
from izoo.envs.roster import Roster
from izoo.envs.sumo.session import SumoSession, sumo_arguments
from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS
from izoo.networks.net.build import build_net
from izoo.networks.road import INSIDE, RoadNet, read_road
from izoo.traffic.episode import sample_traffic, write_routes

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV is left to SUMO while it is on a lane that does not lead to its exit and SUMO itself braked it harder than this
in the last step: SUMO slows it to find a gap, and a command would override that."""
_NOBODY = np.zeros(0, np.int64)


class Simulator:
    """Runs episodes and writes their frames.

    Args:
        config: the environment's settings.
        frame: the arrays of one environment's frame (:func:`izoo.envs.layout.map_frames`, one row).
        weights: the emission surrogates.
    """

    def __init__(self, config: EnvConfig, frame: dict[str, np.ndarray], weights: KernelWeights) -> None:
        self.config, self.frame, self.weights = config, frame, weights
        self.session = SumoSession(gui=config.gui)
        self._road: RoadNet | None = None
        self._routes: Path | None = None
        self._arrays = Frame(*(frame[name] for name in Frame._fields))

    # -- episodes ------------------------------------------------------------------------------------------------------

    def reset(self, context: Context, seed: int, episode: int = 0) -> None:
        """Begin an episode, run its warm-up, and write the first frame."""
        config = self.config
        net = build_net(context.intersection)
        self._road = road = read_road(net)
        ways = max(road.movement_turn.shape)
        if ways > config.num_approaches:
            raise IzooError(
                f"{context.name} has {len(road.approaches)} approaches and {len(road.exits)} exits, but "
                f"env.num_approaches is {config.num_approaches}; set it to {ways} or more."
            )
        self.context, self.seed = context, seed
        self.traffic = sample_traffic(context, road, seed, config.horizon_s)
        self._load(net)
        with compiling_once(make_frame):
            self._begin(episode)

    def _begin(self, episode: int) -> None:
        config = self.config
        self._clear_tables()
        self._prepare_road()
        for _ in range(config.warmup_steps):
            self.session.advance()
        self._register_present()
        self._started_s = self.session.time_s
        self.roster.list_members()
        reading = self.session.read(self.roster.row_names, self.lane_numbers)
        self._make_frame(reading, acting=np.full(config.num_agents, -1), leavers=[], measured=False)
        self._write_context(episode)
        for name in ("agent_truncated", "terminated", "truncated", "done", "approach_metrics"):
            self.frame[name][:] = 0

    def _load(self, net: Path) -> None:
        """Begin the episode in SUMO, which keeps its file of the traffic open: the file itself can go at once."""
        self._remove_routes()
        descriptor, name = tempfile.mkstemp(prefix="izoo-", suffix=".rou.xml")
        os.close(descriptor)
        self._routes = Path(name)
        try:
            write_routes(self.traffic, self.road, self._routes)
            self.session.load(sumo_arguments(net, self._routes, self.seed, self.config.step_s))
        except IzooError as error:
            self._remove_routes()
            raise IzooError(f"context {self.context.name}: {error}") from error
        if not self.config.gui:  # a window can be told to load its files again
            self._remove_routes()

    def step(self) -> bool:
        """Apply the frame's actions, simulate one step, and write the next frame; return whether the episode ended."""
        if self.steps >= self.config.control_steps:
            raise IzooError(f"the episode ended after {self.steps} steps; call reset() before the next step.")
        acting = self.roster.agent_row.copy()
        self._apply_commands()
        self.session.advance()
        self.steps += 1
        leavers = self._find_leavers()
        if leavers:
            self.roster.list_members(set(leavers))
        reading = self._read_with_newcomers()
        self._count_collisions()
        self._make_frame(reading, acting, leavers, measured=True)
        if leavers:
            self.roster.release(leavers)
        final = self.steps >= self.config.control_steps
        if final:
            self._finish()
        return final

    @property
    def started(self) -> bool:
        """Whether an episode has begun."""
        return self._road is not None

    @property
    def road(self) -> RoadNet:
        """The road net of the present episode."""
        if self._road is None:
            raise IzooError("no episode has begun; call reset() first.")
        return self._road

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return self._started_s + self.steps * self.config.step_s

    def vehicles(self) -> dict[str, np.ndarray]:
        """Return the emitted columns of all rows, ``[C]`` each, whether or not they are emitted."""
        roster = self.roster
        columns = dict(zip(VEHICLE_FLOATS, roster.floats.T, strict=False))
        columns |= zip(VEHICLE_INTS, roster.ints.T, strict=False)
        columns |= zip(VEHICLE_FLAGS, roster.flags.T.astype(bool), strict=False)
        return columns

    def close(self) -> None:
        """End SUMO."""
        self.session.close()
        self._remove_routes()

    def _remove_routes(self) -> None:
        if self._routes is not None:
            with contextlib.suppress(OSError):  # Windows keeps files that are open: they go with the next episode
                self._routes.unlink(missing_ok=True)
                self._routes = None

    # -- tables --------------------------------------------------------------------------------------------------------

    def _clear_tables(self) -> None:
        config = self.config
        self.roster = Roster(config, self.road, self.traffic, electric=self.context.engine == "electric")
        self.sums = np.zeros((config.num_approaches, len(APPROACH_METRICS)))
        self.episode_sums = np.zeros(len(EPISODE_METRIC))
        self.steps = 0
        self.collided: set[tuple[str, str]] = set()
        self._lanes_commanded: set[str] = set()
        self._yielding = 0

    def _bind_tables(self) -> None:
        """Hand the present tables and the episode's constants to compiled code."""
        roster, count = self.roster, self.config.num_agents
        self._tables = tables = Tables(
            roster.floats,
            roster.ints,
            roster.flags,
            roster.terms,
            self.sums,
            self.episode_sums,
            roster.agent_row,
            np.zeros(roster.capacity, np.int64),
            np.zeros(len(self.road.lane_ids) + 1, np.int64),
            np.zeros(roster.capacity, np.int64),
            roster.yields,
            np.empty(count, np.int64),
            np.empty(count, np.int64),
            np.empty(count),
        )
        self._world = hold(tables, self.lanes, self.clock, self._rules, self.weights, self._arrays)

    def _prepare_road(self) -> None:
        road, clock, config = self.road, self.road.clock, self.config
        self.lanes = road_arrays(road)
        self.lane_numbers = {name: number for number, name in enumerate(road.lane_ids)}
        entering = [road.approaches.index(name) for name in self.context.demand_approaches]
        self.entry_edges = [edge for p in entering for edge in road.incoming_edges[p]]
        # An approach that is passed within a step shows its vehicles inside the junction first.
        short = [p for p in entering if road.lane_length_m[p] < road.speed_limit_mps[p] * config.step_s]
        first_seen = (road.lane_location == INSIDE) & np.isin(road.lane_approach, short)
        inside = [road.lane_ids[lane].rsplit("_", 1)[0] for lane in np.flatnonzero(first_seen)]
        self.entry_edges.extend(dict.fromkeys(inside))
        self._is_entry_lane = np.array([name.rsplit("_", 1)[0] in self.entry_edges for name in road.lane_ids])
        shape = clock.colour.shape[:2]
        self.clock = ClockArrays(
            **{name: getattr(clock, name) for name in ClockArrays._fields[:8]},
            now=np.zeros(shape, np.int64),
            time_left_s=np.zeros(shape),
            until_second_s=np.zeros(shape),
            until_third_s=np.zeros(shape),
        )
        self.phase = self._read_clock()
        reward = config.reward
        self._rules = Rules(
            step_s=config.step_s,
            temperature_c=self.context.temperature_c,
            humidity_pct=self.context.humidity_pct,
            tau_mps=reward.tau_mps,
            soft_stop=reward.soft_stop,
            weights=np.array([1.0, reward.alpha, reward.beta, reward.comfort, reward.realism]),
            eta=reward.eta,
            safety=reward.safety,
            scale=reward.scale,
            sensor_range_m=np.inf if config.sensor_range_m is None else float(config.sensor_range_m),
            neighbours=np.array([NEIGHBOURS.index(name) for name in config.neighbours], np.int64),
            features=observed_table(self.context, road, config.observed),
            emit_vehicles="vehicles" in config.emit,
            emit_signal="signal" in config.emit,
            emit_metrics="metrics" in config.emit,
        )
        self._bind_tables()

    def _read_clock(self) -> int:
        clock = self.clock
        tables = (clock.cycle_s, clock.offset_s, clock.phase_begin_s, clock.colour, clock.change_s)
        return read_clock(0.0, *tables, clock.second_green_s, clock.third_green_s, *clock[-4:])

    # -- one step ------------------------------------------------------------------------------------------------------

    def _apply_commands(self) -> None:
        commands, releases = command_agents(self._world)
        names, tables = self.roster.names, self._tables
        if releases:
            self.session.command_speeds([names[r] for r in tables.release[:releases].tolist()], [-1.0] * releases)
        commanded = [names[r] for r in tables.command[:commands].tolist()]
        self.session.command_speeds(commanded, tables.target_mps[:commands].tolist())
        if self.config.lane_change:
            self._command_lanes()

    def _command_lanes(self) -> None:
        """Pass lane changes on; a CV that asks to be left to SUMO changes lanes as SUMO has it."""
        frame, roster, session = self.frame, self.roster, self.session
        asks = (frame["defer"] != 0) | np.isnan(frame["action"])
        for a in np.flatnonzero(roster.agent_row >= 0).tolist():
            row, change = roster.agent_row[a], int(frame["lane_change"][a])
            name = roster.names[row]
            if asks[a] and name in self._lanes_commanded:
                self._lanes_commanded.remove(name)
                session.give_lane_changes(name)
            elif not asks[a] and name not in self._lanes_commanded:
                self._lanes_commanded.add(name)
                session.take_lane_changes(name)
            if change != KEEP_LANE and not roster.flags[row, DEFERRED]:
                session.change_lane(name, change - 1, self.config.step_s)

    def _find_leavers(self) -> list[int]:
        row_of = self.roster.row_of
        return [row_of[name] for name in self.session.arrived() if name in row_of]

    def _read_with_newcomers(self) -> tuple[np.ndarray, ...]:
        """Read every vehicle in the region; where the entries hold more than were known, register the others first."""
        session, roster = self.session, self.roster
        reading = session.read(roster.row_names, self.lane_numbers)
        if session.count_on(self.entry_edges) == np.count_nonzero(self._is_entry_lane[reading[0]]):
            return reading
        newcomers = [
            name for edge in self.entry_edges for name in filterfalse(roster.row_of.__contains__, session.on_edge(edge))
        ]
        for name in newcomers:
            self._register(name, counted=True)
        roster.extend_members(newcomers)
        return tuple(map(np.concatenate, zip(reading, session.read(newcomers, self.lane_numbers), strict=True)))

    def _register_present(self) -> None:
        """Register everybody in the region at the end of the warm-up, also inside the junction and behind it."""
        road, roster = self.road, self.roster
        for edge in dict.fromkeys(lane.rsplit("_", 1)[0] for lane in road.lane_ids):
            for name in self.session.on_edge(edge):
                row = self._register(name, counted=False)
                approach, leaving = roster.ints[row, APPROACH], roster.ints[row, EXIT]
                way = (road.lane_approach == approach) & (road.lane_exit == leaving)
                roster.floats[row, JUNCTION_M] = road.inside_length_m[way].max(initial=0.0)

    def _register(self, name: str, counted: bool) -> int:
        """Enter a vehicle into the tables, and a CV among the agents; return its row."""
        session, roster = self.session, self.roster
        if roster.is_full:
            roster.grow()
            self._bind_tables()
        row = roster.add(name, session.acceleration(name), counted)
        accounting.book_entry(row, roster.floats, roster.ints, roster.flags, self.sums)
        if roster.flags[row, IS_CV]:
            if roster.give_slot(row):
                session.check_all_speeds(name)
            else:
                self.episode_sums[EPISODE_METRIC["unslotted"]] += 1
        return row

    def _make_frame(
        self, reading: tuple[np.ndarray, ...], acting: np.ndarray, leavers: list[int], measured: bool
    ) -> None:
        """Let the compiled code turn what was read into the frame."""
        self.phase, suspects = make_frame(
            self.roster.rows,
            reading,
            acting,
            np.array(leavers, np.int64) if leavers else _NOBODY,
            self.time_s,
            self.phase,
            measured,
            self._world,
        )
        self._find_yielding(suspects)

    def _find_yielding(self, count: int) -> None:
        roster, step_s = self.roster, self.config.step_s
        if count or self._yielding:
            roster.yields[:] = 0
        self._yielding = count
        for row in self._tables.suspects[:count].tolist():
            before = roster.floats[row, SPEED] - roster.floats[row, ACCEL] * step_s
            braking = (before - self.session.free_speed(roster.names[row])) / step_s
            roster.yields[row] = braking > LANE_CHANGE_BRAKING_MPS2

    def _count_collisions(self) -> None:
        roster = self.roster
        for rear, other in self.session.collisions():
            if (rear, other) in self.collided or rear not in roster.row_of:
                continue
            self.collided.add((rear, other))
            row = roster.row_of[rear]
            column = METRIC["collisions_cv" if roster.flags[row, IS_CV] else "collisions_hdv"]
            self.sums[roster.ints[row, APPROACH], column] += 1
            self.episode_sums[EPISODE_METRIC["collisions"]] += 1

    # -- frames --------------------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Truncate everybody who is still there, and complete the metrics."""
        roster = self.roster
        accounting.book_unfinished(roster.rows, roster.floats, roster.ints, roster.flags, self.sums)
        waiting = np.array([int(name) for name in self.session.waiting()], np.int64)
        np.add.at(self.sums[:, METRIC["waiting"]], self.traffic.approach[waiting], 1.0)
        frame = self.frame
        frame["agent_truncated"][:] = frame["mask"]
        frame["agent_done"][:] |= frame["mask"]
        frame["truncated"][:] = frame["done"][:] = 1
        frame["approach_metrics"][:] = self.sums

    def _write_context(self, episode: int) -> None:
        context, frame = self.context, self.frame
        frame["context_values"][:] = (
            context.adoption,
            context.temperature_c,
            context.humidity_pct,
            ENGINES.index(context.engine),
        )
        frame["context_ids"][:] = (episode, -1 if context.context_id is None else context.context_id, self.seed)
        frame["approach_mask"][:] = 0
        frame["approach_mask"][: len(self.road.approaches)] = 1
        if "signal" in self.config.emit:
            p, q = self.clock.now.shape
            frame["signal_colour"][:], frame["signal_time_left_s"][:] = 2, 0.0
            frame["signal_colour"][:p, :q], frame["signal_time_left_s"][:p, :q] = self.clock.now, self.clock.time_left_s
