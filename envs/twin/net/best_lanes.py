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
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    EDGE_FIRST_LANE,
    EDGE_LANES,
    LANE_EDGE,
    LANE_FIRST_LINK,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_LINKS,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_SIGNAL,
    LINK_STATE,
    LINK_TO,
    PHASE_STATE,
    PROGRAM_FIRST_PHASE,
    PROGRAM_PHASES,
    Best,
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


class NetTables(NamedTuple):
    """The tables of a net that are needed here, as in :class:`~izoo.envs.twin.runtime.layout.TwinNet`."""

    lane_floats: np.ndarray
    lane_ints: np.ndarray
    edge_ints: np.ndarray
    link_ints: np.ndarray
    program_ints: np.ndarray
    phase_ints: np.ndarray
    phase_letters: np.ndarray

    def lanes_of(self, edge: int) -> range:
        first = int(self.edge_ints[edge, EDGE_FIRST_LANE])
        return range(first, first + int(self.edge_ints[edge, EDGE_LANES]))

    def links_of(self, lane: int) -> range:
        first = int(self.lane_ints[lane, LANE_FIRST_LINK])
        return range(first, first + int(self.lane_ints[lane, LANE_LINKS]))

    def links_between(self, edge: int, after: int) -> list[int]:
        onward = set(self.lanes_of(after))
        links = (link for lane in self.lanes_of(edge) for link in self.links_of(lane))
        return [link for link in links if int(self.link_ints[link, LINK_TO]) in onward]


def tabulate_best_lanes(net: NetTables, route_edges: np.ndarray) -> BestTables:
    """Tabulate all variants of all routes ``route_edges`` ``[R, E]`` (-1: none).

    Raises:
        IzooError: a route has more variants than the tables hold.
    """
    count, lane_count = len(route_edges), len(net.lane_ints)
    first, number = np.zeros(count, np.int32), np.zeros(count, np.int32)
    links = np.full((count, MAX_CHECKED_LINKS), -1, np.int32)
    group = np.full((count, MAX_CHECKED_LINKS), -1, np.int32)
    bits: list[int] = []
    rows: list[tuple[np.ndarray, ...]] = []
    for route, padded in enumerate(route_edges):
        edges = [int(edge) for edge in padded if edge >= 0]
        checked, patterns = _patterns(net, edges)
        for k, (link, group_of) in enumerate(checked):
            links[route, k], group[route, k] = link, group_of
        first[route], number[route] = len(rows), len(patterns)
        for pattern in patterns:
            bits.append(sum(1 << k for k, has_priority in enumerate(pattern) if has_priority))
            priority = {link: has_priority for (link, _), has_priority in zip(checked, pattern, strict=True)}
            rows.append(_best_lanes(net, edges, priority))
    best = np.zeros((len(rows), lane_count), Best)
    for row, columns in zip(best, rows, strict=True):
        row["length"], row["offset"], row["link"], row["open"], row["road"] = columns
    return BestTables(first, number, links, group, np.array(bits, np.int64), best)


def _patterns(net: NetTables, edges: Sequence[int]) -> tuple[list[tuple[int, int]], list[tuple[bool, ...]]]:
    """Return the links ``(link, group)`` whose priorities can differ, and the patterns that the signals can show."""
    checked: list[tuple[int, int]] = []
    choices: list[list[tuple[bool, ...]]] = []
    for number, (edge, after) in enumerate(itertools.pairwise(edges)):
        links = net.links_between(edge, after)
        seen = dict.fromkeys(_relevant_bits(bits) for bits in _shown(net, links))
        if len(seen) < 2 and not any(any(pattern) for pattern in seen):
            continue
        checked += [(link, number) for link in links]
        choices.append(list(seen))
    variants = math.prod(len(choice) for choice in choices)
    if len(checked) > MAX_CHECKED_LINKS or variants > _MAX_VARIANTS:
        raise IzooError(
            f"a route passes {len(checked)} links whose priorities differ, in {variants} patterns, and the twin holds "
            f"{MAX_CHECKED_LINKS} and {_MAX_VARIANTS}; use SUMO."
        )
    return checked, [tuple(itertools.chain(*parts)) for parts in itertools.product(*choices)]


def _relevant_bits(bits: Sequence[bool]) -> tuple[bool, ...]:
    """Return the pattern, or none at all if all links have priority, which is the same."""
    return tuple(bits) if any(bits) and not all(bits) else (False,) * len(bits)


def _shown(net: NetTables, links: Sequence[int]) -> list[list[bool]]:
    """Return whether each link has priority, for every phase of the signals that control ``links``."""
    programs = {int(net.link_ints[link, LINK_PROGRAM]) for link in links}
    shown = []
    for program in programs:
        if program < 0:
            continue
        start = int(net.program_ints[program, PROGRAM_FIRST_PHASE])
        phases = range(start, start + int(net.program_ints[program, PROGRAM_PHASES]))
        shown += [[_has_priority(net, link, program, phase) for link in links] for phase in phases]
    return shown or [[_has_priority(net, link, -2, 0) for link in links]]


