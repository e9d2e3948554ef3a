"""Best lanes: how far each lane continues along a route, and how many lanes a driver should change.

SUMO computes them whenever a vehicle enters an edge. Of lanes that continue equally far, those whose links show
priority (``G``) at that time are preferred to the others (``g``), and a lane without priority counts as if it ended. So
a route has *variants*: one table for each pattern of priorities that the signals can show. Most routes have one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.traffic_lights import is_major
from izoo.envs.twin.net.tables import NetTables
from izoo.envs.twin.runtime.layout import Best
from izoo.errors import IzooError

MAX_CHECKED_LINKS = 12
_MAX_VARIANTS = 64


class BestTables(NamedTuple):
    """What :class:`~izoo.envs.twin.runtime.layout.TwinNet` holds of best lanes: ``X`` variants, route by route.

    Attributes:
        variant_first, variant_count: ``[R]`` int32, the variants of each route.
        variant_links: ``[R, MAX_CHECKED_LINKS]`` int32, the links whose priorities distinguish the variants of a route.
        variant_group: ``[R, MAX_CHECKED_LINKS]`` int32, links of one group leave one edge; only differences within a
            group count.
        variant_bits: ``[X]`` int64, bit ``k`` is 1 where link ``k`` has priority and another of its group has not.
        best: ``[X, L]`` records: ``length`` (m) that can be driven from the lane's begin without a change, of inside
            lanes that of the lane behind the junction; ``offset``, lanes to change (positive: to the left) to the best
            lane; ``link`` to continue by, -1 if there is none, or the route ends; ``road``, the lane behind the
            junction to which that link leads, -1 where there is none; ``open``, 1 where the lane at which the way ends
            (the route's end, or a dead end) has links.
    """

    variant_first: np.ndarray
    variant_count: np.ndarray
    variant_links: np.ndarray
    variant_group: np.ndarray
    variant_bits: np.ndarray
    best: np.ndarray


def tabulate_best_lanes(net: NetTables, route_edges: np.ndarray) -> BestTables:
    """Tabulate all variants of all routes ``route_edges`` ``[R, E]`` (-1: none).

    Raises:
        IzooError: a route has more variants than the tables hold.
    """
    count, lane_count = len(route_edges), len(net.lanes)
    first, number = np.zeros(count, np.int32), np.zeros(count, np.int32)
    links = np.full((count, MAX_CHECKED_LINKS), -1, np.int32)
    group = np.full((count, MAX_CHECKED_LINKS), -1, np.int32)
    bits: list[int] = []
    rows: list[_Row] = []
    choices = _Choices(net)
    for route, padded in enumerate(route_edges.tolist()):
        edges = [edge for edge in padded if edge >= 0]
        checked, patterns = _patterns(net, choices, edges)
        for k, (link, group_of) in enumerate(checked):
            links[route, k], group[route, k] = link, group_of
        first[route], number[route] = len(rows), len(patterns)
        for pattern in patterns:
            bits.append(sum(1 << k for k, has_priority in enumerate(pattern) if has_priority))
            priority = {link: has_priority for (link, _), has_priority in zip(checked, pattern, strict=True)}
            rows.append(_best_lanes(net, edges, priority))
    best = np.zeros((len(rows), lane_count), Best)
    for row, columns in zip(best, rows, strict=True):
        for name, values in columns._asdict().items():
            row[name] = values
    return BestTables(first, number, links, group, np.array(bits, np.int64), best)


class _Choices(dict[tuple[int, int], list[tuple[bool, ...]]]):
    """Which patterns of priorities the links from one edge to another show, each once."""

    def __init__(self, net: NetTables) -> None:
        self.net = net

    def __missing__(self, edges: tuple[int, int]) -> list[tuple[bool, ...]]:
        links = [self.net.links[link] for link in self.net.links_between(*edges)]
        shown = [
            [is_major.py_func(self._letter(link, program, phase)) for link in links]
            for program in {link.program for link in links}
            if program >= 0
            for phase in self._phases(program)
        ]
        found = list(dict.fromkeys(map(_relevant_bits, shown or [[is_major.py_func(link.state) for link in links]])))
        self[edges] = found
        return found

    def _phases(self, program: int) -> list[Any]:
        first = self.net.programs[program].first_phase
        return self.net.phases[first : first + self.net.programs[program].phases]

    def _letter(self, link: Any, program: int, phase: Any) -> int:
        return self.net.phase_letters[phase.state + link.signal] if link.program == program else link.state


def _relevant_bits(bits: Sequence[bool]) -> tuple[bool, ...]:
    """Return the pattern, or none at all if all links have priority, which is the same."""
    return tuple(bits) if any(bits) and not all(bits) else (False,) * len(bits)


def _patterns(
    net: NetTables, choices: _Choices, edges: Sequence[int]
) -> tuple[list[tuple[int, int]], list[tuple[bool, ...]]]:
    """Return the links ``(link, group)`` whose priorities can differ, and the patterns that the signals can show."""
    checked: list[tuple[int, int]] = []
    chosen: list[list[tuple[bool, ...]]] = []
    for number, pair in enumerate(itertools.pairwise(edges)):
        seen = choices[pair]
        if len(seen) < 2 and not any(any(pattern) for pattern in seen):
            continue
        checked += [(link, number) for link in net.links_between(*pair)]
        chosen.append(seen)
    variants = math.prod(len(choice) for choice in chosen)
    if len(checked) > MAX_CHECKED_LINKS or variants > _MAX_VARIANTS:
        raise IzooError(
            f"a route passes {len(checked)} links whose priorities differ, in {variants} patterns, and the twin holds "
            f"{MAX_CHECKED_LINKS} and {_MAX_VARIANTS}; use SUMO."
        )
    return checked, [tuple(itertools.chain(*parts)) for parts in itertools.product(*chosen)]


class _Row(NamedTuple):
    """The records of one pattern of priorities by field, each ``[L]``."""

    length: list[float]
    offset: list[int]
    link: list[int]
    open: list[bool]
    road: list[int]


def _best_lanes(net: NetTables, edges: Sequence[int], priority: dict[int, bool]) -> _Row:
    """Return the row of one pattern of priorities, which is filled from the route's end backwards."""
    count = len(net.lanes)
    row = _Row([0.0] * count, [0] * count, [-1] * count, [False] * count, [])
    length, offset, link, is_open, _ = row
    for lane in net.lanes_of(edges[-1]):
        length[lane], is_open[lane] = net.lanes[lane].length, net.lanes[lane].links > 0
    for edge, after in reversed(list(itertools.pairwise(edges))):
        ways = net.links_between(edge, after)
        connected = max((length[net.links[way].to_lane] for way in ways), default=-1.0)
        longest = max(length[lane] for lane in net.lanes_of(after))
        for lane in net.lanes_of(edge):
            length[lane], is_open[lane] = net.lanes[lane].length, net.lanes[lane].links > 0
            onward = [(net.links[way].to_lane, way) for way in ways if way in net.links_of(lane)]
            if not onward:
                continue
            # The longest, then the one with fewest changes ahead, then the rightmost.
            target, link[lane] = min(onward, key=lambda way: (-length[way[0]], abs(offset[way[0]]), way[0]))
            # A lane that continues further, one change away, counts like the own one.
            near = length[target] == connected and abs(offset[target]) < 2
            length[lane] += longest if near else length[target]
            offset[lane], is_open[lane] = offset[target], is_open[target]
        for way in ways:
            for lane in net.inside_lanes(way):
                _describe_inside(net, net.links[way].to_lane, lane, row)
        _point_to_best(net.lanes_of(edge), net, priority, row)
    row.road.extend(_road_behind(net, lane, link) for lane in range(count))
    return row


def _road_behind(net: NetTables, lane: int, link: list[int]) -> int:
    """Return the next lane outside of junctions from a lane, -1 if there is none."""
    while link[lane] >= 0:
        lane = net.links[link[lane]].next_lane
        if not net.lanes[lane].inside:
            return lane
    return -1


def _describe_inside(net: NetTables, target: int, lane: int, row: _Row) -> None:
    """Describe a lane inside a junction like the lane behind it, with offsets within the inside edge."""
    siblings = net.lanes_of(net.lanes[lane].edge)
    row.length[lane], row.open[lane], row.link[lane] = row.length[target], row.open[target], net.links_of(lane)[0]
    row.offset[lane] = min(max(row.offset[target], siblings[0] - lane), siblings[-1] - lane)


def _point_to_best(lanes: range, net: NetTables, priority: dict[int, bool], row: _Row) -> None:
    """Set the offsets of an edge's lanes to the nearest of the best lanes."""
    length, offset = row.length, row.offset
    level = {lane: -1 if row.link[lane] < 0 else int(priority.get(row.link[lane], False)) for lane in lanes}
    ranks = {lane: (length[lane], -abs(offset[lane]), level[lane]) for lane in lanes}
    top = max(ranks.values())
    best = [lane for lane in lanes if ranks[lane] == top]
    for lane in lanes:
        if ranks[lane] == top:
            offset[lane] = 0
            continue
        ends = (best[0], best[-1])
        offset[lane] = (ends[0] if abs(ends[0] - lane) < abs(ends[1] - lane) else ends[1]) - lane
        if level[lane] < top[2]:
            length[lane] = net.lanes[lane].length


@compiled
def find_variant(net, state, route):  # type: ignore[no-untyped-def]
    """Return the variant of ``route`` for the letters that the links show now."""
    first, count = net.routes[route].first_variant, net.routes[route].variants
    if count == 1:
        return first
    links, groups = net.variant_links[route], net.variant_group[route]
    bits, k = 0, 0
    while k < links.shape[0] and links[k] >= 0:
        end, part = k, 0
        while end < links.shape[0] and links[end] >= 0 and groups[end] == groups[k]:
            if is_major(state.link_letter[links[end]]):
                part |= 1 << end
            end += 1
        if part != (1 << end) - (1 << k):
            bits |= part
        k = end
    for variant in range(first, first + count):
        if net.variant_bits[variant] == bits:
            return variant
    return first
