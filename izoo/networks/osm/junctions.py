"""Which junction nodes of a street map form one signalised intersection.

A signal may be tagged on the junction node or on a stop line in front of it, and where a dual carriageway is crossed
one intersection has two or four junction nodes. Junction nodes that carry a signal are joined when a street of at most
40 m links them, or of at most 75 m between the two carriageways of one street.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

from izoo.networks.osm.streets import StreetMap, Way, neighbours

JOIN_M = 40.0
JOIN_DUAL_M = 75.0
FILL_M = 30.0
STOP_LINE_M = 35.0
STOP_LINE_FACING_M = 70.0
"""How far in front of its junction a signal may stand: without and with a tagged direction."""
_FACING = {"forward": 1, "backward": -1}
Links = dict[int, list[tuple[int, Way, int]]]


@dataclass(frozen=True)
class Core:
    """Junction nodes of one intersection, and the signal nodes that belong to them."""

    nodes: frozenset[int]
    signals: frozenset[int]

    @property
    def id(self) -> int:
        """A stable name: the smallest id of its nodes."""
        return min(self.nodes)


class StreetGraph:
    """The streets as a graph of nodes, with the junctions (three or more neighbours) marked."""

    def __init__(self, streets: StreetMap) -> None:
        self.streets = streets
        self.links: Links = neighbours(streets)
        self.junctions = frozenset(node for node, found in self.links.items() if len({n for n, _, _ in found}) > 2)

    def distance(self, one: int, two: int) -> float:
        """Straight distance between two nodes in m."""
        return math.dist(self.streets.position_m[one], self.streets.position_m[two])

    def walk_to_junction(self, start: int, first: int, limit_m: float) -> tuple[int, float, int] | None:
        """Follow the street from ``start`` over its neighbour ``first`` to the next junction within ``limit_m``.

        Returns:
            The junction, the length of the way, and the node before it; ``None`` where there is none.
        """
        before, node, length = start, first, self.distance(start, first)
        while length <= limit_m:
            if node in self.junctions:
                return node, length, before
            onward = [other for other, _, _ in self.links[node] if other != before]
            if not onward:
                return None
            before, node, length = node, onward[0], length + self.distance(node, onward[0])
        return None

    def junction_links(self, limit_m: float) -> Iterator[tuple[int, int, float]]:
        """Pairs of junctions with a street of at most ``limit_m`` in between, and its length."""
        for junction in self.junctions:
            for first, _, _ in self.links[junction]:
                found = self.walk_to_junction(junction, first, limit_m)
                if found is not None and found[0] > junction:
                    yield junction, found[0], found[1]


def find_cores(graph: StreetGraph) -> list[Core]:
    """Return the signalised intersections in the order of their ids."""
    signals_at: dict[int, set[int]] = defaultdict(set)
    arms: dict[int, tuple[int, int]] = {}
    for signal, facing in graph.streets.signals.items():
        found = None if signal in graph.streets.pedestrian else _junction_of_signal(graph, signal, facing)
        if found is not None:
            signals_at[found[0]].add(signal)
            arms[signal] = found
    parent = {junction: junction for junction in signals_at}

    def root(node: int) -> int:
        while parent[node] != node:
            node = parent[node]
        return node

    short_links: dict[int, set[int]] = defaultdict(set)
    for one, two, length in graph.junction_links(JOIN_DUAL_M):
        if length <= FILL_M:
            short_links[one].add(two)
            short_links[two].add(one)
        if one in parent and two in parent and (length <= JOIN_M or _dual(graph, one, two)):
            parent[root(two)] = root(one)
    groups: dict[int, set[int]] = defaultdict(set)
    for junction in parent:
        groups[root(junction)].add(junction)
    cores, signalised = [], set(signals_at)
    for group in groups.values():
        signals = frozenset(signal for junction in group for signal in signals_at[junction])
        if signals <= graph.streets.crossings - group and len({arms[signal] for signal in signals}) < 2:
            continue  # a crossing for pedestrians beside a street without a signal
        cores.append(Core(frozenset(_fill(group, signalised, short_links)), signals))
    return sorted(cores, key=lambda core: core.id)


def _junction_of_signal(graph: StreetGraph, signal: int, facing: str) -> tuple[int, int] | None:
    """The junction that a signal node controls, and the node before it.

    The junction is the node itself, or the next one that traffic meets behind it.
    """
    if signal in graph.junctions:
        return signal, signal
    if len({other for other, _, _ in graph.links[signal]}) < 2:
        return None  # The extract ends here: the junction of this signal is outside.
    reached = []
    for first, way, direction in graph.links[signal]:
        if way.oneway not in (0, direction):
            continue
        if _FACING.get(facing, direction) != direction:
            continue
        found = graph.walk_to_junction(signal, first, STOP_LINE_FACING_M if facing in _FACING else STOP_LINE_M)
        if found is not None:
            reached.append(found)
    if not reached:
        return None
    junction, _, before = min(reached, key=lambda found: found[1])
    return junction, before


def _dual(graph: StreetGraph, one: int, two: int) -> bool:
    """Whether the two junctions lie on opposite carriageways of one named street."""
    for way, heading in _carriageways(graph, one):
        for other, other_heading in _carriageways(graph, two):
            opposite = math.cos(heading - other_heading) < -0.7
            if way.id != other.id and way.name and way.name == other.name and opposite:
                return True
    return False


def _carriageways(graph: StreetGraph, node: int) -> Iterator[tuple[Way, float]]:
    """One-way streets at ``node`` and their direction of travel in radians."""
    for other, way, direction in graph.links[node]:
        if way.oneway:
            sign = way.oneway * direction
            (x0, y0), (x1, y1) = graph.streets.position_m[node], graph.streets.position_m[other]
            yield way, math.atan2(sign * (y1 - y0), sign * (x1 - x0))


def _fill(group: set[int], signalised: set[int], short_links: dict[int, set[int]]) -> set[int]:
    """Add junctions without a signal that lie between two of the group, such as a square's fourth corner."""
    touching: dict[int, set[int]] = defaultdict(set)
    for inside in group:
        for outside in short_links[inside] - signalised:
            touching[outside].add(inside)
    return group | {node for node, inner in touching.items() if len(inner) > 1}
