"""Best lanes: how far each lane continues along a route, and how many lanes a driver should change.

SUMO computes them whenever a vehicle enters an edge. Of lanes that continue equally far, those whose links show
priority (``G``) at that time are preferred to the others (``g``), and a lane without priority counts as if it ended. So
a route has *variants*: one table for each pattern of priorities that the signals can show. Most routes have one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from izoo.envs.twin.driving.traffic_lights import LOWER_CASE, UPPER_CASE, is_major
from izoo.envs.twin.net.tables import NetTables
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    LANE_EDGE,
    LANE_INSIDE,
    LANE_LINKS,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_SIGNAL,
    LINK_STATE,
    LINK_TO,
    PHASE_STATE,
    PROGRAM_FIRST_PHASE,
    PROGRAM_PHASES,
)
from izoo.errors import IzooError

MAX_CHECKED_LINKS = 12
_MAX_VARIANTS = 64


class BestTables(NamedTuple):
    """Fields of :class:`~izoo.envs.twin.runtime.layout.TwinNet`; ``X`` variants, those of a route in neighbouring rows.

    Attributes:
        variant_first, variant_count: ``[R]`` int32, the variants of each route.
        variant_links: ``[R, MAX_CHECKED_LINKS]`` int32, the links whose priorities distinguish the variants of a route.
        variant_group: ``[R, MAX_CHECKED_LINKS]`` int32, links of one group leave one edge; only differences within a
            group count.
        variant_bits: ``[X]`` int64, bit ``k`` is 1 where link ``k`` has priority and another of its group has not.
        best_length: ``[X, L]`` float64, length (m) that can be driven from the lane's begin without a change;
            of inside lanes: of the lane behind the junction.
        best_offset: ``[X, L]`` int32, lanes to change (positive: to the left) to the best lane.
        best_link: ``[X, L]`` int32, the link to continue by; -1 if there is none, or the route ends.
        best_open: ``[X, L]`` uint8: 1 where the lane at which the way ends (the route's end, or a dead end) has links.
        best_road: ``[X, L]`` int32, the lane behind the junction to which that link leads; -1 where there is none.
    """

    variant_first: np.ndarray
    variant_count: np.ndarray
    variant_links: np.ndarray
    variant_group: np.ndarray
    variant_bits: np.ndarray
    best_length: np.ndarray
    best_offset: np.ndarray
    best_link: np.ndarray
    best_open: np.ndarray
    best_road: np.ndarray


class Signals(NamedTuple):
    """The signals of :class:`~izoo.envs.twin.runtime.layout.TwinNet`, by the same names."""

    program_ints: np.ndarray
    phase_ints: np.ndarray
    phase_letters: np.ndarray


def tabulate_best_lanes(net: NetTables, signals: Signals, route_edges: np.ndarray) -> BestTables:
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
    choices = _Choices(net, signals)
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
    columns = [
        np.array([row[k] for row in rows], dtype).reshape(-1, lane_count)
        for k, dtype in enumerate((np.float64, np.int32, np.int32, np.uint8, np.int32))
    ]
    return BestTables(first, number, links, group, np.array(bits, np.int64), *columns)


class _Choices(dict[tuple[int, int], list[tuple[bool, ...]]]):
    """Which patterns of priorities the links from one edge to another show, each once."""

    def __init__(self, net: NetTables, signals: Signals) -> None:
        self.net = net
        self.program_ints: list[list[int]] = signals.program_ints.tolist()
        self.phase_ints: list[list[int]] = signals.phase_ints.tolist()
        self.letters = signals.phase_letters.tobytes()

    def __missing__(self, edges: tuple[int, int]) -> list[tuple[bool, ...]]:
        links = [self.net.links[link] for link in self.net.links_between(*edges)]
        shown = [
            [_is_major(self._letter(link, program, phase)) for link in links]
            for program in {link[LINK_PROGRAM] for link in links}
            if program >= 0
            for phase in self._phases(program)
        ]
        found = list(dict.fromkeys(map(_relevant_bits, shown or [[_is_major(link[LINK_STATE]) for link in links]])))
        self[edges] = found
        return found

    def _phases(self, program: int) -> range:
        first = self.program_ints[program][PROGRAM_FIRST_PHASE]
        return range(first, first + self.program_ints[program][PROGRAM_PHASES])

    def _letter(self, link: list[int], program: int, phase: int) -> int:
        if link[LINK_PROGRAM] != program:
            return link[LINK_STATE]
        return self.letters[self.phase_ints[phase][PHASE_STATE] + link[LINK_SIGNAL]]


def _is_major(letter: int) -> bool:
    return UPPER_CASE <= letter < LOWER_CASE


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
    """The last columns of :class:`BestTables` for one pattern of priorities, each ``[L]``."""

    length: list[float]
    offset: list[int]
    link: list[int]
    is_open: list[bool]
    road: list[int]


def _best_lanes(net: NetTables, edges: Sequence[int], priority: dict[int, bool]) -> _Row:
    """Return the row of one pattern of priorities, which is filled from the route's end backwards."""
    count = len(net.lanes)
    row = _Row([0.0] * count, [0] * count, [-1] * count, [False] * count, [])
    length, offset, link, is_open, _ = row
    for lane in net.lanes_of(edges[-1]):
        length[lane], is_open[lane] = net.length_m[lane], net.lanes[lane][LANE_LINKS] > 0
    for edge, after in reversed(list(itertools.pairwise(edges))):
        ways = net.links_between(edge, after)
        connected = max((length[net.links[way][LINK_TO]] for way in ways), default=-1.0)
        longest = max(length[lane] for lane in net.lanes_of(after))
        for lane in net.lanes_of(edge):
            length[lane], is_open[lane] = net.length_m[lane], net.lanes[lane][LANE_LINKS] > 0
            onward = [(net.links[way][LINK_TO], way) for way in ways if way in net.links_of(lane)]
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
                _describe_inside(net, net.links[way][LINK_TO], lane, row)
        _point_to_best(net.lanes_of(edge), net, priority, row)
    row.road.extend(_road_behind(net, lane, link) for lane in range(count))
    return row


def _road_behind(net: NetTables, lane: int, link: list[int]) -> int:
    """Return the next lane outside of junctions from a lane, -1 if there is none."""
    while link[lane] >= 0:
        lane = net.links[link[lane]][LINK_NEXT]
        if not net.lanes[lane][LANE_INSIDE]:
            return lane
    return -1


def _describe_inside(net: NetTables, target: int, lane: int, row: _Row) -> None:
    """Describe a lane inside a junction like the lane behind it, with offsets within the inside edge."""
    siblings = net.lanes_of(net.lanes[lane][LANE_EDGE])
    row.length[lane], row.is_open[lane], row.link[lane] = row.length[target], row.is_open[target], net.links_of(lane)[0]
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
            length[lane] = net.length_m[lane]


@compiled
def find_variant(net, state, route):  # type: ignore[no-untyped-def]
    """Return the variant of ``route`` for the letters that the links show now."""
    first, count = net.variant_first[route], net.variant_count[route]
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
