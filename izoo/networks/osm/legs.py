"""The streets that meet at a signalised intersection, grouped into legs and followed to the neighbouring one."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from izoo.networks.osm.junctions import Core, StreetGraph
from izoo.networks.osm.streets import Way

BEARING_AT_M = 40.0
"""A leg's bearing is taken this far out, where the carriageways of a wide street have found their direction."""
MERGE_DEG = 35.0
MAX_LENGTH_M = 680.0
CUT_LENGTH_M = 150.0
"""A street that ends with the extract is given at least this length."""
_ONWARD_DEG = 60.0


@dataclass(frozen=True)
class Piece:
    """A stretch of one way on the walk away from the core: the way, the direction (1: with its order), its length."""

    way: Way
    outward: int
    length_m: float


@dataclass(frozen=True)
class Stub:
    """One carriageway that leaves the core.

    Attributes:
        pieces: the ways out to the neighbouring intersection, nearest first.
        length_m: their length, at most 680 m.
        cut: whether the walk ended with the extract or a dead end instead of an intersection.
        arrives, leaves: whether traffic may run towards the core, and away from it.
        bearing_deg: direction away from the core, clockwise from north.
        side_m: where it touches the core: metres to the right of a line through the core's centre, seen by traffic
            that arrives.
        nodes: all nodes of the walk, nearest first.
    """

    pieces: tuple[Piece, ...]
    length_m: float
    cut: bool
    arrives: bool
    leaves: bool
    bearing_deg: float
    side_m: float
    nodes: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.pieces[0].way.name


@dataclass(frozen=True)
class Street:
    """A leg: its carriageways that arrive and those that leave; a two-way street is in both."""

    bearing_deg: float
    arriving: tuple[Stub, ...]
    leaving: tuple[Stub, ...]

    @property
    def name(self) -> str:
        """The name of the street, or an empty string."""
        return next((stub.name for stub in (*self.arriving, *self.leaving) if stub.name), "")


def find_streets(graph: StreetGraph, core: Core, others: frozenset[int]) -> list[Street]:
    """Return the legs of ``core`` clockwise, the most northern first.

    Args:
        graph: the streets.
        core: the intersection.
        others: junction nodes of all other intersections with signals; walks end there.
    """
    stubs = [stub for node in sorted(core.nodes) for stub in _stubs_at(graph, core, node, others)]
    groups = [[stub] for stub in stubs]
    while True:
        pairs = [
            (_gap(one, two), i, j)
            for i, one in enumerate(groups)
            for j, two in enumerate(groups)
            if i < j and _same_street(one, two)
        ]
        if not pairs:
            break
        _, i, j = min(pairs)
        groups[i] += groups.pop(j)
    streets = [_street(group) for group in groups]
    streets.sort(key=lambda street: street.bearing_deg)
    north = min(range(len(streets)), key=lambda k: _between(streets[k].bearing_deg, 0.0), default=0)
    return streets[north:] + streets[:north]


def _stubs_at(graph: StreetGraph, core: Core, node: int, others: frozenset[int]) -> list[Stub]:
    found = []
    for first, way, direction in graph.links[node]:
        path = _inner_path(graph, core, node, first)
        if path is None:
            found.append(_walk(graph, core, node, first, way, direction, others))
    return found


def _inner_path(graph: StreetGraph, core: Core, node: int, first: int) -> int | None:
    """The core node at the other end of a street inside the core, or ``None`` for a street that leads away."""
    found = graph.walk_to_junction(node, first, 2.0 * BEARING_AT_M)
    return found[0] if found is not None and found[0] in core.nodes else None


def _walk(
    graph: StreetGraph, core: Core, start: int, first: int, way: Way, direction: int, others: frozenset[int]
) -> Stub:
    arrives, leaves = way.oneway in (0, -direction), way.oneway in (0, direction)
    nodes, pieces = [start, first], [Piece(way, direction, graph.distance(start, first))]
    length, cut = pieces[0].length_m, False
    while length < MAX_LENGTH_M and nodes[-1] not in others and nodes[-1] not in core.nodes:
        step = _onward(graph, nodes[-2], nodes[-1], pieces[-1].way, arrives)
        if step is None:
            # A signal on the last node belongs to the neighbour; its other streets are outside the extract.
            onward = len({other for other, _, _ in graph.links[nodes[-1]]})
            cut = onward < 2 and nodes[-1] not in graph.streets.signals
            break
        node, way, direction = step
        run = graph.distance(nodes[-1], node)
        if way.id == pieces[-1].way.id and direction == pieces[-1].outward:
            pieces[-1] = Piece(way, direction, pieces[-1].length_m + run)
        else:
            pieces.append(Piece(way, direction, run))
        if node in nodes:
            break
        nodes.append(node)
        length += run
    bearing = _bearing(graph, nodes)
    return Stub(
        tuple(pieces),
        min(length, MAX_LENGTH_M),
        cut,
        arrives,
        leaves,
        bearing,
        _side(graph, core, start, bearing),
        tuple(nodes),
    )


