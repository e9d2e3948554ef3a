"""One episode of one environment: its tables, and the few things that happen to them outside compiled code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.emissions.kernel import KernelWeights
from izoo.envs.config import STEP, EnvConfig
from izoo.envs.mdp.blocked_demand import blocked_s
from izoo.envs.mdp.columns import (
    AGENT,
    APPROACH,
    EXIT,
    IS_CV,
    JUNCTION_M,
    VEHICLE_FLAGS,
    VEHICLE_FLOATS,
    VEHICLE_INTS,
    YIELDING,
)
from izoo.envs.mdp.credit import HERE
from izoo.envs.mdp.displacement import road_arrays
from izoo.envs.mdp.metric_sums import EPISODE_METRIC, METRIC, MOVEMENTS, OF_COHORT, book_unfinished
from izoo.envs.mdp.signals import clock_arrays, read_clock
from izoo.envs.mdp.slots import enter, leave
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.mdp.state import (
    HELD,
    MEMBERS,
    SUSPECTS,
    Frame,
    demand_arrays,
    empty_tables,
    grown,
    hold,
    rules_of,
    work_space,
)
from izoo.envs.mdp.step import give_orders, make_frame
from izoo.errors import IzooError
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

Reading = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Region lane, lane position in m, speed in m/s and signal bits, ``[n]`` each."""


class Orders(NamedTuple):
    """What a simulator is told for the coming step.

    Attributes:
        command: rows whose speed is commanded anew; a command holds until the next one.
        target_mps: the speeds.
        release: rows that are no longer commanded.
        capped, cap_mps: rows with a new maximum speed, which stays, and the speeds.
    """

    command: np.ndarray
    target_mps: np.ndarray
    release: np.ndarray
    capped: np.ndarray
    cap_mps: np.ndarray


class Ending(NamedTuple):
    """Vehicles that had not entered the region at the horizon, by their numbers in the demand.

    Attributes:
        due: all whose departure was due.
        dropped: dropped by the simulator before they entered the network.
        waiting: still waiting to enter the network.
        outside: under way to the region.
        early: had been in the region when the warm-up ended.
    """

    due: Sequence[int]
    dropped: Sequence[int]
    waiting: Sequence[int]
    outside: Sequence[int]
    early: Sequence[int]


