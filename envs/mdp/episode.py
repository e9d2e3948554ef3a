"""One episode of one environment: its tables, and the few operations on them outside compiled code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.emissions.kernel import KernelWeights
from izoo.envs.config import STEP, EnvConfig
from izoo.envs.mdp.blocked_demand import blocked_s
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.displacement import road_tables
from izoo.envs.mdp.metric_sums import MOVEMENTS, OF_COHORT
from izoo.envs.mdp.signals import clock_tables
from izoo.envs.mdp.slots import admit_vehicle, release_vehicle
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.mdp.state import (
    ENTERED,
    WORLD,
    World,
    constants_of,
    demand_records,
    empty_tables,
    working_memory,
)
from izoo.envs.mdp.step import count_unfinished, make_frame, translate_frame_actions
from izoo.envs.tables import directory
from izoo.errors import IzooError
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

Reading = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Of the members, ``[n]`` each: region lane (int64), lane position in m, speed in m/s (float64), signals (int64)."""


_NO_LANES = np.empty(0, np.int32)


class StepCommands(NamedTuple):
    """Commands to the simulator for the coming step.

    Attributes:
        command, target_mps: rows with a new speed command, which holds until the next one, and the speeds.
        release: rows that are no longer commanded.
        capped, cap_mps: rows with a new maximum speed, which holds until the next one, and the speeds.
    """

    command: np.ndarray
    target_mps: np.ndarray
    release: np.ndarray
    capped: np.ndarray
    cap_mps: np.ndarray


class DemandAtHorizon(NamedTuple):
    """The demand at the horizon, as numbers of vehicles.

    Attributes:
        due: all vehicles whose departure was due.
        dropped: dropped by the simulator before they entered the network.
        waiting: still waiting to enter the network.
        outside: in the network, but not yet in the region.
        early: in the region, or past it, when the warm-up ended.
    """

    due: Sequence[int]
    dropped: Sequence[int] = ()
    waiting: Sequence[int] = ()
    outside: Sequence[int] = ()
    early: Sequence[int] = ()


