"""Routes through a net as tables: their edges, and the link by which a route leaves each lane."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from izoo.envs.twin.net.tables import NetTables
from izoo.envs.twin.runtime.layout import LINK_TO, MAX_ROUTE_EDGES
from izoo.errors import IzooError
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import SOURCE_KINDS


class RouteTables(NamedTuple):
    """The fields of :class:`~izoo.envs.twin.runtime.layout.TwinNet` of the same names."""

    route_edges: np.ndarray
    route_of: np.ndarray
    route_link: np.ndarray


def find_routes(road: RoadNet, edge_rows: dict[str, int], net: NetTables) -> RouteTables:
    """Tabulate every route that traffic can have: a source, the approach's edges, an exit.

    Raises:
        IzooError: a route has more edges than the tables hold.
    """
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
    tables = RouteTables(
        route_edges=np.full((len(found), MAX_ROUTE_EDGES), -1, np.int32),
        route_of=np.full((len(road.approaches), len(SOURCE_KINDS), len(road.exits)), -1, np.int32),
        route_link=np.full((len(found), len(net.lanes)), -1, np.int32),
    )
    for row, (p, source, q, edges) in enumerate(found):
        tables.route_edges[row, : len(edges)] = edges
        tables.route_of[p, source, q] = row
        tables.route_link[row] = _links_of_route(net, edges)
    return tables


def _links_of_route(net: NetTables, edges: list[int]) -> list[int]:
    """Return one route's row, which is filled from the route's end to its beginning."""
    length, offset = [0.0] * len(net.lanes), [0] * len(net.lanes)
    route_link = [-1] * len(net.lanes)
    for lane in net.lanes_of(edges[-1]):
        length[lane] = net.length_m[lane]
    for edge, after in reversed(list(itertools.pairwise(edges))):
        ways = net.links_between(edge, after)
        for lane in net.lanes_of(edge):
            length[lane] = net.length_m[lane]
            onward = [(net.links[way][LINK_TO], way) for way in ways if way in net.links_of(lane)]
            if onward:
                target, route_link[lane] = min(onward, key=lambda way: (-length[way[0]], abs(offset[way[0]])))
                length[lane] += length[target]
                offset[lane] = offset[target]
        for way in ways:
            for inside in net.inside_lanes(way):
                route_link[inside] = net.links_of(inside)[0]
        _point_to_best(net.lanes_of(edge), length, offset)
    return route_link


def _point_to_best(lanes: range, length: list[float], offset: list[int]) -> None:
    """Set the offsets of an edge's lanes to the nearest of the best lanes."""
    best_length = max(length[lane] for lane in lanes)
    longest = [lane for lane in lanes if length[lane] == best_length]
    fewest = min(abs(offset[lane]) for lane in longest)
    best = [lane for lane in longest if abs(offset[lane]) == fewest]
    for lane in lanes:
        if lane not in best:
            offset[lane] = min(best, key=lambda other: abs(other - lane)) - lane
