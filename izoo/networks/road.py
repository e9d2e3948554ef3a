"""Reads a SUMO net of one intersection into arrays: lanes of the controlled region, movements, and the signal clock.

Lanes that are closed to cars (sidewalks, cycle lanes, bus lanes) are left out, and counted nowhere.
Vehicles are located by an integer lane. ``P`` counts approaches (legs with incoming lanes), ``Q`` exits (legs with
outgoing lanes), ``L`` lanes of the controlled region, ``K`` phases of the main signal. Conventions of the nets are
those of the published dataset (junction ``TL``, edges ``A2TL``, ``A2TL_intern``, ``TL2A``, sources ``AB2A`` and
``AA2A``).
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from izoo.errors import IzooError
from izoo.networks.clock import SignalClock, read_clock
from izoo.networks.representable import check_representable, lane_number, open_connections, open_lanes
from izoo.networks.turning import LEFT, RIGHT, STRAIGHT

APPROACHING, INSIDE, LEAVING = 0, 1, 2
TURN_OF_DIRECTION = {"r": RIGHT, "R": RIGHT, "s": STRAIGHT, "l": LEFT, "L": LEFT, "t": LEFT}
_LANE_COLUMNS: dict[str, Any] = {
    **{"lane_location": np.int8, "lane_edge": np.int32, "lane_index": np.int32, "lane_siblings": np.int32},
    **{"lane_length": np.float64, "lane_limit_mps": np.float64, "lane_approach": np.int32, "lane_exit": np.int32},
    **{"lane_offset_m": np.float64, "inside_length_m": np.float64},
}
_REGION_EDGE = re.compile(r"([A-Z])2TL(?:_intern)?|TL2([A-Z])")


@dataclass(frozen=True)
class RoadNet:
    """The controlled region of one net; see the module's docstring for the dimensions.

    Attributes:
        path, sha256: the net file and its digest.
        approaches: ``P`` leg names with incoming lanes, in letter order.
        exits: ``Q`` leg names with outgoing lanes, in letter order.
        incoming_edges: per approach, its edges from outside to the stop line.
        outgoing_edge: per exit, its edge.
        sources: per approach, the existing source edges by kind: ``AB`` (from straight on), ``AA`` (turning in).
        source_lanes: per approach, the lanes of those edges, by SUMO's index.
        source_length_m: per approach, the lengths of those edges.
        main_lane_count: ``[P]`` lanes where the approach begins.
        lane_count: ``[P]`` lanes at the stop line.
        lane_length_m: ``[P]`` from the beginning of the approach to the stop line.
        speed_limit_mps: ``[P]``.
        grade: ``[P]`` mean rise over run towards the stop line.
        movement_turn: ``[P, Q]`` int8: 0 right, 1 straight, 2 left, -1 where there is no such movement.
        movement_links: ``[P, Q]`` number of lane connections at the stop line.
        clock: the fixed-time plan of the main signal, by movement.
        lane_ids: ``L`` SUMO lane ids.
        lane_location: ``[L]`` 0 approaching, 1 inside the junction, 2 leaving.
        lane_edge: ``[L]`` number of the edge; lanes of one edge are neighbours.
        lane_index: ``[L]`` 0 is the rightmost lane of its edge that is open to cars.
        lane_siblings: ``[L]`` such lanes on the same edge.
        lane_length: ``[L]`` m.
        lane_limit_mps: ``[L]``.
        lane_approach, lane_exit: ``[L]`` -1 where the lane does not tell.
        lane_offset_m: ``[L]`` path position of the lane's beginning: negative before the stop line, distance travelled
            inside the junction, 0 for leaving lanes (the junction's length is added per vehicle).
        inside_length_m: ``[L]`` length of the whole way through the junction that an inside lane belongs to.
        next_lane: ``[L, Q]`` the lane after this one on the way to an exit, -1 where it does not lead there.
        prev_lane: ``[L, P]`` the lane before this one on the way from an approach, -1 where there is none.
        lane_right, lane_left: ``[L]`` the neighbouring lane or -1.
        segment_start: ``[L + 1]`` where a lane's segments begin in the next two arrays.
        segment_from_m: lane position at which a straight piece of the lane begins.
        segment_grade_pct: its grade in percent along the driving direction.
        shape_points_m: ``[n, 3]`` geometry of the lanes, one behind the other.
        shape_start: ``[L + 1]`` where a lane's points begin.
    """

    path: str
    sha256: str
    approaches: tuple[str, ...]
    exits: tuple[str, ...]
    incoming_edges: tuple[tuple[str, ...], ...]
    outgoing_edge: tuple[str, ...]
    sources: tuple[dict[str, str], ...]
    source_lanes: tuple[dict[str, tuple[int, ...]], ...]
    source_length_m: tuple[dict[str, float], ...]
    main_lane_count: np.ndarray
    lane_count: np.ndarray
    lane_length_m: np.ndarray
    speed_limit_mps: np.ndarray
    grade: np.ndarray
    movement_turn: np.ndarray
    movement_links: np.ndarray
    clock: SignalClock
    lane_ids: tuple[str, ...]
    lane_location: np.ndarray
    lane_edge: np.ndarray
    lane_index: np.ndarray
    lane_siblings: np.ndarray
    lane_length: np.ndarray
    lane_limit_mps: np.ndarray
    lane_approach: np.ndarray
    lane_exit: np.ndarray
    lane_offset_m: np.ndarray
    inside_length_m: np.ndarray
    next_lane: np.ndarray
    prev_lane: np.ndarray
    lane_right: np.ndarray
    lane_left: np.ndarray
    segment_start: np.ndarray
    segment_from_m: np.ndarray
    segment_grade_pct: np.ndarray
    shape_points_m: np.ndarray = field(repr=False)
    shape_start: np.ndarray = field(repr=False)

    @property
    def shapes(self) -> list[np.ndarray]:
        """``L`` arrays ``[n, 3]`` of lane geometry in m."""
        return np.split(self.shape_points_m, self.shape_start[1:-1])


def read_road(path: str | Path) -> RoadNet:
    """Read a net file; the last few dozen are kept in memory, keyed by path and modification time.

    Raises:
        IzooError: the file is missing, is not a SUMO net, has no signal ``TL`` with incoming and outgoing legs, or has
            what cannot be represented (:mod:`izoo.networks.representable`).
    """
    path = Path(path)
    try:
        stamp = path.stat().st_mtime_ns
    except OSError as error:
        raise IzooError(f"cannot read the net {path}: {error.strerror}; give the path of a SUMO net file.") from error
    return _read_road(str(path), stamp)


@functools.lru_cache(maxsize=64)
def _read_road(path: str, _stamp: int) -> RoadNet:
    data = Path(path).read_bytes()
    root = parse_net(data, path)
    check_representable(root, path)
    try:
        return NetReader(root, path, hashlib.sha256(data).hexdigest()).read()
    except IzooError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise IzooError(f"{path} is not a complete SUMO net ({error!r}); fetch the file again.") from error


@functools.lru_cache(maxsize=1)
def parse_net(data: bytes, path: str | Path) -> Any:
    """Parse XML of a net, refusing entities and whatever is not a SUMO net; the last one is kept."""
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, DefusedXmlException, LookupError, ValueError) as error:  # or an unknown encoding
        raise IzooError(f"{path} is not well-formed XML ({error}); fetch the file again.") from error
    if root.tag != "net":
        raise IzooError(f"{path} is not a SUMO net: its root element is <{root.tag}>; a <net> is needed.")
    return root


class NetReader:
    """Working tables of one read."""

    def __init__(self, root: Any, path: str, sha256: str) -> None:
        self.root, self.path, self.sha256 = root, path, sha256
        self.edges = open_lanes(root)
        self.connections: dict[tuple[str, int], list[Any]] = defaultdict(list)
        for connection in open_connections(root):
            self.connections[connection.get("from"), int(connection.get("fromLane"))].append(connection)
        self.approaches = tuple(sorted(name[0] for name in self.edges if re.fullmatch(r"[A-Z]2TL", name)))
        self.exits = tuple(sorted(name[3] for name in self.edges if re.fullmatch(r"TL2[A-Z]", name)))
        if not self.approaches or not self.exits:
            raise IzooError(
                f"{path} has no junction TL with incoming edges such as A2TL and outgoing ones such as TL2A; "
                "only nets in the published dataset's convention can be read."
            )
        self.incoming = tuple(
            tuple(edge for edge in (f"{leg}2TL", f"{leg}2TL_intern") if edge in self.edges) for leg in self.approaches
        )
        self.lanes: dict[str, int] = {}
        self.rows: list[dict[str, Any]] = []

    def read(self) -> RoadNet:
        for p, edges in enumerate(self.incoming):
            for edge in edges:
                self._add_edge(edge, APPROACHING, p, -1)
        for q, leg in enumerate(self.exits):
            self._add_edge(f"TL2{leg}", LEAVING, -1, q)
        turn, links = self._walk_movements()
        self._walk_splits()
        self._approach_offsets()
        first = [self.edges[edges[0]] for edges in self.incoming]
        sources = [self._sources(leg) for leg in self.approaches]
        return RoadNet(
            path=self.path,
            sha256=self.sha256,
            approaches=self.approaches,
            exits=self.exits,
            incoming_edges=self.incoming,
            outgoing_edge=tuple(f"TL2{leg}" for leg in self.exits),
            sources=tuple(sources),
            source_lanes=tuple(
                {kind: tuple(map(lane_number, self.edges[edge])) for kind, edge in of.items()} for of in sources
            ),
            source_length_m=tuple(
                {kind: float(self.edges[edge][0].get("length")) for kind, edge in of.items()} for of in sources
            ),
            main_lane_count=np.array([len(lanes) for lanes in first]),
            lane_count=np.array([len(self.edges[edges[-1]]) for edges in self.incoming]),
            lane_length_m=np.array([-self.rows[self.lanes[lanes[0].get("id")]]["lane_offset_m"] for lanes in first]),
            speed_limit_mps=np.array([float(lanes[0].get("speed")) for lanes in first]),
            grade=np.array([_grade(lane_shape(lanes[0])) for lanes in first]),
            movement_turn=turn,
            movement_links=links,
            clock=read_clock(self.root, self.signal_links(), self.path),
            lane_ids=tuple(self.lanes),
            **{name: np.array([row[name] for row in self.rows], dtype) for name, dtype in _LANE_COLUMNS.items()},
            **self._successors(),
            **self._neighbours(),
            **self._segments(),
            shape_points_m=np.concatenate([row["shape"] for row in self.rows]),
            shape_start=np.cumsum([0, *(len(row["shape"]) for row in self.rows)]),
        )

    def _add_edge(self, edge: str, location: int, approach: int, exit_: int) -> None:
        lanes = self.edges[edge]
        number = len({row["lane_edge"] for row in self.rows})
        for index, lane in enumerate(lanes):
            self.lanes[lane.get("id")] = len(self.rows)
            own = location, number, index, len(lanes), float(lane.get("length")), float(lane.get("speed"))
            row = dict(zip(_LANE_COLUMNS, (*own, approach, exit_, 0.0, 0.0), strict=True))
            self.rows.append({**row, "place": lane_number(lane), "shape": lane_shape(lane), "next": {}, "prev": {}})

    def _sources(self, leg: str) -> dict[str, str]:
        return {kind: f"{leg}{kind[1]}2{leg}" for kind in ("AB", "AA") if f"{leg}{kind[1]}2{leg}" in self.edges}

    def _stop_line_connections(self, p: int) -> list[Any]:
        edge = self.incoming[p][-1]
        found = [c for lane in self.edges[edge] for c in self.connections[edge, lane_number(lane)]]
        return [c for c in found if _REGION_EDGE.fullmatch(c.get("to")) and c.get("to")[3:] in self.exits]

    def signal_links(self) -> dict[tuple[int, int], list[int]]:
        links: dict[tuple[int, int], list[int]] = defaultdict(list)
        for p in range(len(self.approaches)):
            for c in self._stop_line_connections(p):
                if c.get("tl") == "TL":
                    links[p, self.exits.index(c.get("to")[3:])].append(int(c.get("linkIndex")))
        return links

    def _walk_movements(self) -> tuple[np.ndarray, np.ndarray]:
        """Follow every connection through the junction; register its inside lanes and what comes after what."""
        turn = np.full((len(self.approaches), len(self.exits)), -1, np.int8)
        links = np.zeros(turn.shape, np.int64)
        for p in range(len(self.approaches)):
            for c in self._stop_line_connections(p):
                q = self.exits.index(c.get("to")[3:])
                links[p, q] += 1
                if turn[p, q] < 0:
                    turn[p, q] = TURN_OF_DIRECTION.get(c.get("dir"), STRAIGHT)
                chain = self._chain(c)
                for lane in chain:
                    edge = lane.rsplit("_", 1)[0]
                    if lane not in self.lanes:
                        self._add_edge(edge, INSIDE, p, q)
                self._link_chain(c, chain, p, q)
        if (links.sum(axis=1) == 0).any():
            leg = self.approaches[int(np.argmin(links.sum(axis=1)))]
            raise IzooError(f"{self.path}: no lane of the approach {leg}2TL leads across junction TL; repair the net.")
        return turn, links

    def _chain(self, connection: Any) -> list[str]:
        """Ids of the inside lanes that a connection runs over, in order."""
        chain: list[str] = []
        via = connection.get("via")
        while via is not None and via not in chain:
            chain.append(via)
            edge, index = via.rsplit("_", 1)
            onward = self.connections.get((edge, int(index)), [])
            via = onward[0].get("via") if onward else None
        return chain

    def _link_chain(self, connection: Any, chain: list[str], p: int, q: int) -> None:
        start = self.lanes[f"{connection.get('from')}_{connection.get('fromLane')}"]
        end = self.lanes[f"{connection.get('to')}_{connection.get('toLane')}"]
        path = [start, *(self.lanes[lane] for lane in chain), end]
        total = sum(self.rows[lane]["lane_length"] for lane in path[1:-1])
        offset = 0.0
        for lane in path[1:-1]:
            self.rows[lane].update(lane_offset_m=offset, inside_length_m=total)
            offset += self.rows[lane]["lane_length"]
        # Of several connections of one lane to one exit the outer loop meets the rightmost target first; it is kept.
        for before, after in itertools.pairwise(path):
            self.rows[before]["next"].setdefault(q, after)
            self.rows[after]["prev"].setdefault(p, before)

    def _walk_splits(self) -> None:
        """Register the lanes between the main part of an approach and its pocket part."""
        for p, edges in enumerate(self.incoming):
            if len(edges) == 1:
                continue
            main, pocket = edges
            for lane in self.edges[main]:
                before, index = self.lanes[lane.get("id")], lane_number(lane)
                onward = [c for c in self.connections[main, index] if c.get("to") == pocket]
                for c in sorted(onward, key=lambda c: abs(int(c.get("toLane")) - index)):
                    chain = self._chain(c)
                    for via in chain:
                        if via not in self.lanes:
                            self._add_edge(via.rsplit("_", 1)[0], APPROACHING, p, -1)
                    after = self.lanes[f"{pocket}_{c.get('toLane')}"]
                    path = [before, *(self.lanes[via] for via in chain), after]
                    for one, two in itertools.pairwise(path):
                        self.rows[two]["prev"].setdefault(p, one)
                        for q in self.rows[after]["next"]:
                            self.rows[one]["next"].setdefault(q, two)

    def _approach_offsets(self) -> None:
        for p, edges in enumerate(self.incoming):
            frontier = [self.lanes[lane.get("id")] for lane in self.edges[edges[-1]]]
            for lane in frontier:
                self.rows[lane]["lane_offset_m"] = -self.rows[lane]["lane_length"]
            for lane in frontier:  # which grows
                before = self.rows[lane]["prev"].get(p)
                if before is not None and self.rows[before]["lane_offset_m"] == 0.0:
                    row = self.rows[before]
                    row["lane_offset_m"] = self.rows[lane]["lane_offset_m"] - row["lane_length"]
                    frontier.append(before)

    def _successors(self) -> dict[str, np.ndarray]:
        next_lane = np.full((len(self.rows), len(self.exits)), -1, np.int32)
        prev_lane = np.full((len(self.rows), len(self.approaches)), -1, np.int32)
        for number, row in enumerate(self.rows):
            for table, found in ((next_lane, row["next"]), (prev_lane, row["prev"])):
                table[number, list(found)] = list(found.values())
        return {"next_lane": next_lane, "prev_lane": prev_lane}

    def _neighbours(self) -> dict[str, np.ndarray]:
        # No vehicle changes across a lane that is closed to cars.
        place = {(row["lane_edge"], row["place"]): number for number, row in enumerate(self.rows)}
        sides = {"lane_right": -1, "lane_left": 1}
        return {
            name: np.array([place.get((row["lane_edge"], row["place"] + step), -1) for row in self.rows], np.int32)
            for name, step in sides.items()
        }

    def _segments(self) -> dict[str, np.ndarray]:
        starts, begins, grades = [0], [], []
        for row in self.rows:
            step = np.diff(row["shape"], axis=0)
            length = np.linalg.norm(step, axis=1)
            run = np.maximum(np.linalg.norm(step[:, :2], axis=1), 1e-9)
            # SUMO stretches the drawn lane to its nominal length before it looks up the slope.
            scale = row["lane_length"] / max(float(length.sum()), 1e-9)
            begins.append(np.concatenate([[0.0], np.cumsum(length)[:-1]]) * scale)
            grades.append(100.0 * step[:, 2] / run)
            starts.append(starts[-1] + len(step))
        start, begin_m, grade_pct = np.array(starts, np.int32), np.concatenate(begins), np.concatenate(grades)
        return {"segment_start": start, "segment_from_m": begin_m, "segment_grade_pct": grade_pct}


def lane_shape(lane: Any) -> np.ndarray:
    """Geometry ``[n, 3]`` of a ``<lane>`` element in m; a missing height counts as 0."""
    points = [[float(value) for value in point.split(",")] for point in lane.get("shape").split()]
    return np.array([point if len(point) == 3 else [*point, 0.0] for point in points])


def run_m(points: np.ndarray) -> float:
    """Length in the plane of a line ``[n, 2 or 3]``."""
    return float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).sum())


def _grade(shape: np.ndarray) -> float:
    return float((shape[-1, 2] - shape[0, 2]) / max(run_m(shape), 1e-9))
