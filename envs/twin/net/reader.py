"""The whole net and the demand of an episode as the twin's arrays."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from izoo.envs.twin.net.best_lanes import tabulate_best_lanes
from izoo.envs.twin.net.conflicts import Ways, find_conflicts
from izoo.envs.twin.net.routes import find_routes
from izoo.envs.twin.net.supported import check_supported
from izoo.envs.twin.net.tables import NetTables, grouped, records
from izoo.envs.twin.runtime.layout import (
    Conflict,
    Driver,
    Edge,
    Fleet,
    Lane,
    Link,
    Phase,
    Program,
    Route,
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
    """A net's arrays, and SUMO's ids of their rows.

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
        lanes, edges = self._lanes_and_edges()
        links = self._links(lanes)
        responses, foes = self._requests(links)
        tables = NetTables(lanes, edges, links, *self._signals())
        routes = find_routes(self.road, self.edge_rows, tables)
        try:
            best = tabulate_best_lanes(tables, routes.route_edges)
        except IzooError as error:
            raise IzooError(f"{self.path}: {error}") from error
        tables.mark_lane_changing()
        numbered = list(enumerate(links))
        ways = Ways(
            tables,
            [lane_shape(lane) for lane in self.lanes],
            [float(lane.get("width", _DEFAULT_WIDTH_M)) for lane in self.lanes],
            {k: set(responses[link.first_response : link.first_response + link.responses]) for k, link in numbered},
            {k: set(foes[link.first_foe : link.first_foe + link.foes]) for k, link in numbered},
        )
        conflicts, wait_foes = find_conflicts(self.root, self.lane_rows, ways)
        played = np.zeros(len(routes.route_edges), Route)
        played["exit_edge"] = [row[row >= 0][-1] for row in routes.route_edges]
        played["first_variant"], played["variants"] = best.variant_first, best.variant_count
        program_first_link, program_links = grouped([link.program for link in links], len(self.programs))
        incoming_start, incoming_links = grouped([link.next_lane for link in links], len(lanes))
        sources = set(routes.route_edges[:, 0].tolist())
        net = TwinNet(
            lanes=records(Lane, lanes),
            edges=records(Edge, edges),
            links=records(Link, links),
            programs=records(Program, tables.programs),
            phases=records(Phase, tables.phases),
            routes=played,
            conflicts=np.array(conflicts, Conflict),
            best=best.best,
            responses=np.array(responses, np.int32),
            foes=np.array(foes, np.int32),
            wait_foes=np.array(wait_foes, np.int32),
            phase_letters=np.frombuffer(tables.phase_letters, np.uint8),
            program_first_link=program_first_link,
            program_links=program_links,
            **routes._asdict(),
            source_lanes=np.array([row for row, lane in enumerate(lanes) if lane.edge in sources], np.int32),
            variant_links=best.variant_links,
            variant_group=best.variant_group,
            variant_bits=best.variant_bits,
            incoming_start=incoming_start,
            incoming_links=incoming_links,
        )
        return TwinWorld(net, tuple(self.lane_rows), tuple(self.edge_rows), tuple(self.program_rows))

    def _lanes_and_edges(self) -> tuple[list[Any], list[Any]]:
        lanes: list[Any] = []
        edges: list[Any] = []
        region = {name: row for row, name in enumerate(self.road.lane_ids)}
        junction_rows = {junction.get("id"): row for row, junction in enumerate(self.junctions)}
        for row, edge in enumerate(self.edges):
            elements = edge.findall("lane")
            first, count = len(lanes), len(elements)
            inside = int(edge.get("function") == "internal")
            edges.append(SimpleNamespace(first_lane=first, lanes=count, inside=inside, changes=0))
            # An inside edge is called ":JUNCTION_NUMBER".
            junction = edge.get("id")[1:].rsplit("_", 1)[0] if inside else edge.get("to")
            lanes += [
                SimpleNamespace(
                    length=float(element.get("length")),
                    limit=float(element.get("speed")),
                    edge=row,
                    index=index,
                    right=first + index - 1 if index > 0 else -1,
                    left=first + index + 1 if index < count - 1 else -1,
                    inside=inside,
                    region=region.get(element.get("id"), -1),
                    junction=junction_rows.get(junction, -1),
                    first_link=0,
                    links=0,
                )
                for index, element in enumerate(elements)
            ]
        return lanes, edges

    def _links(self, lanes: list[Any]) -> list[Any]:
        """Return the links in the order of the lanes on which they begin, and set the links of lanes."""
        by_lane: dict[int, list[Any]] = defaultdict(list)
        for connection in self.root.findall("connection"):
            by_lane[self.lane_rows[f"{connection.get('from')}_{connection.get('fromLane')}"]].append(connection)
        links: list[Any] = []
        for start in sorted(by_lane):
            lanes[start].first_link, lanes[start].links = len(links), len(by_lane[start])
            for connection in by_lane[start]:
                links.append(self._link(connection, start, len(links), lanes[start]))
        for row, link in enumerate(links):
            lane = -1 if lanes[link.from_lane].inside else link.via_lane
            while lane >= 0 and lanes[lane].links:
                onward = links[lanes[lane].first_link]
                onward.entry, lane = row, onward.via_lane
        return links

    def _link(self, connection: Any, start: int, row: int, lane: Any) -> SimpleNamespace:
        to = self.lane_rows[f"{connection.get('to')}_{connection.get('toLane')}"]
        via = self.lane_rows.get(connection.get("via"), -1)
        request = program = signal = -1
        if not lane.inside and via >= 0:
            edge, index = connection.get("via").rsplit("_", 1)
            request = int(edge.rsplit("_", 1)[1]) + int(index)
        if connection.get("tl") is not None:
            program, signal = self.program_rows[connection.get("tl")], int(connection.get("linkIndex"))
        return SimpleNamespace(
            from_lane=start,
            to_lane=to,
            via_lane=via,
            next_lane=via if via >= 0 else to,
            junction=lane.junction,
            request=request,
            cont=0,
            program=program,
            signal=signal,
            state=ord(connection.get("state", "M")),
            direction=ord(connection.get("dir")[0]),
            entry=row,
            **dict.fromkeys(("first_response", "responses", "first_foe", "foes"), 0),
            **dict.fromkeys(("first_conflict", "conflicts", "first_wait", "waits"), 0),
        )

    def _requests(self, links: list[Any]) -> tuple[list[int], list[int]]:
        """Set the links' ranges of responses and foes, which are returned, and whether vehicles may wait inside."""
        at = {(link.junction, link.request): row for row, link in enumerate(links) if link.request >= 0}
        responses: list[int] = []
        foes: list[int] = []
        for number, junction in enumerate(self.junctions):

            def named(bits: str, junction: int = number) -> list[int]:
                keys = [(junction, bit) for bit, flag in enumerate(reversed(bits)) if flag == "1"]
                return [at[key] for key in keys if key in at]

            for request in junction.findall("request"):
                row = at.get((number, int(request.get("index"))))
                if row is None:
                    continue
                link, yields_to, others = links[row], named(request.get("response")), named(request.get("foes"))
                link.cont = int(request.get("cont") == "1")
                link.first_response, link.responses = len(responses), len(yields_to)
                link.first_foe, link.foes = len(foes), len(others)
                responses += yields_to
                foes += others
        return responses, foes

    def _signals(self) -> tuple[list[Any], list[Any], bytes]:
        """Return the rows of programs and phases, and the phases' letters."""
        programs: list[Any] = []
        phases: list[Any] = []
        letters = bytearray()
        for logic in self.programs:
            begin_ms, first = 0, len(phases)
            for phase in logic.findall("phase"):
                phases.append(SimpleNamespace(begin_ms=begin_ms, state=len(letters)))
                letters += phase.get("state").encode("ascii")
                begin_ms += to_ms(float(phase.get("duration")))
            offset_ms = to_ms(offset_s(logic))
            programs.append(
                SimpleNamespace(first_phase=first, phases=len(phases) - first, cycle_ms=begin_ms, offset_ms=offset_ms)
            )
        return programs, phases, bytes(letters)


