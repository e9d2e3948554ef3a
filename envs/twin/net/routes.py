"""Routes through a net as tables: their edges, and the link by which a route leaves each lane."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from izoo.envs.twin.runtime.layout import (
    EDGE_FIRST_LANE,
    EDGE_LANES,
    LANE_FIRST_LINK,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_LINKS,
    LINK_NEXT,
    LINK_TO,
    MAX_ROUTE_EDGES,
)
from izoo.errors import IzooError
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import SOURCE_KINDS


class RouteTables(NamedTuple):
    """The fields of :class:`~izoo.envs.twin.runtime.layout.TwinNet` of the same names."""

    route_edges: np.ndarray
    route_of: np.ndarray
    route_link: np.ndarray


class _Lanes:
    """Lanes and links for a search along a route."""

    def __init__(
        self, lane_floats: np.ndarray, lane_ints: np.ndarray, edge_ints: np.ndarray, link_ints: np.ndarray
    ) -> None:
        self.length = lane_floats[:, LANE_LENGTH]
        self.ints, self.edges, self.links = lane_ints, edge_ints, link_ints

    def of_edge(self, edge: int) -> range:
        first = int(self.edges[edge, EDGE_FIRST_LANE])
        return range(first, first + int(self.edges[edge, EDGE_LANES]))

    def links_of(self, lane: int) -> range:
        first = int(self.ints[lane, LANE_FIRST_LINK])
        return range(first, first + int(self.ints[lane, LANE_LINKS]))


def find_routes(
    road: RoadNet,
    edge_rows: dict[str, int],
    lane_floats: np.ndarray,
    lane_ints: np.ndarray,
    edge_ints: np.ndarray,
    link_ints: np.ndarray,
) -> RouteTables:
    """Tabulate every route that traffic can have: a source, the approach's edges, an exit.

    Raises:
        IzooError: a route has more edges than the tables hold.
    """
    lanes = _Lanes(lane_floats, lane_ints, edge_ints, link_ints)
    found = [
        (p, SOURCE_KINDS.index(kind), q, [edge_rows[e] for e in (source, *road.incoming_edges[p], out)])
        for p, sources in enumerate(road.sources)
        for kind, source in sources.items()
        for q, out in enumerate(road.outgoing_edge)
        if road.movement_links[p, q] > 0
    ]
    longest = max((len(edges) for *_, edges in found), default=0)
    if longest > MAX_ROUTE_EDGES:
        raise IzooError(f"{road.path}: a route has {longest} edges, and the twin holds {MAX_ROUTE_EDGES}; use SUMO.")
    count, lane_count = len(found), len(lane_ints)
    tables = RouteTables(
        route_edges=np.full((count, MAX_ROUTE_EDGES), -1, np.int32),
        route_of=np.full((len(road.approaches), len(SOURCE_KINDS), len(road.exits)), -1, np.int32),
        route_link=np.full((count, lane_count), -1, np.int32),
    )
    for row, (p, source, q, edges) in enumerate(found):
        tables.route_edges[row, : len(edges)] = edges
        tables.route_of[p, source, q] = row
        _follow(lanes, edges, tables.route_link[row])
    return tables


def _follow(lanes: _Lanes, edges: list[int], route_link: np.ndarray) -> None:
    """Fill one route's row, from its end to its beginning."""
    length, offset = np.zeros(len(lanes.length)), np.zeros(len(lanes.length), np.int32)
    last = list(lanes.of_edge(edges[-1]))
    length[last] = lanes.length[last]
    for edge, after in reversed(list(itertools.pairwise(edges))):
        onward = set(lanes.of_edge(after))
        for lane in lanes.of_edge(edge):
            length[lane] = lanes.length[lane]
            ways = [k for k in lanes.links_of(lane) if int(lanes.links[k, LINK_TO]) in onward]
            if not ways:
                continue
            targets = lanes.links[ways, LINK_TO]
            order = np.lexsort((np.abs(offset[targets]), -length[targets]))
            chosen = ways[int(order[0])]
            target = int(lanes.links[chosen, LINK_TO])
            length[lane] += length[target]
            offset[lane] = offset[target]
            route_link[lane] = chosen
            for way in ways:
                _follow_inside(lanes, way, route_link)
        _point_to_best(np.array(lanes.of_edge(edge)), length, offset)


def _follow_inside(lanes: _Lanes, link: int, route_link: np.ndarray) -> None:
    """Fill in the inside lanes behind ``link``, each with its only link."""
    lane = int(lanes.links[link, LINK_NEXT])
    while lanes.ints[lane, LANE_INSIDE]:
        onward = lanes.links_of(lane)[0]
        route_link[lane] = onward
        lane = int(lanes.links[onward, LINK_NEXT])


def _point_to_best(rows: np.ndarray, best_length: np.ndarray, best_offset: np.ndarray) -> None:
    """Set the offsets of an edge's lanes to the nearest of the best lanes."""
    length = best_length[rows]
    offset = best_offset[rows]
    longest = np.flatnonzero(length == length.max())
    best = longest[np.abs(offset[longest]) == np.abs(offset[longest]).min()]
    for place in range(len(rows)):
        if place not in best:
            nearest = best[int(np.argmin(np.abs(best - place)))]
            best_offset[rows[place]] = nearest - place
