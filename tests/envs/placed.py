"""Vehicles placed by hand on the hand-written net, for tests of the compiled functions without SUMO."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from izoo.envs.mdp.columns import Vehicle
from izoo.envs.mdp.displacement import road_arrays, update_motion
from izoo.envs.mdp.neighbours import find_leaders, sort_lanes
from izoo.envs.mdp.observation import EGO_FEATURES, NEIGHBOUR_FEATURES, NEIGHBOURS, neighbour_columns
from izoo.envs.mdp.observation_kernel import write_observations
from izoo.envs.mdp.signals import clock_arrays, read_clock
from izoo.networks.road import RoadNet

STEP_S = 0.5
RIGHT_BLINKER, LEFT_BLINKER = 1, 2


class Tables(NamedTuple):
    """The tables that observations are made from."""

    vehicles: np.ndarray
    order: np.ndarray
    lane_start: np.ndarray


class Sensors(NamedTuple):
    """The parts of an episode's rules that observations depend on."""

    features: np.ndarray
    columns: np.ndarray
    sensor_range_m: float


class Scene:
    """Tables with room for ``capacity`` vehicles; :meth:`put` adds one, :meth:`look` runs the kernels."""

    def __init__(self, road: RoadNet, capacity: int = 12) -> None:
        self.road, self.lanes = road, road_arrays(road)
        self.vehicles = np.zeros(capacity, Vehicle)
        starts = np.zeros(len(road.lane_ids) + 1, np.int64)
        self.tables = Tables(self.vehicles, np.zeros(capacity, np.int64), starts)
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
        self.vehicles["present"][row] = 1
        self.vehicles["length_m"][row] = length
        self.vehicles["approach"][row] = self.road.approaches.index(way[0])
        self.vehicles["exit"][row] = self.road.exits.index(way[1])
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
        update_motion(
            rows, (lane, position.astype(float), speed.astype(float), signals), self.vehicles, self.lanes, STEP_S
        )
        sort_lanes(rows, self.tables, np.zeros(len(self.road.lane_ids), np.int64))
        find_leaders(rows, self.tables, self.lanes)

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
        clock = clock_arrays(self.road.clock)
        read_clock(time_s, clock)
        shape = clock.now.shape
        features = np.zeros((*shape, 0)) if features is None else features
        width = len(EGO_FEATURES) + len(NEIGHBOUR_FEATURES) * len(neighbours) + features.shape[2]
        out = np.full((len(agents), width), np.nan, np.float32)
        sensors = Sensors(features, neighbour_columns(neighbours), float(range_m))
        slots, written = np.array(agents, np.int64), np.ones(len(agents), np.uint8)
        write_observations(slots, written, self.tables, self.lanes, clock, sensors, out)
        return out

    def see(self, agent: int, **options: Any) -> dict[str, float]:
        """Return the observation of one vehicle by name."""
        neighbours = options.get("neighbours", NEIGHBOURS)
        names = (*EGO_FEATURES, *(f"{which}_{what}" for which in neighbours for what in NEIGHBOUR_FEATURES))
        line = self.look(agent, **options)[0]
        return dict(zip(names, line.tolist(), strict=False))
