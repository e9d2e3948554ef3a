"""One environment without TorchRL: episodes of a context on SUMO, slots for vehicles and agents, frames in arrays.

Slot rules: a vehicle keeps its row, and a CV its agent slot, from entering the controlled region until it leaves. Rows
and slots freed in a step are handed out again from the next step on, so that a newcomer never stands in a leaver's place.
"""

from __future__ import annotations

import heapq
import tempfile
from pathlib import Path

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.emissions.kernel import KernelWeights, emission_rate_kernel
from izoo.envs import accounting, kernels
from izoo.envs.config import NEIGHBOURS, EnvConfig
from izoo.envs.context_table import observed_table
from izoo.envs.layout import (
    ACCEL,
    AGENT,
    APPROACH,
    COUNTED,
    DEFERRED,
    ELECTRIC,
    EMISSION,
    ENTRY_M,
    EPISODE_METRIC,
    EXIT,
    FRESH,
    GRADE,
    IS_CV,
    LENGTH,
    METRIC,
    MOVES_CLASS,
    NUM_FLAGS,
    NUM_FLOATS,
    NUM_INTS,
    NUMBER,
    PRESENT,
    SPEED,
    WRONG_LANE,
)
from izoo.envs.sumo import SumoSession, sumo_arguments
from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS
try:
    from izoo.networks.build import build_net
except ImportError:
    def build_net(s): return s.net_path
