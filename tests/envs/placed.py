"""Vehicles placed by hand on the hand-written net, for tests of the compiled functions without SUMO."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from izoo.envs.config import EnvConfig
from izoo.envs.mdp.displacement import road_tables
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.observation import EGO_FEATURES, NEIGHBOUR_FEATURES, NEIGHBOURS, neighbour_columns
from izoo.envs.mdp.observation_kernel import write_observations
from izoo.envs.mdp.signals import clock_tables, read_clock
from izoo.envs.mdp.state import WORLD, Demand, Rules, World, empty_tables, open_world, working_memory
from izoo.envs.mdp.step import update_vehicles
from izoo.envs.tables import compiled, directory
from izoo.networks.road import RoadNet

STEP_S = 0.5
CAPACITY = 64
RIGHT_BLINKER, LEFT_BLINKER = 1, 2
REPORTED = ("region_lane", "lane_position_m", "reported_speed_mps", "signals")


@compiled
def _update(world_at):  # type: ignore[no-untyped-def]
    update_vehicles(open_world(world_at))


@compiled
def _observe(world_at, time_s):  # type: ignore[no-untyped-def]
    world = open_world(world_at)
    read_clock(time_s, world.clock, world.tables.signal)
    write_observations(world)


class Scene:
    """A region with vehicles; :meth:`put` adds one, :meth:`look` runs the compiled functions."""

    def __init__(self, road: RoadNet) -> None:
        self.road = road
        self.tables = empty_tables(EnvConfig(), road, np.zeros(CAPACITY, Demand))
        self.vehicles = self.tables.vehicles
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

    def world(self, agents: tuple[int, ...], columns: np.ndarray, features: np.ndarray, range_m: float) -> World:
        """What compiled code works on, with an observation of NaN."""
        config, rules = EnvConfig(num_agents=max(len(agents), 1)), np.zeros((), Rules)
        rules["step_s"], rules["sensor_range_m"] = STEP_S, range_m
        frame = row_of(map_frames(bytearray(frame_bytes(config, 1)), config, 1), 0)
        seen = int((columns >= 0).sum())
        width = len(EGO_FEATURES) + len(NEIGHBOUR_FEATURES) * seen + features.shape[-1]
        frame["observation"] = np.full((len(agents), width), np.nan, np.float32)
        none = np.zeros(0)
        return World(
            tables=self.tables._replace(agent_row=np.array(agents, np.int64)),
            work=working_memory(config, self.road),
            frame=SimpleNamespace(**frame),
            road=road_tables(self.road),
            clock=clock_tables(self.road.clock),
            rules=rules,
            weights=none,
            shared_weights=none,
            unit_g=none,
            exit_limit_mps=none,
            neighbour_columns=columns,
            features=np.ascontiguousarray(features.reshape(self.road.movement_turn.size, features.shape[-1])),
            by_earliest=none.astype(np.int64),
            entry_lanes=none.astype(np.int32),
        )

    def read(self, world: World | None = None) -> None:
        """Place, sort and find leaders, as in every step."""
        for name, column in zip(REPORTED, zip(*self.reading, strict=True), strict=True):
            self.vehicles[name][self.rows] = column
        self.tables.members[: len(self.rows)] = self.rows
        self.tables.cursor["members"] = len(self.rows)
        if world is None:
            world = self.world((), neighbour_columns(()), np.zeros((self.road.movement_turn.size, 0)), np.inf)
        words = directory(world, WORLD)
        _update(words.ctypes.data)

    def look(
        self,
        *agents: int,
        neighbours: tuple[str, ...] = NEIGHBOURS,
        range_m: float = np.inf,
        time_s: float = 7.0,
        features: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the observation ``[A, F]`` of the vehicles in ``agents`` (row -1: an empty slot)."""
        features = np.zeros((*self.road.movement_turn.shape, 0)) if features is None else features
        world = self.world(agents, neighbour_columns(neighbours), features, float(range_m))
        self.read(world)
        words = directory(world, WORLD)
        _observe(words.ctypes.data, time_s)
        return world.frame.observation

    def see(self, agent: int, **options: Any) -> dict[str, float]:
        """Return the observation of one vehicle by name."""
        neighbours = options.get("neighbours", NEIGHBOURS)
        names = (*EGO_FEATURES, *(f"{which}_{what}" for which in neighbours for what in NEIGHBOUR_FEATURES))
        line = self.look(agent, **options)[0]
        return dict(zip(names, line.tolist(), strict=False))
