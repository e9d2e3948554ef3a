"""The whole net and the demand of an episode as the twin's arrays."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from izoo.envs.twin.lane_change.neighbours import incoming_links_of, mark_lane_changing
from izoo.envs.twin.net.best_lanes import Signals, tabulate_best_lanes
from izoo.envs.twin.net.conflicts import Ways, find_conflicts
from izoo.envs.twin.net.routes import find_routes
from izoo.envs.twin.net.supported import check_supported
from izoo.envs.twin.net.tables import NetTables
from izoo.envs.twin.runtime.layout import (
    EDGE_FIRST_LANE,
    EDGE_INSIDE,
    EDGE_LANES,
    LANE_EDGE,
    LANE_FIRST_LINK,
    LANE_INDEX,
    LANE_INSIDE,
    LANE_JUNCTION,
    LANE_LEFT,
    LANE_LINKS,
    LANE_REGION,
    LANE_RIGHT,
    LINK_CONT,
    LINK_DIRECTION,
    LINK_ENTRY,
    LINK_FIRST_FOE,
    LINK_FIRST_RESPONSE,
    LINK_FOES,
    LINK_FROM,
    LINK_JUNCTION,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_REQUEST,
    LINK_RESPONSES,
    LINK_SIGNAL,
    LINK_STATE,
    LINK_TO,
    LINK_VIA,
    PHASE_BEGIN_MS,
    PHASE_STATE,
    PROGRAM_CYCLE_MS,
    PROGRAM_FIRST_PHASE,
    PROGRAM_OFFSET_MS,
    PROGRAM_PHASES,
    TwinNet,
    TwinTraffic,
)
from izoo.errors import IzooError
from izoo.networks.clock import to_ms
from izoo.networks.representable import offset_s
from izoo.networks.road import RoadNet, lane_shape, parse_net
from izoo.traffic.sampling import DEPART_SPEED_MPS, Traffic

_DEFAULT_WIDTH_M = 3.2
_LEAST_EMERGENCY_DECEL_MPS2 = 9.0
_READ_AHEAD_MS = 200_000


@dataclass(frozen=True)
class TwinWorld:
    """A net's arrays, and the SUMO's ids of their rows.

    Attributes:
        net: the arrays.
        lane_ids, edge_ids, program_ids: names of lanes, edges and signals.
    """

    net: TwinNet
    lane_ids: tuple[str, ...]
    edge_ids: tuple[str, ...]
    program_ids: tuple[str, ...]


def read_twin_world(road: RoadNet, net_path: str | Path) -> TwinWorld:
    """Return the arrays of a net with the names of their rows; the last few dozen are kept in memory.

    Raises:
        IzooError: the file is not the one of ``road``, or the net has something that the twin cannot play.
    """
    return _read(_Hashed(road), str(net_path))


class _Hashed:
    """A road, hashed by the digest of its file."""

    def __init__(self, road: RoadNet) -> None:
        self.road = road

    def __hash__(self) -> int:
        return hash(self.road.sha256)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Hashed) and other.road.sha256 == self.road.sha256


@functools.lru_cache(maxsize=64)
def _read(hashed: _Hashed, net_path: str) -> TwinWorld:
    return _Reader(parse_net(Path(net_path).read_bytes(), net_path), hashed.road, net_path).read()


class _Reader:
    """Working tables of one read; only :meth:`read` is called from outside."""

    def __init__(self, root: Any, road: RoadNet, path: str) -> None:
        self.root, self.road, self.path = root, road, path
        self.edges = [edge for edge in root.findall("edge") if edge.findall("lane")]
        self.edge_rows = {edge.get("id"): row for row, edge in enumerate(self.edges)}
        self.lanes = [lane for edge in self.edges for lane in edge.findall("lane")]
        self.lane_rows = {lane.get("id"): row for row, lane in enumerate(self.lanes)}
        self.junctions = root.findall("junction")
        # Of several programs of a signal SUMO plays the last.
        programs = {logic.get("id"): logic for logic in root.findall("tlLogic")}
        self.programs = list(programs.values())
        self.program_rows = {name: row for row, name in enumerate(programs)}

    def read(self) -> TwinWorld:
        check_supported(self.root, self.path)
        lane_floats = np.array([[float(lane.get("length")), float(lane.get("speed"))] for lane in self.lanes])
        lane_ints, edge_ints = self._lanes_and_edges()
        connections = self._connections()
        link_ints = self._links(connections, lane_ints)
        responses, foes = self._requests(link_ints)
        programs, phases, letters = self._signals()
        signal_links = np.flatnonzero(link_ints[:, LINK_PROGRAM] >= 0)
        shown = link_ints[signal_links, LINK_PROGRAM]
        shown_order = np.argsort(shown, kind="stable")
        tables = NetTables(lane_floats, lane_ints, edge_ints, link_ints)
        routes = find_routes(self.road, self.edge_rows, tables)
        try:
            best = tabulate_best_lanes(tables, Signals(programs, phases, letters), routes.route_edges)
        except IzooError as error:
            raise IzooError(f"{self.path}: {error}") from error
        mark_lane_changing(edge_ints, lane_floats, lane_ints, link_ints)
        incoming = incoming_links_of(link_ints, len(self.lanes))
        shapes = [lane_shape(lane) for lane in self.lanes]
        width_m = np.array([float(lane.get("width", _DEFAULT_WIDTH_M)) for lane in self.lanes])
        net = TwinNet(
            lane_floats=lane_floats,
            lane_ints=lane_ints,
            edge_ints=edge_ints,
            link_ints=link_ints,
            responses=responses,
            foes=foes,
            program_ints=programs,
            phase_ints=phases,
            phase_letters=letters,
            program_first_link=np.searchsorted(shown[shown_order], np.arange(len(self.programs) + 1)).astype(np.int32),
            program_links=signal_links[shown_order].astype(np.int32),
            **routes._asdict(),
            route_exit_edge=np.array([row[row >= 0][-1] for row in routes.route_edges], np.int32),
            source_lanes=np.flatnonzero(np.isin(lane_ints[:, LANE_EDGE], routes.route_edges[:, 0])).astype(np.int32),
            **best._asdict(),
            incoming_start=incoming[0],
            incoming_links=incoming[1],
            **self._conflicts(lane_floats, lane_ints, link_ints, shapes, width_m, responses, foes),
        )
        return TwinWorld(net, tuple(self.lane_rows), tuple(self.edge_rows), tuple(self.program_rows))

    def _lanes_and_edges(self) -> tuple[np.ndarray, np.ndarray]:
        lane_rows: list[list[int]] = []
        edge_rows: list[list[int]] = []
        region = {name: row for row, name in enumerate(self.road.lane_ids)}
        junction_rows = {junction.get("id"): row for row, junction in enumerate(self.junctions)}
        for row, edge in enumerate(self.edges):
            first, count = len(lane_rows), len(edge.findall("lane"))
            inside = int(edge.get("function") == "internal")
            edge_rows.append(_row(4, 0, {EDGE_FIRST_LANE: first, EDGE_LANES: count, EDGE_INSIDE: inside}))
            # An inside edge is called ":JUNCTION_NUMBER".
            junction = edge.get("id")[1:].rsplit("_", 1)[0] if inside else edge.get("to")
            for index in range(count):
                lane = first + index
                values = {
                    LANE_EDGE: row,
                    LANE_INDEX: index,
                    LANE_INSIDE: inside,
                    LANE_RIGHT: lane - 1 if index > 0 else -1,
                    LANE_LEFT: lane + 1 if index < count - 1 else -1,
                    LANE_REGION: region.get(self.lanes[lane].get("id"), -1),
                    LANE_JUNCTION: junction_rows.get(junction, -1),
                    LANE_FIRST_LINK: 0,
                    LANE_LINKS: 0,
                }
                lane_rows.append(_row(9, -1, values))
        return np.array(lane_rows, np.int32), np.array(edge_rows, np.int32)

    def _connections(self) -> list[Any]:
        by_lane: dict[int, list[Any]] = defaultdict(list)
        for connection in self.root.findall("connection"):
            by_lane[self.lane_rows[f"{connection.get('from')}_{connection.get('fromLane')}"]].append(connection)
        return [connection for lane in sorted(by_lane) for connection in by_lane[lane]]

    def _links(self, connections: list[Any], lane_ints: np.ndarray) -> np.ndarray:
        rows: list[list[int]] = []
        lanes = lane_ints.tolist()
        for row, connection in enumerate(connections):
            start = self.lane_rows[f"{connection.get('from')}_{connection.get('fromLane')}"]
            via = self.lane_rows.get(connection.get("via"), -1)
            to = self.lane_rows[f"{connection.get('to')}_{connection.get('toLane')}"]
            values = {
                LINK_FROM: start,
                LINK_TO: to,
                LINK_VIA: via,
                LINK_NEXT: via if via >= 0 else to,
                LINK_JUNCTION: lanes[start][LANE_JUNCTION],
                LINK_ENTRY: row,
                LINK_CONT: 0,
                LINK_STATE: ord(connection.get("state", "M")),
                LINK_DIRECTION: ord(connection.get("dir")[0]),
            }
            if not lanes[start][LANE_INSIDE] and via >= 0:
                edge, index = connection.get("via").rsplit("_", 1)
                values[LINK_REQUEST] = int(edge.rsplit("_", 1)[1]) + int(index)
            if connection.get("tl") is not None:
                values[LINK_PROGRAM] = self.program_rows[connection.get("tl")]
                values[LINK_SIGNAL] = int(connection.get("linkIndex"))
            rows.append(_row(16, -1, values))
        links = np.array(rows, np.int32).reshape(-1, 16)
        starts = np.arange(len(lane_ints))
        first = np.searchsorted(links[:, LINK_FROM], starts)
        count = np.searchsorted(links[:, LINK_FROM], starts, "right") - first
        lane_ints[:, LANE_FIRST_LINK], lane_ints[:, LANE_LINKS] = np.where(count > 0, first, 0), count
        self._name_entries(links, lane_ints)
        return links

    @staticmethod
    def _name_entries(links: np.ndarray, lane_ints: np.ndarray) -> None:
        """Set the entry link of every link inside a junction."""
        rows, lanes = links.tolist(), lane_ints.tolist()
        for row, link in enumerate(rows):
            lane = -1 if lanes[link[LINK_FROM]][LANE_INSIDE] else link[LINK_VIA]
            while lane >= 0 and lanes[lane][LANE_LINKS]:
                onward = lanes[lane][LANE_FIRST_LINK]
                links[onward, LINK_ENTRY] = row
                lane = rows[onward][LINK_VIA]

    def _requests(self, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fill the links' ranges of responses and foes, and whether vehicles may wait inside."""
        numbers = links[:, [LINK_JUNCTION, LINK_REQUEST]].tolist()
        at = {(junction, request): row for row, (junction, request) in enumerate(numbers) if request >= 0}
        lists: tuple[list[int], list[int]] = ([], [])
        links[:, [LINK_FIRST_RESPONSE, LINK_RESPONSES, LINK_FIRST_FOE, LINK_FOES]] = 0
        columns = (("response", LINK_FIRST_RESPONSE, LINK_RESPONSES), ("foes", LINK_FIRST_FOE, LINK_FOES))
        for number, junction in enumerate(self.junctions):
            for request in junction.findall("request"):
                row = at.get((number, int(request.get("index"))))
                if row is None:
                    continue
                links[row, LINK_CONT] = request.get("cont") == "1"
                for rows, (name, first, count) in zip(lists, columns, strict=True):
                    bits = [bit for bit, flag in enumerate(reversed(request.get(name))) if flag == "1"]
                    found = [at[number, bit] for bit in bits if (number, bit) in at]
                    links[row, first], links[row, count] = len(rows), len(found)
                    rows += found
        return np.array(lists[0], np.int32), np.array(lists[1], np.int32)

    def _conflicts(
        self,
        lane_floats: np.ndarray,
        lane_ints: np.ndarray,
        link_ints: np.ndarray,
        shapes: list[np.ndarray],
        width_m: np.ndarray,
        responses: np.ndarray,
        foes: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Return the tables of :class:`~izoo.envs.twin.net.conflicts.Conflicts` under their names in the net."""

        def ranges(rows: np.ndarray, first: int, count: int) -> dict[int, set[int]]:
            values = rows.tolist()
            return {k: set(values[link[first] : link[first] + link[count]]) for k, link in enumerate(links)}

        links = link_ints.tolist()

        ways = Ways(
            lane_floats,
            lane_ints,
            link_ints,
            shapes,
            width_m,
            ranges(responses, LINK_FIRST_RESPONSE, LINK_RESPONSES),
            ranges(foes, LINK_FIRST_FOE, LINK_FOES),
        )
        found = find_conflicts(self.root, self.lane_rows, ways)._asdict()
        return {name if name.startswith("wait") else f"conflict_{name}": rows for name, rows in found.items()}

    def _signals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        programs = np.zeros((len(self.programs), 4), np.int64)
        phases: list[tuple[int, int]] = []
        letters = bytearray()
        for row, logic in enumerate(self.programs):
            begin_ms = 0
            programs[row, PROGRAM_FIRST_PHASE] = len(phases)
            for phase in logic.findall("phase"):
                entry = [0, 0]
                entry[PHASE_BEGIN_MS], entry[PHASE_STATE] = begin_ms, len(letters)
                phases.append((entry[0], entry[1]))
                letters += phase.get("state").encode("ascii")
                begin_ms += to_ms(float(phase.get("duration")))
            programs[row, PROGRAM_PHASES] = len(phases) - programs[row, PROGRAM_FIRST_PHASE]
            programs[row, PROGRAM_CYCLE_MS] = begin_ms
            programs[row, PROGRAM_OFFSET_MS] = to_ms(offset_s(logic))
        return programs, np.array(phases, np.int64).reshape(-1, 2), np.frombuffer(bytes(letters), np.uint8)


def _row(size: int, rest: int, values: dict[int, int]) -> list[int]:
    """Return a row with values by column, and ``rest`` in the other columns."""
    return [values.get(column, rest) for column in range(size)]


def twin_traffic(traffic: Traffic, road: RoadNet, net: TwinNet) -> TwinTraffic:
    """Return the demand as SUMO reads it from the route file of :func:`izoo.traffic.sampling.write_routes`."""
    length = np.array([float(f"{value:g}") for value in traffic.length_m.tolist()])
    min_gap, tau, accel, decel = (
        np.array([float(f"{value:.4f}") for value in column.tolist()])
        for column in (traffic.min_gap_m, traffic.tau_s, traffic.accel_mps2, traffic.decel_mps2)
    )
    speed = np.minimum(DEPART_SPEED_MPS, road.speed_limit_mps)[traffic.approach]
    emergency = np.maximum(decel, _LEAST_EMERGENCY_DECEL_MPS2)
    floats = np.stack([length, min_gap, tau, accel, decel, emergency, 2.0 * np.sqrt(accel * decel), speed], axis=1)
    depart_ms = np.array([to_ms(float(f"{value:.3f}")) for value in traffic.depart_s.tolist()], np.int64)
    route = net.route_of[traffic.approach, traffic.source, traffic.exit].astype(np.int64)
    lane = net.edge_ints[net.route_edges[route, 0], EDGE_FIRST_LANE] + traffic.depart_lane
    fleet = _fleet_read(depart_ms, decel, min_gap)
    return TwinTraffic(floats.reshape(-1, 8), np.stack([depart_ms, route, lane], axis=1), fleet)


def _fleet_read(depart_ms: np.ndarray, decel: np.ndarray, min_gap: np.ndarray) -> np.ndarray:
    """Return :attr:`TwinTraffic.fleet`: extreme parameters of the vehicles that SUMO has read so far, in portions.

    First it reads one; when the last one that it has read is due, on to the first that departs over 200 s after that.
    """
    rows, count, since_ms = [], 0, -math.inf
    while count < len(depart_ms):
        # The first vehicle that departs after that is read as well.
        count += 1 + int((depart_ms[count:] <= since_ms + _READ_AHEAD_MS).sum())
        count = min(count, len(depart_ms))
        rows.append([decel[:count].min(), min_gap[:count].max(), since_ms])
        since_ms = float(depart_ms[count - 1])
    return np.array(rows, np.float64).reshape(-1, 3)
