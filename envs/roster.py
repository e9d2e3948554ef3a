"""Who is in the controlled region: a row of the tables for every vehicle, a slot for every CV that is an agent.

Slot rules: a vehicle keeps its row, and a CV its agent slot, from entering the controlled region until it leaves. Rows
and slots freed in a step are handed out again from the next step on, so that a newcomer never stands in a leaver's
place.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Sequence

import numpy as np

from izoo.envs.config import EnvConfig
from izoo.envs.layout import (
    ACCEL,
    AGENT,
    APPROACH,
    COUNTED,
    ELECTRIC,
    ENTRY_M,
    EXIT,
    FRESH,
    IS_CV,
    LENGTH,
    MOVES_CLASS,
    NUM_FLAGS,
    NUM_FLOATS,
    NUM_INTS,
    NUMBER,
    PRESENT,
    REWARD_COLUMNS,
)
from izoo.networks.road import RoadNet
from izoo.traffic.episode import Traffic

MIN_CAPACITY = 256


class Roster:
    """The vehicles of one episode.

    Args:
        config: the environment's settings.
        road: the road net.
        traffic: the episode's demand; a vehicle's name is its number there.
        electric: whether the CVs are electric.

    Attributes:
        floats, ints, flags: ``[C, columns]``, a row per vehicle (:mod:`izoo.envs.layout`); ``C`` grows when needed.
        terms: ``[C, 5]`` individual reward terms; a leaver's are needed once more.
        yields: ``[C]`` whether SUMO slows the vehicle for a lane change.
        names: of the vehicle in each row; what is free may hold an old one.
        row_of: row of each vehicle in the region, by name.
        agent_row: ``[A]`` row behind each agent slot, -1 where it is empty.
        rows, row_names: rows and names of the vehicles that are in the region, in the order in which they came.
    """

    def __init__(self, config: EnvConfig, road: RoadNet, traffic: Traffic, electric: bool) -> None:
        self._road, self._traffic, self._electric = road, traffic, electric
        self._num_vehicles = config.num_vehicles
        capacity = max(MIN_CAPACITY, config.num_vehicles)
        self.floats = np.zeros((capacity, NUM_FLOATS))
        self.ints = np.zeros((capacity, NUM_INTS), np.int64)
        self.flags = np.zeros((capacity, NUM_FLAGS), np.uint8)
        self.terms = np.zeros((capacity, len(REWARD_COLUMNS)))
        self.yields = np.zeros(capacity, np.uint8)
        self.names = [""] * capacity
        self.row_of: dict[str, int] = {}
        self.agent_row = np.full(config.num_agents, -1)
        self._free_rows = list(range(capacity))
        self._free_slots = list(range(config.num_agents))
        self.rows = np.zeros(0, np.int64)
        self.row_names: list[str] = []

    @property
    def capacity(self) -> int:
        """Rows of the tables."""
        return len(self.names)

    @property
    def is_full(self) -> bool:
        """Whether every row is taken; :meth:`grow` before the next vehicle."""
        return not self._free_rows

    def grow(self) -> None:
        """Double the tables, which are other arrays from then on."""
        old = self.capacity
        self.floats, self.ints, self.flags, self.terms, self.yields = (
            np.concatenate([table, np.zeros_like(table)])
            for table in (self.floats, self.ints, self.flags, self.terms, self.yields)
        )
        self.names.extend([""] * old)
        self._free_rows = list(range(old, 2 * old))

    def add(self, name: str, accel_mps2: float, counted: bool) -> int:
        """Give a vehicle that has come a row, and return it.

        Args:
            name: of the vehicle.
            accel_mps2: its acceleration in the last step.
            counted: whether it came while the episode was measured.
        """
        row, number, traffic = heapq.heappop(self._free_rows), int(name), self._traffic
        self.names[row], self.row_of[name], self.yields[row] = name, row, 0
        is_cv, approach = bool(traffic.is_cv[number]), traffic.approach[number]
        flags, floats, ints = self.flags[row], self.floats[row], self.ints[row]
        flags[:] = 0
        flags[PRESENT] = flags[FRESH] = 1
        flags[IS_CV], flags[COUNTED], flags[ELECTRIC] = is_cv, counted, is_cv and self._electric
        floats[:] = 0.0
        floats[LENGTH], floats[ACCEL] = traffic.length_m[number], accel_mps2
        floats[ENTRY_M] = -self._road.lane_length_m[approach]
        ints[NUMBER], ints[MOVES_CLASS] = number, traffic.moves_class[number]
        ints[APPROACH], ints[EXIT] = approach, traffic.exit[number]
        ints[AGENT] = -1
        return row

    def give_slot(self, row: int) -> bool:
        """Make the vehicle of a row an agent; return whether there was a slot, and the row is one that is emitted."""
        if not self._free_slots or row >= self._num_vehicles:
            return False
        slot = heapq.heappop(self._free_slots)
        self.agent_row[slot], self.ints[row, AGENT] = row, slot
        return True

    def list_members(self, gone: Collection[int] = ()) -> None:
        """Set :attr:`rows` and :attr:`row_names` to everybody who has a row, but those that are ``gone``."""
        members = [(row, name) for name, row in self.row_of.items() if row not in gone]
        self.rows = np.array([row for row, _ in members], np.int64)
        self.row_names = [name for _, name in members]

    def extend_members(self, names: Sequence[str]) -> None:
        """Append newcomers to :attr:`rows` and :attr:`row_names`."""
        self.row_names.extend(names)
        self.rows = np.append(self.rows, np.array([self.row_of[name] for name in names], np.int64))

    def release(self, rows: Sequence[int]) -> None:
        """Free the rows of vehicles that have left, and their slots."""
        for row in rows:
            slot = int(self.ints[row, AGENT])
            if slot >= 0:
                heapq.heappush(self._free_slots, slot)
            del self.row_of[self.names[row]]
            self.flags[row] = 0
            heapq.heappush(self._free_rows, row)
