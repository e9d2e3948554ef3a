"""Vehicles placed by hand on the hand-written net, for tests of the kernels: no SUMO takes part."""

from __future__ import annotations

from typing import Any

import numpy as np

from izoo.envs import kernels
from izoo.envs.config import NEIGHBOURS
from izoo.envs.mdp.observation import EGO_FEATURES, NEIGHBOUR_FEATURES
from izoo.envs.mdp.state import APPROACH, EXIT, LENGTH, PRESENT
from izoo.envs.mdp.UNKNOWN_NUM_FLAGS import NUM_FLAGS
from izoo.envs.mdp.UNKNOWN_NUM_FLOATS import NUM_FLOATS
from izoo.envs.mdp.UNKNOWN_NUM_INTS import NUM_INTS
from izoo.networks.road import RoadNet

STEP_S = 0.5
RIGHT_BLINKER, LEFT_BLINKER = 1, 2


class Scene:
    """Tables with room for ``capacity`` vehicles; :meth:`put` adds one, :meth:`look` runs the kernels."""

    def __init__(self, road: RoadNet, capacity: int = 12) -> None:
        self.road, self.lanes = road, kernels.road_arrays(road)
        self.floats = np.zeros((capacity, NUM_FLOATS))
        self.ints = np.zeros((capacity, NUM_INTS), np.int64)
        self.flags = np.zeros((capacity, NUM_FLAGS), np.uint8)
        self.order = np.zeros(capacity, np.int64)
        self.start = np.zeros(len(road.lane_ids) + 1, np.int64)
        self.rows: list[int] = []
        self.reading: list[tuple[int, float, float, int]] = []

    def put(
        self,
        lane: str,
        position: float,
        speed: float = 10.0,
        way: str = "AC",
        length: float = 5.0,
        signals: int = 0,
        row: int | None = None,
    ) -> int:
        """Place a vehicle on its way between two legs with its front bumper at ``position``; return its row."""
        row = len(self.rows) if row is None else row
        self.flags[row, PRESENT] = 1
        self.floats[row, LENGTH] = length
        self.ints[row, APPROACH] = self.road.approaches.index(way[0])
        self.ints[row, EXIT] = self.road.exits.index(way[1])
        self.rows.append(row)
        self.reading.append((self.road.lane_ids.index(lane), position, speed, signals))
        return row

    def move(self, row: int, lane: str, position: float, speed: float) -> None:
        """Change what will be read for a vehicle."""
        signals = self.reading[self.rows.index(row)][3]
        self.reading[self.rows.index(row)] = (self.road.lane_ids.index(lane), position, speed, signals)

    def read(self) -> None:
        """Place, sort and find leaders, as in every step."""
        rows = np.array(self.rows, np.int64)
        lane, position, speed, signals = (np.array(column) for column in zip(*self.reading, strict=True))
        tables = (self.floats, self.ints, self.flags)
        kernels.place(rows, lane, position.astype(float), speed.astype(float), signals, *tables, self.lanes, STEP_S)
        kernels.sort_lanes(rows, self.floats, self.ints, len(self.road.lane_ids), self.order, self.start)
        kernels.find_leaders(rows, *tables, self.order, self.start, self.lanes)

    def look(
        self,
        *agents: int,
        neighbours: tuple[str, ...] = NEIGHBOURS,
        range_m: float = np.inf,
        time_s: float = 7.0,
        features: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the observation ``[A, F]`` of the vehicles in ``agents`` (row -1: an empty slot)."""
        self.read()
        clock = self.road.clock
        shape = clock.colour.shape[:2]
        state = (np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape), np.zeros(shape))
        tables = (clock.phase_begin_s, clock.colour, clock.change_s, clock.second_green_s, clock.third_green_s)
        kernels.read_clock(time_s, clock.cycle_s, clock.offset_s, *tables, *state)
        features = np.zeros((*shape, 0)) if features is None else features
        chosen = np.array([NEIGHBOURS.index(name) for name in neighbours], np.int64)
        width = len(EGO_FEATURES) + len(NEIGHBOUR_FEATURES) * len(chosen) + features.shape[2]
        out = np.full((len(agents), width), np.nan, np.float32)
        tables_ = (self.floats, self.ints, self.flags, self.order, self.start, self.lanes)
        kernels.observe(np.array(agents, np.int64), *tables_, state, features, chosen, float(range_m), out)
        return out

    def see(self, agent: int, **options: Any) -> dict[str, float]:
        """Return the observation of one vehicle by name."""
        neighbours = options.get("neighbours", NEIGHBOURS)
        names = (*EGO_FEATURES, *(f"{who}_{what}" for who in neighbours for what in NEIGHBOUR_FEATURES))
        line = self.look(agent, **options)[0]
        return dict(zip(names, line.tolist(), strict=False))