def _has_priority(net: NetTables, link: int, program: int, phase: int) -> bool:
    letter = int(net.link_ints[link, LINK_STATE])
    if net.link_ints[link, LINK_PROGRAM] == program:
        letter = int(net.phase_letters[net.phase_ints[phase, PHASE_STATE] + net.link_ints[link, LINK_SIGNAL]])
    return UPPER_CASE <= letter < LOWER_CASE


def _best_lanes(net: NetTables, edges: Sequence[int], priority: dict[int, bool]) -> tuple[np.ndarray, ...]:
    """Return the last columns of :class:`BestTables` ``[L]`` for one pattern of priorities, from the end backwards."""
    lane_count = len(net.lane_ints)
    length, offset = np.zeros(lane_count), np.zeros(lane_count, np.int32)
    link, is_open = np.full(lane_count, -1, np.int32), np.zeros(lane_count, bool)
    last = list(net.lanes_of(edges[-1]))
    length[last] = net.lane_floats[last, LANE_LENGTH]
    is_open[last] = net.lane_ints[last, LANE_LINKS] > 0
    for edge, after in reversed(list(itertools.pairwise(edges))):
        ways = net.links_between(edge, after)
        reached = net.link_ints[ways, LINK_TO]
        connected = length[reached].max(initial=-1.0)
        longest = length[list(net.lanes_of(after))].max()
        for lane in net.lanes_of(edge):
            length[lane] = net.lane_floats[lane, LANE_LENGTH]
            is_open[lane] = net.lane_ints[lane, LANE_LINKS] > 0
            onward = [(int(net.link_ints[way, LINK_TO]), way) for way in ways if way in net.links_of(lane)]
            if not onward:
                continue
            # The longest, then the one with fewest changes ahead, then the rightmost.
            target, link[lane] = min(onward, key=lambda way: (-length[way[0]], abs(offset[way[0]]), way[0]))
            # A lane that continues further, one change away, counts like the own one.
            near = length[target] == connected and abs(offset[target]) < 2
            length[lane] += longest if near else length[target]
            offset[lane], is_open[lane] = offset[target], is_open[target]
        inside = [_inside_lanes(net, way) for way in ways]
        for way, lanes in zip(ways, inside, strict=True):
            _describe_inside(net, int(net.link_ints[way, LINK_TO]), lanes, (length, offset, link, is_open))
        _point_to_best(net.lanes_of(edge), net, priority, (length, offset, link))
    return length, offset, link, is_open, _roads_behind(net, link)


def _roads_behind(net: NetTables, link: np.ndarray) -> np.ndarray:
    """Return the next lane outside of junctions from every lane, -1 if there is none, ``[L]``."""
    onward = np.where(link < 0, -1, net.link_ints[link, LINK_NEXT])
    inside = net.lane_ints[:, LANE_INSIDE] == 1
    while (between := (onward >= 0) & inside[onward]).any():
        onward = np.where(between, onward[onward], onward)
    return onward.astype(np.int32)


def _inside_lanes(net: NetTables, way: int) -> list[int]:
    """Return the lanes inside the junction behind link ``way``."""
    lanes, lane = [], int(net.link_ints[way, LINK_NEXT])
    while net.lane_ints[lane, LANE_INSIDE]:
        lanes.append(lane)
        lane = int(net.link_ints[net.links_of(lane)[0], LINK_NEXT])
    return lanes


def _describe_inside(net: NetTables, target: int, lanes: Sequence[int], tables: tuple[np.ndarray, ...]) -> None:
    """Describe lanes inside a junction like the lane behind it, with offsets within the inside edge."""
    length, offset, link, is_open = tables
    for lane in lanes:
        siblings = net.lanes_of(int(net.lane_ints[lane, LANE_EDGE]))
        length[lane], is_open[lane], link[lane] = length[target], is_open[target], net.links_of(lane)[0]
        offset[lane] = np.clip(offset[target], siblings[0] - lane, siblings[-1] - lane)


def _point_to_best(
    lanes: range, net: NetTables, priority: dict[int, bool], tables: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """Set the offsets of an edge's lanes to the nearest of the best lanes."""
    length, offset, link = tables

    def rank(lane: int) -> tuple[float, int, int]:
        return float(length[lane]), -abs(int(offset[lane])), level[lane]

    level = {lane: -1 if link[lane] < 0 else int(priority.get(int(link[lane]), False)) for lane in lanes}
    ranks = {lane: rank(lane) for lane in lanes}
    top = max(ranks.values())
    best = [lane for lane in lanes if ranks[lane] == top]
    for lane in lanes:
        if ranks[lane] == top:
            offset[lane] = 0
            continue
        ends = (best[0], best[-1])
        offset[lane] = (ends[0] if abs(ends[0] - lane) < abs(ends[1] - lane) else ends[1]) - lane
        if level[lane] < top[2]:
            length[lane] = net.lane_floats[lane, LANE_LENGTH]


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