from izoo.networks.roadnet import RoadNet, read_road
from izoo.traffic.episode import Traffic, sample_traffic, write_routes

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV is left to SUMO while it is on a lane that does not lead to its exit and SUMO itself braked it harder than this
in the last step: SUMO slows it to find a gap, and a command would override that."""
GRIDLOCK_S = 180.0
"""The region is in gridlock when none of its vehicles has moved for this long."""
_MOVING_MPS = 0.1


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
        self.road: RoadNet | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._neighbours = np.array([NEIGHBOURS.index(name) for name in config.neighbours], np.int64)
        self._range_m = np.inf if config.sensor_range_m is None else config.sensor_range_m
        reward = config.reward
        self._weights = np.array([1.0, reward.alpha, reward.beta, reward.comfort, reward.realism])
        self._emit_vehicles = "vehicles" in config.emit

    # -- episodes ------------------------------------------------------------------------------------------------------

    def reset(self, context: Context, seed: int, episode: int = 0) -> None:
        """Begin an episode, run its warm-up, and write the first frame."""
        config = self.config
        net = build_net(context.intersection)
        self.road = road = read_road(net)
        if len(road.approaches) > config.num_approaches:
            raise IzooError(
                f"{context.name} has {len(road.approaches)} approaches, but env.num_approaches is "
                f"{config.num_approaches}; set it to {len(road.approaches)} or more."
            )
        self.context, self.seed = context, seed
        self.traffic = sample_traffic(context, road, seed, config.horizon_s)
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="izoo-")
        routes = Path(self._folder.name) / "traffic.rou.xml"
        write_routes(self.traffic, road, routes)
        try:
            self.session.load(sumo_arguments(net, routes, seed, config.step_s))
        except IzooError as error:
            raise IzooError(f"context {context.name}: {error}") from error
        self._clear_tables()
        self._prepare_road()
        for _ in range(config.warmup_steps):
            self.session.advance()
        self._register_newcomers(counted=False)
        self._read_vehicles()
        self._pay_step(acting=np.full(config.num_agents, -1))
        self._write_context(episode)
        self._write_frame(final=False)

    def step(self) -> bool:
        """Apply the frame's actions, simulate one step, and write the next frame; return whether the episode ended."""
        acting = self.agent_row.copy()
        self._apply_commands()
        self.session.advance()
        self.steps += 1
        leavers = self._find_leavers()
        self._register_newcomers(counted=True)
        self._read_vehicles()
        self._account_step()
        self._pay_step(acting)
        self.frame["agent_terminated"][:] = 0
        self._release(leavers)
        final = self.steps >= self.config.control_steps
        self._write_frame(final)
        return final

    def close(self) -> None:
        """End SUMO and remove the episode's files."""
        self.session.close()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    # -- tables --------------------------------------------------------------------------------------------------------

    def _clear_tables(self) -> None:
        capacity = max(256, self.config.num_vehicles)
        self.floats = np.zeros((capacity, NUM_FLOATS))
        self.ints = np.zeros((capacity, NUM_INTS), np.int64)
        self.flags = np.zeros((capacity, NUM_FLAGS), np.uint8)
        self.terms = np.zeros((capacity, 5))
        self.names: list[str] = [""] * capacity
        self.row_of: dict[str, int] = {}
        self.agent_row = np.full(self.config.num_agents, -1)
        self.yields = np.zeros(capacity, np.uint8)
        self.free_rows = list(range(capacity))
        self.free_agents = list(range(self.config.num_agents))
        self.sums = np.zeros((self.config.num_approaches, len(APPROACH_METRICS)))
        self.episode_sums = np.zeros(len(EPISODE_METRIC))
        self.steps = 0
        self.still_s = 0.0
        self.collided: set[tuple[str, str]] = set()
        self.rows = np.zeros(0, np.int64)
        self.fleet = np.zeros(5)

    def _grow(self) -> None:
        """Double the capacity of the tables."""
        old = len(self.names)
        for name in ("floats", "ints", "flags", "terms", "yields"):
            table = getattr(self, name)
            setattr(self, name, np.concatenate([table, np.zeros_like(table)]))
        self.names.extend([""] * old)
        self.free_rows = list(range(old, 2 * old))

    def _prepare_road(self) -> None:
        road, clock = self.road, self.road.clock
        self.lanes = kernels.road_arrays(road)
        self.lane_numbers = {name: number for number, name in enumerate(road.lane_ids)}
        self.entry_edges = [
            edge
            for name in self.context.demand_approaches
            if name in road.approaches
            for edge in road.incoming_edges[road.approaches.index(name)]
        ]
        self.order = np.zeros(len(self.names), np.int64)
        self.lane_start = np.zeros(len(road.lane_ids) + 1, np.int64)
        self.features = observed_table(self.context, road, self.config.observed)
        self.clock_tables = (clock.cycle_s, clock.offset_s, clock.phase_begin_s, clock.colour)
        self.clock_tables += (clock.change_s, clock.second_green_s, clock.third_green_s)
        shape = clock.colour.shape[:2]
        self.clock = (np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape), np.zeros(shape))
        self.phase = kernels.read_clock(self.session.time_s, *self.clock_tables, *self.clock)

    # -- one step ------------------------------------------------------------------------------------------------------

    def _apply_commands(self) -> None:
        frame, count = self.frame, self.config.num_agents
        command, release, target = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
        commands, releases = accounting.plan_commands(
            self.agent_row,
            frame["action"],
            frame["defer"],
            self.yields,
            self.config.step_s,
            self.floats,
            self.ints,
            self.flags,
            self.sums,
            command,
            release,
            target,
        )
        names = self.names
        self.session.command_speeds([names[r] for r in release[:releases].tolist()], [-1.0] * releases)
        self.session.command_speeds([names[r] for r in command[:commands].tolist()], target[:commands].tolist())
        if self.config.lane_change:
            for a in np.flatnonzero((self.agent_row >= 0) & (frame["lane_change"] != 1)):
                row = self.agent_row[a]
                if not self.flags[row, DEFERRED]:
                    self.session.change_lane(names[row], int(frame["lane_change"][a]) - 1, self.config.step_s)

    def _find_leavers(self) -> list[int]:
        return [self.row_of[name] for name in self.session.arrived() if name in self.row_of]

    def _register_newcomers(self, counted: bool) -> None:
        row_of = self.row_of
        for edge in self.entry_edges:
            for name in self.session.on_edge(edge):
                if name not in row_of:
                    self._register(name, counted)

    def _register(self, name: str, counted: bool) -> None:
        if not self.free_rows:
            self._grow()
        row, number, traffic = heapq.heappop(self.free_rows), int(name), self.traffic
        self.names[row], self.row_of[name] = name, row
        self.yields[row] = 0
        is_cv = bool(traffic.is_cv[number])
        self.flags[row] = 0
        self.flags[row, PRESENT] = self.flags[row, FRESH] = 1
        self.flags[row, IS_CV] = is_cv
        self.flags[row, COUNTED] = counted
        self.flags[row, ELECTRIC] = is_cv and self.context.engine == "electric"
        self.floats[row] = 0.0
        self.floats[row, LENGTH] = traffic.length_m[number]
        self.floats[row, ACCEL] = self.session.acceleration(name)
        self.ints[row, NUMBER] = number
        self.ints[row, APPROACH] = traffic.approach[number]
        self.ints[row, EXIT] = traffic.exit[number]
        self.ints[row, MOVES_CLASS] = traffic.moves_class[number]
        self.ints[row, AGENT] = -1
        self.floats[row, ENTRY_M] = -self.road.lane_length_m[traffic.approach[number]]
        accounting.book_entry(row, self.floats, self.ints, self.flags, self.sums)
        if is_cv:
            self._give_agent_slot(name, row)

    def _give_agent_slot(self, name: str, row: int) -> None:
        if not self.free_agents or row >= self.config.num_vehicles:
            self.episode_sums[EPISODE_METRIC["unslotted"]] += 1
            return
        slot = heapq.heappop(self.free_agents)
        self.agent_row[slot], self.ints[row, AGENT] = row, slot
        self.session.check_all_speeds(name)
        if self.config.lane_change:
            self.session.take_lane_changes(name)

    def _read_vehicles(self) -> None:
        """Read every vehicle of the region (leavers are gone) and find leaders, signals and emissions."""
        arrived = set(self.session.arrived())
        rows = np.fromiter(
            [row for name, row in self.row_of.items() if name not in arrived] if arrived else self.row_of.values(),
            np.int64,
        )
        names = self.names
        reading = self.session.read([names[row] for row in rows.tolist()], self.lane_numbers)
        floats, ints, flags, road = self.floats, self.ints, self.flags, self.lanes
        kernels.place(rows, *reading, floats, ints, flags, road, self.config.step_s)
        if len(self.order) < len(rows):
            self.order = np.zeros(len(self.names), np.int64)
        kernels.sort_lanes(rows, floats, ints, len(self.lane_start) - 1, self.order, self.lane_start)
        kernels.find_leaders(rows, floats, ints, flags, self.order, self.lane_start, road)
        self._emit_co2(rows)
        self._find_yielding(rows)
        self.rows = rows

    def _emit_co2(self, rows: np.ndarray) -> None:
        table = self.floats[rows]
        rate = np.empty(len(rows), np.float32)
        emission_rate_kernel(
            table[:, SPEED].astype(np.float32),
            table[:, ACCEL].astype(np.float32),
            table[:, GRADE].astype(np.float32),
            self.ints[rows, MOVES_CLASS],
            self.flags[rows, ELECTRIC] == 0,
            self.context.temperature_c,
            self.context.humidity_pct,
            self.weights,
            rate,
        )
        self.floats[rows, EMISSION] = rate * self.config.step_s

    def _find_yielding(self, rows: np.ndarray) -> None:
        self.yields[:] = 0
        suspects = rows[(self.flags[rows, WRONG_LANE] != 0) & (self.ints[rows, AGENT] >= 0)]
        for row in suspects.tolist():
            before = self.floats[row, SPEED] - self.floats[row, ACCEL] * self.config.step_s
            braking = (before - self.session.free_speed(self.names[row])) / self.config.step_s
            self.yields[row] = braking > LANE_CHANGE_BRAKING_MPS2

    def _account_step(self) -> None:
        config, clock = self.config, self.road.clock
        accounting.account(
            self.rows,
            self.floats,
            self.ints,
            self.flags,
            clock.colour[:, :, self.phase],
            clock.legal_on_red[:, :, self.phase],
            config.step_s,
            self.sums,
        )
        self.phase = kernels.read_clock(self.session.time_s, *self.clock_tables, *self.clock)
        self._count_collisions()
        speeds = self.floats[self.rows, SPEED]
        self.still_s = self.still_s + config.step_s if len(speeds) and speeds.max() < _MOVING_MPS else 0.0
        if self.still_s >= GRIDLOCK_S:
            self.episode_sums[EPISODE_METRIC["gridlock"]] = 1.0
        self.episode_sums[EPISODE_METRIC["vehicle_steps"]] += len(self.rows)
        unslotted = self.rows[(self.flags[self.rows, IS_CV] != 0) & (self.ints[self.rows, AGENT] < 0)]
        np.add.at(self.sums[:, METRIC["unslotted_steps"]], self.ints[unslotted, APPROACH], 1.0)

    def _count_collisions(self) -> None:
        for rear, other in self.session.collisions():
            if (rear, other) in self.collided or rear not in self.row_of:
                continue
            self.collided.add((rear, other))
            row = self.row_of[rear]
            column = METRIC["collisions_cv" if self.flags[row, IS_CV] else "collisions_hdv"]
            self.sums[self.ints[row, APPROACH], column] += 1
            self.episode_sums[EPISODE_METRIC["collisions"]] += 1

    def _pay_step(self, acting: np.ndarray) -> None:
        reward = self.config.reward
        shortest = accounting.reward_terms(
            self.rows, self.floats, reward.tau_mps, reward.soft_stop, self.terms, self.fleet
        )
        accounting.pay(
            acting,
            self.terms,
            self.fleet,
            shortest,
            self._weights,
            reward.eta,
            reward.safety,
            reward.scale,
            self.frame["reward"],
            self.frame["reward_vector"],
            len(self.rows) == 0,
        )
        agents = int((acting >= 0).sum())
        total = float(self.frame["reward"].sum())
        sums, column = self.episode_sums, EPISODE_METRIC
        sums[column["steps"]] = self.steps
        sums[column["reward_sum"]] += total
        sums[column["agent_steps"]] += agents
        sums[column["return"]] += total / agents if agents else 0.0

    def _release(self, leavers: list[int]) -> None:
        for row in leavers:
            slot = int(self.ints[row, AGENT])
            if slot >= 0:
                self.agent_row[slot] = -1
                self.frame["agent_terminated"][slot] = 1
                heapq.heappush(self.free_agents, slot)
            del self.row_of[self.names[row]]
            self.flags[row] = 0
            heapq.heappush(self.free_rows, row)

    # -- frames --------------------------------------------------------------------------------------------------------

    def _write_frame(self, final: bool) -> None:
        frame = self.frame
        kernels.observe(
            self.agent_row,
            self.floats,
            self.ints,
            self.flags,
            self.order,
            self.lane_start,
            self.lanes,
            self.clock,
            self.features,
            self._neighbours,
            self._range_m,
            frame["observation"],
        )
        kernels.agent_vehicles(self.agent_row, frame["mask"], frame["agent_vehicle"])
        frame["agent_truncated"][:] = frame["mask"] if final else 0
        frame["terminated"][:] = 0
        frame["truncated"][:] = final
        if self._emit_vehicles:
            kernels.emit_vehicles(
                self.floats,
                self.ints,
                self.flags,
                frame["vehicle_floats"],
                frame["vehicle_ints"],
                frame["vehicle_flags"],
            )
        if "signal" in self.config.emit:
            p, q = self.clock[0].shape
            frame["signal_colour"][:p, :q] = self.clock[0]
            frame["signal_time_left_s"][:p, :q] = self.clock[1]
        if final:
            self._finish()
        frame["approach_metrics"][:] = self.sums
        frame["episode_metrics"][:] = self.episode_sums

    def _finish(self) -> None:
        accounting.book_unfinished(self.rows, self.floats, self.ints, self.flags, self.sums)
        waiting = np.array([int(name) for name in self.session.waiting()], np.int64)
        np.add.at(self.sums[:, METRIC["waiting"]], self.traffic.approach[waiting], 1.0)

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
        frame["signal_colour"][:] = 2
        frame["signal_time_left_s"][:] = 0.0


def make_traffic(context: Context, seed: int, config: EnvConfig) -> tuple[RoadNet, Traffic]:
    """Return the road net and the vehicles of an episode, as a :class:`Simulator` would use them."""
    road = read_road(build_net(context.intersection))
    return road, sample_traffic(context, road, seed, config.horizon_s)