def twin_traffic(traffic: Traffic, road: RoadNet, net: TwinNet) -> TwinTraffic:
    """Return the demand as SUMO reads it from the route file of :func:`izoo.traffic.sampling.write_routes`."""
    drivers = np.zeros(len(traffic), Driver)
    drivers["length"] = [float(f"{value:g}") for value in traffic.length_m.tolist()]
    rounded = ("min_gap", traffic.min_gap_m), ("tau", traffic.tau_s), ("max_accel", traffic.accel_mps2)
    for name, values in (*rounded, ("decel", traffic.decel_mps2)):
        drivers[name] = [float(f"{value:.4f}") for value in values.tolist()]
    drivers["emergency_decel"] = np.maximum(drivers["decel"], _LEAST_EMERGENCY_DECEL_MPS2)
    drivers["two_root_ab"] = 2.0 * np.sqrt(drivers["max_accel"] * drivers["decel"])
    drivers["depart_speed"] = np.minimum(DEPART_SPEED_MPS, road.speed_limit_mps)[traffic.approach]
    drivers["depart_ms"] = [to_ms(float(f"{value:.3f}")) for value in traffic.depart_s.tolist()]
    drivers["route"] = net.route_of[traffic.approach, traffic.source, traffic.exit]
    drivers["depart_lane"] = net.edges["first_lane"][net.route_edges[drivers["route"], 0]] + traffic.depart_lane
    return TwinTraffic(drivers, _fleet_read(drivers))


def _fleet_read(drivers: np.ndarray) -> np.ndarray:
    """Return :attr:`TwinTraffic.fleet`: extreme parameters of the vehicles that SUMO has read so far, in portions.

    First it reads one; when the last one that it has read is due, on to the first that departs over 200 s after that.
    """
    depart_ms, rows, count, since_ms = drivers["depart_ms"], [], 0, -math.inf
    while count < len(depart_ms):
        # The first vehicle that departs after that is read as well.
        count += 1 + int((depart_ms[count:] <= since_ms + _READ_AHEAD_MS).sum())
        count = min(count, len(depart_ms))
        rows.append((drivers["decel"][:count].min(), drivers["min_gap"][:count].max(), since_ms))
        since_ms = float(depart_ms[count - 1])
    return np.array(rows, Fleet)