class Episode:
    """The tables of an episode, bound to the frame that it writes.

    Args:
        config: the environment's settings.
        frame: the arrays of one environment's frame (:func:`izoo.envs.mdp.frame.map_frames`, one row).
        weights: the emission surrogates.
        context, seed, number: what is played.
        road, traffic: the context's net, and the vehicles of the episode.
        capacity: rows that the tables have at least; they grow where a simulator enters vehicles by :meth:`enter`.

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
        capacity: int = 0,
    ) -> None:
        ways = max(road.movement_turn.shape)
        if ways > config.num_approaches:
            raise IzooError(
                f"{context.name} has {len(road.approaches)} approaches and {len(road.exits)} exits, but "
                f"env.num_approaches is {config.num_approaches}; set it to {ways} or more."
            )
        self.config, self.frame = config, frame
        self.context, self.seed, self.number, self.road, self.traffic = context, seed, number, road, traffic
        self.started_s = 0.0
        self._yielding = 0
        self._weights, self._views = weights, Frame(*(frame[name] for name in Frame._fields))
        self._demand = demand_arrays(config, context, road, traffic, weights)
        self._lanes = road_arrays(road)
        self.clock, self._rules = clock_arrays(road.clock), rules_of(config, context, road, traffic, weights)
        self.tables = empty_tables(config, len(road.lane_ids), capacity)
        self._work = work_space(config, len(road.lane_ids))
        self._bind()
        read_clock(0.0, self.clock)

    def _bind(self) -> None:
        """Hand the present tables to compiled code."""
        self.world = hold(
            self.tables, self._work, self._demand, self._lanes, self.clock, self._rules, self._weights, self._views
        )

    @property
    def steps(self) -> int:
        """Steps since the first frame."""
        return int(self.tables.episode[EPISODE_METRIC["steps"]])

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
        """Whether the last decision was played whole."""
        return not self.tables.cursor[HELD]

    @property
    def members(self) -> np.ndarray:
        """Rows of the vehicles in the region, ``[n]``, in the order in which they came."""
        return self.tables.members[: self.tables.cursor[MEMBERS]]

    @property
    def awaited(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What has become of each vehicle of the demand, how many are blocked, and when each came, as of now."""
        return self._demand.fate, self._demand.blocked, self._demand.came

    # The methods below change the tables; they come in the order of a step.

    def enter(self, number: int, accel_mps2: float, counted: bool = True) -> int:
        """Give a vehicle that has come a row, and a CV a slot; return the row (:func:`izoo.envs.mdp.slots.enter`)."""
        row = int(enter(self.world, number, accel_mps2, counted))
        if row < 0:
            self.tables = grown(self.tables)
            self._bind()
            return self.enter(number, accel_mps2, counted)
        if not counted:
            # It may be in the junction already, or behind it: the way that it has come is known from its exit.
            approach, leaving = self.tables.ints[row, APPROACH], self.tables.ints[row, EXIT]
            way = (self.road.lane_approach == approach) & (self.road.lane_exit == leaving)
            self.tables.floats[row, JUNCTION_M] = self.road.inside_length_m[way].max(initial=0.0)
        return row

    def is_agent(self, row: int) -> bool:
        """Whether the vehicle of a row has an agent slot."""
        return bool(self.tables.ints[row, AGENT] >= 0)

    def begin(self, reading: Reading, started_s: float, early: Sequence[int]) -> None:
        """Write the first frame, from the positions of those who entered during the warm-up.

        Args:
            early: numbers of all who came to the region by now, also of those who have left it again.
        """
        self.started_s = started_s
        self._demand.fate[early], self._demand.came[early] = HERE, 0
        make_frame(self.world, reading, started_s, False, False)
        self._write_context()
        for name in ("agent_truncated", "terminated", "truncated", "done", "approach_metrics"):
            self.frame[name][:] = 0

    def go_on(self, started_s: float) -> None:
        """Go on from tables and a frame that were filled from outside, of an episode that began at ``started_s``."""
        self.started_s = started_s
        self._work.shown[:] = 1

    def orders(self) -> Orders:
        """Return what the frame's actions order for the coming step.

        Raises:
            IzooError: the episode has ended.
        """
        if self.over:
            raise IzooError(f"the episode ended after {self.steps} steps; call reset() before the next step.")
        tables = self.tables
        commands, releases, caps = give_orders(self.world)
        return Orders(
            *(tables.command[:commands], tables.target_mps[:commands], tables.release[:releases]),
            *(tables.capped[:caps], tables.cap_mps[:caps]),
        )

    def leave(self, row: int) -> None:
        """Remove a vehicle that has left the region from the members."""
        leave(self.world, row)

    def collide(self, row: int) -> None:
        """Count a collision whose rear vehicle is that of a row."""
        column = METRIC["collisions_cv" if self.tables.flags[row, IS_CV] else "collisions_hdv"]
        if self.steps < self.config.control_steps:
            self.tables.sums[self.tables.ints[row, APPROACH], column] += 1
        self.tables.episode[EPISODE_METRIC["collisions"]] += 1

    def observe(self, reading: Reading, everybody_left: Callable[[], bool]) -> np.ndarray:
        """Write the frame after a step, from the members' present positions.

        Args:
            reading: of the members.
            everybody_left: as for :meth:`end_step`.

        Returns:
            Rows of agents on a lane that does not lead to their exit: :meth:`give_way` says which of them are slowed.
        """
        playing_out = self.config.decide != STEP and self.steps >= self.config.control_steps
        time_s = self.started_s + (self.steps + 1) * self.config.step_s
        make_frame(self.world, reading, time_s, True, playing_out and everybody_left())
        return self.tables.suspects[: self.tables.cursor[SUSPECTS]]

    def give_way(self, rows: Sequence[int]) -> None:
        """Say which agents the simulator slows for a lane change; they are left to it in the next step."""
        if not self._yielding and not rows:
            return
        if self._yielding:
            self.tables.flags[:, YIELDING] = 0
        self.tables.flags[rows, YIELDING] = 1
        self._yielding = len(rows)

    def end_step(self, ending: Callable[[], Ending], everybody_left: Callable[[], bool]) -> None:
        """Complete the sums where the horizon is reached, and the episode where it has been played out.

        Args:
            ending: returns what became of the demand; called at the horizon.
            everybody_left: returns whether no vehicle is in the network or will be; called after each decision from
                the horizon on.
        """
        config = self.config
        if self.steps == config.control_steps:
            self._end_measured_time(ending())
        if self.steps < config.control_steps or not self.between_decisions:
            return
        if self.steps == config.total_steps or everybody_left():
            self._finish()

    def _end_measured_time(self, ending: Ending) -> None:
        """Complete the sums that go to the horizon."""
        tables = self.tables
        book_unfinished(self.members, tables.floats, tables.ints, tables.flags, tables.sums)
        for name, numbers in ending._asdict().items():
            self._book(name, np.asarray(numbers, np.int64), 1.0)
        self.frame["approach_metrics"][:] = tables.sums

    def _finish(self) -> None:
        """Truncate every vehicle that is still there, and complete the sums of the cohort."""
        demand, frame = self._demand, self.frame
        blocked = blocked_s(demand.came, demand.reach_s, self.started_s, self.steps, self.config.step_s)
        cohort = np.flatnonzero(demand.cohort)
        self._book("cohort", cohort, 1.0)
        self._book("cohort_blocked_s", cohort, blocked[cohort])
        self._book("cohort_blocked_co2_g", cohort, (blocked * demand.idle_gps)[cohort])
        frame["agent_truncated"][:] = frame["mask"]
        frame["agent_done"][:] |= frame["mask"]
        frame["truncated"][:] = frame["done"][:] = 1
        frame["approach_metrics"][:] = self.tables.sums

    def _book(self, name: str, numbers: np.ndarray, values: np.ndarray | float) -> None:
        """Add values of some vehicles of the demand to a sum of their approaches, and of their movements."""
        approach = self.traffic.approach[numbers]
        np.add.at(self.tables.sums[:, METRIC[name]], approach, values)
        if name in OF_COHORT:
            turn = self.road.movement_turn[approach, self.traffic.exit[numbers]]
            np.add.at(self.tables.sums, (approach, METRIC[f"{MOVEMENTS[0]}_{name}"] + turn), values)

    def scene(self) -> Scene:
        """Return copies of the present state."""
        tables, rows = self.tables, self.members
        columns = dict(zip(VEHICLE_FLOATS, tables.floats[rows].T, strict=False))
        columns |= zip(VEHICLE_INTS, tables.ints[rows].T, strict=False)
        columns |= zip(VEHICLE_FLAGS, tables.flags[rows].T.astype(bool), strict=False)
        return Scene(self.context, self.road, self.time_s, columns, self.clock.now.copy(), tables.sums.copy())

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
            p, q = self.clock.now.shape
            frame["signal_colour"][:], frame["signal_time_left_s"][:] = 2, 0.0
            frame["signal_colour"][:p, :q], frame["signal_time_left_s"][:p, :q] = self.clock.now, self.clock.time_left_s
