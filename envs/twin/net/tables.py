"""A net's lanes, edges and links as lists: read one number at a time, they are ten times as fast as arrays."""

from __future__ import annotations

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
)


class NetTables:
    """The tables of :class:`~izoo.envs.twin.runtime.layout.TwinNet` of the same names.

    Attributes:
        lanes, edges, links: their rows.
        length_m: of lanes.
    """

    def __init__(
        self, lane_floats: np.ndarray, lane_ints: np.ndarray, edge_ints: np.ndarray, link_ints: np.ndarray
    ) -> None:
        self.lanes: list[list[int]] = lane_ints.tolist()
        self.edges: list[list[int]] = edge_ints.tolist()
        self.links: list[list[int]] = link_ints.tolist()
        self.length_m: list[float] = lane_floats[:, LANE_LENGTH].tolist()
        self._between: dict[tuple[int, int], list[int]] = {}

    def lanes_of(self, edge: int) -> range:
        """Return the lanes of an edge, rightmost first."""
        first = self.edges[edge][EDGE_FIRST_LANE]
        return range(first, first + self.edges[edge][EDGE_LANES])

    def links_of(self, lane: int) -> range:
        """Return the links that begin on a lane."""
        first = self.lanes[lane][LANE_FIRST_LINK]
        return range(first, first + self.lanes[lane][LANE_LINKS])

    def links_between(self, edge: int, after: int) -> list[int]:
        """Return the links that lead from one edge to another."""
        found = self._between.get((edge, after))
        if found is None:
            onward = self.lanes_of(after)
            links = (link for lane in self.lanes_of(edge) for link in self.links_of(lane))
            found = self._between[edge, after] = [link for link in links if self.links[link][LINK_TO] in onward]
        return found

    def inside_lanes(self, link: int) -> list[int]:
        """Return the lanes inside the junction behind a link, in order."""
        lanes, lane = [], self.links[link][LINK_NEXT]
        while self.lanes[lane][LANE_INSIDE]:
            lanes.append(lane)
            lane = self.links[self.links_of(lane)[0]][LINK_NEXT]
        return lanes