class Episode:
    """The tables of an episode, bound to the frame that it writes.

    Args:
        config: the environment's settings.
        frame: the arrays of one environment's frame (:func:`izoo.envs.mdp.frame.map_frames`, one row).
        weights: the emission surrogates.
        context, seed, number: what is played.
        road, traffic: the context's net, and the vehicles of the episode.
        entry_lanes: see :class:`~izoo.envs.mdp.state.World`.

    Attributes:
        tables: :class:`~izoo.envs.mdp.state.Tables`.
        world_at: address of the :class:`~izoo.envs.mdp.state.World`, for compiled code.

    Raises:
        IzooError: the intersection has more approaches or exits than the frame has rows.
    """

    def __init__(
        self,
        config: EnvConfig,
        frame: dict[str, np.ndarray],
        weights: KernelWeights,
        context: Context,
        seed: int,
        number: int,
        road: RoadNet,
        traffic: Traffic,
        entry_lanes: np.ndarray = _NO_LANES,
    ) -> None:
        ways = max(road.movement_turn.shape)
        if ways > config.num_approaches:
            raise IzooError(
                f"{context.name} has {len(road.approaches)} approaches and {len(road.exits)} exits, but "
                f"env.num_approaches is {config.num_approaches}; set it to {ways} or more."
            )
        self.config, self.frame = config, frame
        self.context, self.seed, self.number, self.road = context, seed, number, road
        self._yielding = 0
        self._weights = weights
        demand = demand_records(config, context, road, traffic, weights)
        self._world = World(
            tables=empty_tables(config, road, demand),
            work=working_memory(config, road),
            frame=SimpleNamespace(**frame),
            road=road_tables(road),
            clock=clock_tables(road.clock),
            entry_lanes=entry_lanes,
            **constants_of(config, context, road, traffic, weights),
        )
        self.tables = self._world.tables
        self._directory = directory(self._world, WORLD)
        self.world_at = self._directory.ctypes.data

    @property
    def steps(self) -> int:
        """Steps since the first frame."""
        return int(self.tables.episode["steps"])

    @property
    def started_s(self) -> float:
        """Simulated time at the first frame."""
        return float(self.tables.cursor["started_s"])

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return self.started_s + self.steps * self.config.step_s

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return bool(self.frame["done"][0])

    @property
    def between_decisions(self) -> bool:
        """Whether the last decision is complete."""
        return not self.tables.cursor["decision_steps"]

    @property
    def members(self) -> np.ndarray:
        """Rows of the vehicles in the region, ``[n]``, in order of arrival."""
        return self.tables.members[: self.tables.cursor["members"]]

    # The methods below change the tables; they come in the order of a step.

    def admit(self, number: int, accel_mps2: float, counted: bool = True) -> int:
        """Admit a vehicle that has entered the region; return its row (:func:`izoo.envs.mdp.slots.admit`)."""
        row = int(admit_vehicle(self.world_at, number, accel_mps2, counted))
        if not counted:
            # It may be in the junction already, or behind it: the length of its way there follows from its exit.
            approach, leaving = self.tables.vehicles["approach"][row], self.tables.vehicles["exit"][row]
            way = (self.road.lane_approach == approach) & (self.road.lane_exit == leaving)
            self.tables.vehicles["junction_m"][row] = self.road.inside_length_m[way].max(initial=0.0)
        return row

    def is_agent(self, row: int) -> bool:
        """Whether the vehicle of a row has an agent slot."""
        return bool(self.tables.vehicles["agent"][row] >= 0)

    def begin(self, reading: Reading, started_s: float, early: Sequence[int]) -> None:
        """Write the first frame, from the positions of the vehicles that entered during the warm-up.

        Args:
            early: numbers of all vehicles that have entered the region, including those that have left it again.
        """
        self.tables.cursor["started_s"] = started_s
        demand = self.tables.demand
        demand["status"][early], demand["arrival_step"][early], demand["early"][early] = ENTERED, 0, 1
        make_frame(self.world_at, reading, self._weights, started_s, False, False)
        self._write_context()
        for name in ("agent_truncated", "terminated", "truncated", "done", "approach_metrics"):
            self.frame[name][:] = 0

    def resume(self) -> None:
        """Resume an episode whose tables and frame were restored from outside."""
        self._world.work.written[:] = 1

    def commands(self) -> StepCommands:
        """Return the commands for the coming step, from the frame's actions.

        Raises:
            IzooError: the episode has ended.
        """
        if self.over:
            raise IzooError(f"the episode ended after {self.steps} steps; call reset() before the next step.")
        work = self._world.work
        commands, releases, caps = translate_frame_actions(self.world_at)
        return StepCommands(
            *(work.command[:commands], work.target_mps[:commands], work.release[:releases]),
            *(work.capped[:caps], work.cap_mps[:caps]),
        )

    def release(self, row: int) -> None:
        """Remove a vehicle that has left the region from the members."""
        release_vehicle(self.world_at, row)

    def count_collision(self, row: int) -> None:
        """Count a collision; ``row`` is that of the rear vehicle."""
        name = "collisions_cv" if self.tables.vehicles["is_cv"][row] else "collisions_hdv"
        if self.steps < self.config.control_steps:
            self.tables.sums[name][self.tables.vehicles["approach"][row]] += 1
        self.tables.episode["collisions"] += 1

    def write_frame(self, reading: Reading, all_left: Callable[[], bool]) -> np.ndarray:
        """Write the frame after a step, from the members' present positions.

        Args:
            reading: of the members.
            all_left: as for :meth:`end_step`.

        Returns:
            Rows of agents on a lane that does not lead to their exit, for :meth:`mark_yielding`.
        """
        playing_out = self.config.decide != STEP and self.steps >= self.config.control_steps
        time_s = self.started_s + (self.steps + 1) * self.config.step_s
        make_frame(self.world_at, reading, self._weights, time_s, True, playing_out and all_left())
        return self.tables.wrong_lane_agents[: self.tables.cursor["wrong_lane_agents"]]

    def mark_yielding(self, rows: Sequence[int]) -> None:
        """Set which agents the simulator slows for a lane change; they are left to it in the next step."""
        if not self._yielding and not rows:
            return
        if self._yielding:
            self.tables.vehicles["yielding"][self.members] = 0
        self.tables.vehicles["yielding"][rows] = 1
        self._yielding = len(rows)

    def end_step(self, ending: Callable[[], DemandAtHorizon], all_left: Callable[[], bool]) -> None:
        """Complete the sums at the horizon, and the episode when it has been played out.

        Args:
            ending: returns the demand at the horizon; called there.
            all_left: returns whether no vehicle is in the network or will be; called after each decision from
                the horizon on.
        """
        config = self.config
        if self.steps == config.control_steps:
            self._complete_horizon_sums(ending())
        if self.steps < config.control_steps or not self.between_decisions:
            return
        if self.steps == config.total_steps or all_left():
            self._finish()

    @property
    def _sums(self) -> np.ndarray:
        """Metrics of each approach, ``[P, M]``."""
        return self.tables.sums.view(np.float64).reshape(2 * self.config.num_approaches, -1)[
            : self.config.num_approaches
        ]

    def _complete_horizon_sums(self, ending: DemandAtHorizon) -> None:
        """Complete the sums that stop at the horizon."""
        count_unfinished(self.world_at)
        for name, numbers in ending._asdict().items():
            self._add_to_sums(name, np.asarray(numbers, np.int64), 1.0)
        self.frame["approach_metrics"][:] = self._sums

    def _finish(self) -> None:
        """Truncate the agents that are still there, and complete the sums of the cohort."""
        demand, frame = self.tables.demand, self.frame
        times = demand["arrival_step"], demand["earliest_s"]
        blocked = blocked_s(*times, self.started_s, self.steps, self.config.step_s)
        cohort = np.flatnonzero(demand["cohort"])
        self._add_to_sums("cohort", cohort, 1.0)
        self._add_to_sums("cohort_blocked_s", cohort, blocked[cohort])
        self._add_to_sums("cohort_blocked_co2_g", cohort, (blocked * demand["idle_gps"])[cohort])
        frame["agent_truncated"][:] = frame["mask"]
        frame["agent_done"][:] |= frame["mask"]
        frame["truncated"][:] = frame["done"][:] = 1
        frame["approach_metrics"][:] = self._sums

    def _add_to_sums(self, name: str, numbers: np.ndarray, values: np.ndarray | float) -> None:
        """Add values of vehicles of the demand to a sum of their approaches, and of their movements."""
        demand = self.tables.demand[numbers]
        approach = demand["approach"]
        np.add.at(self.tables.sums[name], approach, values)
        if name in OF_COHORT:
            turn = self.road.movement_turn[approach, demand["exit"]]
            values = np.broadcast_to(values, turn.shape)
            for number, movement in enumerate(MOVEMENTS):
                chosen = turn == number
                np.add.at(self.tables.sums[f"{movement}_{name}"], approach[chosen], values[chosen])

    def scene(self) -> Scene:
        """Return copies of the present state."""
        tables, rows = self.tables, self.members
        columns = {name: tables.vehicles[name][rows] for name in (*VEHICLE_FLOATS, *VEHICLE_INTS)}
        columns |= {name: tables.vehicles[name][rows].astype(bool) for name in VEHICLE_FLAGS}
        return Scene(self.context, self.road, self.time_s, columns, tables.signal["colour"].copy(), self._sums.copy())

    def _write_context(self) -> None:
        context, frame = self.context, self.frame
        frame["context_values"][:] = (
            context.adoption,
            context.temperature_c,
            context.humidity_pct,
            ENGINES.index(context.engine),
        )
        frame["context_ids"][:] = (self.number, -1 if context.context_id is None else context.context_id, self.seed)
        frame["approach_mask"][:] = 0
        frame["approach_mask"][: len(self.road.approaches)] = 1
        if "signal" in self.config.emit:
            signal = self.tables.signal
            p, q = signal.shape
            frame["signal_colour"][:], frame["signal_time_left_s"][:] = 2, 0.0
            frame["signal_colour"][:p, :q], frame["signal_time_left_s"][:p, :q] = signal["colour"], signal["change_s"]