def _onward(graph: StreetGraph, before: int, node: int, way: Way, arrives: bool) -> tuple[int, Way, int] | None:
    """The continuation of a street at ``node``: the same name and the least bend first; at most 60 degrees."""
    best = None
    for other, next_way, direction in graph.links[node]:
        # A two-way street that parts into two carriageways is followed along the arriving one.
        if other == before or next_way.oneway not in (0, -direction if arrives else direction):
            continue
        bend = _bend(graph, before, node, other)
        key = (next_way.name != way.name, bend)
        if bend <= _ONWARD_DEG and (best is None or key < best[0]):
            best = (key, (other, next_way, direction))
    return None if best is None else best[1]


def _bend(graph: StreetGraph, before: int, node: int, after: int) -> float:
    place = graph.streets.position_m
    (x0, y0), (x1, y1), (x2, y2) = place[before], place[node], place[after]
    return _between(math.degrees(math.atan2(x1 - x0, y1 - y0)), math.degrees(math.atan2(x2 - x1, y2 - y1)))


def _centre(graph: StreetGraph, core: Core) -> tuple[float, float]:
    places = [graph.streets.position_m[node] for node in core.nodes]
    return sum(x for x, _ in places) / len(places), sum(y for _, y in places) / len(places)


def _bearing(graph: StreetGraph, nodes: list[int]) -> float:
    """Direction of the street between where it leaves the core and a point 40 m out along it."""
    start = graph.streets.position_m[nodes[0]]
    left, point = BEARING_AT_M, start
    for one, two in itertools.pairwise(nodes):
        (x0, y0), (x1, y1) = graph.streets.position_m[one], graph.streets.position_m[two]
        run = math.hypot(x1 - x0, y1 - y0)
        share = min(1.0, left / run) if run > 0.0 else 0.0
        point = (x0 + share * (x1 - x0), y0 + share * (y1 - y0))
        left -= run
        if left <= 0.0:
            break
    return math.degrees(math.atan2(point[0] - start[0], point[1] - start[1])) % 360.0


def _side(graph: StreetGraph, core: Core, start: int, bearing_deg: float) -> float:
    (x, y), (cx, cy) = graph.streets.position_m[start], _centre(graph, core)
    out = math.radians(bearing_deg)
    # Arriving traffic heads against the bearing, so its right hand points to (-cos, sin) of the bearing.
    return -(x - cx) * math.cos(out) + (y - cy) * math.sin(out)


def _between(one_deg: float, two_deg: float) -> float:
    """Angle between two directions in [0, 180] degrees."""
    return abs((one_deg - two_deg + 180.0) % 360.0 - 180.0)


def _gap(one: list[Stub], two: list[Stub]) -> float:
    return min(_between(a.bearing_deg, b.bearing_deg) for a in one for b in two)


def _same_street(one: list[Stub], two: list[Stub]) -> bool:
    """Whether two groups are carriageways of one leg.

    They must point the same way within 35 degrees. A carriageway in and one out belong together unless both have
    names and the names differ; two that run the same way belong together if they bear one name or join further out.
    """
    if _gap(one, two) > MERGE_DEG:
        return False
    names = {stub.name for stub in one} & {stub.name for stub in two}
    if any(stub.arrives and stub.leaves for group in (one, two) for stub in group):
        return bool(names - {""}) and not _two_way(one, two)
    joined = bool({node for stub in one for node in stub.nodes[1:]} & {node for stub in two for node in stub.nodes[1:]})
    if {stub.arrives for stub in one} != {stub.arrives for stub in two} or len(one) + len(two) > 2:
        named = {stub.name for stub in (*one, *two)} - {""}
        return joined or bool(names) or len(named) < 2
    return joined or bool(names - {""})


def _two_way(one: list[Stub], two: list[Stub]) -> bool:
    return all(any(stub.arrives and stub.leaves for stub in group) for group in (one, two))


def _street(group: list[Stub]) -> Street:
    x = sum(math.sin(math.radians(stub.bearing_deg)) for stub in group)
    y = sum(math.cos(math.radians(stub.bearing_deg)) for stub in group)
    by_side = sorted(group, key=lambda stub: -stub.side_m)
    return Street(
        bearing_deg=math.degrees(math.atan2(x, y)) % 360.0,
        arriving=tuple(stub for stub in by_side if stub.arrives),
        leaving=tuple(stub for stub in by_side if stub.leaves),
    )
