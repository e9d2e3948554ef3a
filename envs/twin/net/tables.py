"""A net while it is built: in Python, where one value at a time is read ten times as fast as from arrays."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class NetTables:
    """Rows with the fields of the records of :mod:`izoo.envs.twin.runtime.layout`: ``links[k].to_lane``.

    Attributes:
        lanes, edges, links, programs, phases: rows.
        phase_letters: ASCII.
    """

    lanes: list[Any]
    edges: list[Any]
    links: list[Any]
    programs: list[Any]
    phases: list[Any]
    phase_letters: bytes
    _between: dict[tuple[int, int], list[int]] = field(default_factory=dict, init=False)

    def lanes_of(self, edge: int) -> range:
        """Return the lanes of an edge, rightmost first."""
        first = self.edges[edge].first_lane
        return range(first, first + self.edges[edge].lanes)

    def links_of(self, lane: int) -> range:
        """Return the links that begin on a lane."""
        first = self.lanes[lane].first_link
        return range(first, first + self.lanes[lane].links)

    def links_between(self, edge: int, after: int) -> list[int]:
        """Return the links that lead from one edge to another."""
        found = self._between.get((edge, after))
        if found is None:
            onward = self.lanes_of(after)
            links = (link for lane in self.lanes_of(edge) for link in self.links_of(lane))
            found = self._between[edge, after] = [link for link in links if self.links[link].to_lane in onward]
        return found

    def inside_lanes(self, link: int) -> list[int]:
        """Return the lanes inside the junction behind a link, in order."""
        lanes, lane = [], self.links[link].next_lane
        while self.lanes[lane].inside:
            lanes.append(lane)
            lane = self.links[self.links_of(lane)[0]].next_lane
        return lanes

    def mark_lane_changing(self) -> None:
        """Set ``changes`` of edges.

        Inside junctions vehicles may change lanes where these are equally long and not behind a minor link without
        signal. There, lanes that begin at the same lane are not neighbours.
        """
        several = [row for row, edge in enumerate(self.edges) if edge.lanes > 1]
        for row in several:
            self.edges[row].changes = 1
            if not self.edges[row].inside:
                continue
            lanes = self.lanes_of(row)
            links = [link for link in self.links if link.next_lane in lanes]
            minor = any(link.program < 0 and chr(link.state) in "m=sw" for link in links)
            self.edges[row].changes = int(len({self.lanes[lane].length for lane in lanes}) == 1 and not minor)
            origin = {link.next_lane: link.from_lane for link in links}
            for right, left in itertools.pairwise(lanes):
                if origin.get(right) == origin.get(left):
                    self.lanes[right].left = self.lanes[left].right = -1


def records(kind: np.dtype, rows: Sequence[Any]) -> np.ndarray:
    """Return rows as records of a type of :mod:`izoo.envs.twin.runtime.layout`."""
    table = np.zeros(len(rows), kind)
    for name in set(kind.names or ()) - {"spare"}:
        table[name] = [getattr(row, name) for row in rows]
    return table


def grouped(numbers: Sequence[int], groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where each group begins (``[groups + 1]``), and the rows by the number of their group, -1 left out.

    Both are int32.
    """
    order = np.argsort(numbers, kind="stable")
    start = np.searchsorted(np.array(numbers, np.int64)[order], np.arange(groups + 1))
    return (start - start[0]).astype(np.int32), order[start[0] :].astype(np.int32)
