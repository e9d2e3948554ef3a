"""Where the ways through a junction cross, merge and diverge, tabulated once per net.

A *way* is a lane inside a junction. A conflict of one way with another begins at some distance before the own way's end
and has a length. Both follow from the shapes of the two lanes, by rules found from the distances of vehicles to their
junction foes that SUMO reports for many pairs of ways (see the tests).
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from izoo.envs.twin.runtime.layout import (
    LANE_EDGE,
    LANE_INSIDE,
    LANE_LENGTH,
    LINK_DIRECTION,
    LINK_FROM,
    LINK_NEXT,
    LINK_TO,
    LINK_VIA,
)

CROSSING, MERGING, DIVERGING = range(3)
"""Values of ``CONFLICT_KIND``: the ways cross; lead to one lane; come from one lane."""

CONFLICT_LANE, CONFLICT_ENTRY, CONFLICT_KIND, CONFLICT_YIELDS, CONFLICT_FOE_YIELDS, CONFLICT_FOE_WAITS = range(6)
"""Columns of :attr:`Conflicts.ints`: the other way; the link by which vehicles enter it; kind; 1 where the own entry
link yields to that link; 1 where that link yields to the own; 1 where the other way ends at a waiting point."""

CONFLICT_TO_END, CONFLICT_SIZE, CONFLICT_FOE_TO_END, CONFLICT_FOE_SIZE, CONFLICT_RADIUS = range(5)
"""Columns of :attr:`Conflicts.floats` (m): from the begin of the conflict to the end of the own way; length of the
conflict on it; the same on the other way (:data:`NOWHERE` where that way ends before the own); radius of the own turn,
0 on straight ways and in sharp right turns, where SUMO does not use it."""

NOWHERE = 10000.0
APART_M = 2.5
"""Two ways that come from one lane, or lead to one, are in conflict up to this distance between them."""
_APART_BEFORE_M = 0.1
"""Ways that are :data:`APART_M` apart at least this far before a waiting point are not in conflict behind it."""
_LEAST_SINE = 0.2


class Conflicts(NamedTuple):
    """Conflicts of a net's ways.

    Attributes:
        first, count: ``[K]`` int32, of links that begin on a way: rows of that way's conflicts.
        ints: ``[C, 6]`` int32. floats: ``[C, 5]`` float64.
        wait_first, wait_count: ``[K]`` int32, of links at a waiting point inside: range of ``wait_foes``.
        wait_foes: int32, links whose vehicles a link at a waiting point yields to.
    """

    first: np.ndarray
    count: np.ndarray  # type: ignore[assignment]
    ints: np.ndarray
    floats: np.ndarray
    wait_first: np.ndarray
    wait_count: np.ndarray
    wait_foes: np.ndarray


class Ways(NamedTuple):
    """Input of the search for conflicts: tables of the twin's net, shapes and widths of lanes."""

    lane_floats: np.ndarray
    lane_ints: np.ndarray
    link_ints: np.ndarray
    shapes: list[np.ndarray]
    width_m: np.ndarray
    responses: dict[int, set[int]]
    foes: dict[int, set[int]]


def find_conflicts(root: Any, lane_rows: dict[str, int], ways: Ways) -> Conflicts:
    """Return the conflicts of all junctions of a net.

    Args:
        root: the ``<net>`` element.
        lane_rows: rows of lanes by name.
        ways: tables; ``responses`` and ``foes`` by entry link.
    """
    links = ways.link_ints
    inner = _inner_junctions(root, lane_rows)
    lanes_of = {row: _lanes_behind(ways, row) for row in range(len(links)) if _enters(ways, row)}
    entry_of = {lane: row for row, lanes in lanes_of.items() for lane in lanes}
    same_origin: dict[int, list[int]] = defaultdict(list)
    for row in lanes_of:
        same_origin[int(links[row, LINK_FROM])].append(row)
    first, count = np.zeros((2, len(links)), np.int32)
    wait_first, wait_count = np.zeros((2, len(links)), np.int32)
    rows: list[tuple[list[int], list[float]]] = []
    wait_foes: list[int] = []
    for entry, lanes in lanes_of.items():
        siblings = [lane for row in same_origin[int(links[entry, LINK_FROM])] if row != entry for lane in lanes_of[row]]
        crossed = [lane for row in sorted(ways.foes.get(entry, ())) for lane in reversed(lanes_of.get(row, []))]
        for place, lane in enumerate(lanes):
            row = _link_behind(ways, lane)
            waits = place + 1 < len(lanes)
            if len(lanes) > 1:
                incoming, inside = inner.get(lanes[-1], ([], []))
                crossed = list(dict.fromkeys(k for w in inside for k in (w, *lanes_of[entry_of[w]]) if w in entry_of))
                if waits:
                    found = _waiting_foes(ways, entry, lanes_of, incoming, inside)
                    wait_first[row], wait_count[row] = len(wait_foes), len(found)
                    wait_foes += found
            first[row] = len(rows)
            for other in dict.fromkeys([*crossed, *siblings]):
                foe = entry_of[other]
                if foe != entry and not _diverge_before(ways, lanes_of, entry, lane, foe, other):
                    conflict = _conflict(ways, lanes_of, entry, lane, foe, other)
                    ints, floats = conflict
                    crosses = floats[CONFLICT_TO_END] > 0.0 or floats[CONFLICT_FOE_TO_END] == NOWHERE
                    if crosses or ints[CONFLICT_KIND] != CROSSING:
                        rows.append(conflict)
            count[row] = len(rows) - first[row]
    return Conflicts(
        first,
        count,
        np.array([ints for ints, _ in rows], np.int32).reshape(-1, 6),
        np.array([floats for _, floats in rows], np.float64).reshape(-1, 5),
        wait_first,
        wait_count,
        np.array(wait_foes, np.int32),
    )


def _enters(ways: Ways, row: int) -> bool:
    link = ways.link_ints[row]
    return bool(link[LINK_VIA] >= 0 and not ways.lane_ints[link[LINK_FROM], LANE_INSIDE])


def _lanes_behind(ways: Ways, row: int) -> list[int]:
    """Return the ways behind an entry link in order: one, or two with a waiting point between them."""
    lanes, lane = [], int(ways.link_ints[row, LINK_VIA])
    while ways.lane_ints[lane, LANE_INSIDE]:
        lanes.append(lane)
        lane = int(ways.link_ints[_link_behind(ways, lane), LINK_NEXT])
    return lanes


def _link_behind(ways: Ways, lane: int) -> int:
    return int(np.flatnonzero(ways.link_ints[:, LINK_FROM] == lane)[0])


def _inner_junctions(root: Any, lane_rows: dict[str, int]) -> dict[int, tuple[list[int], list[int]]]:
    """Return, by the way behind each waiting point, the lanes that it yields to, and the ways in conflict."""

    def rows(names: str | None) -> list[int]:
        return [lane_rows[name] for name in (names or "").split() if name in lane_rows]

    return {
        lane_rows[junction.get("id")]: (rows(junction.get("incLanes"))[1:], rows(junction.get("intLanes")))
        for junction in root.findall("junction")
        if junction.get("type") == "internal" and junction.get("id") in lane_rows
    }


def _waiting_foes(
    ways: Ways, entry: int, lanes_of: dict[int, list[int]], incoming: list[int], inside: list[int]
) -> list[int]:
    """Return the links that a waiting point yields to.

    They are the foes from ``incoming``, and the waiting points of these and of the ways ``inside`` that conflict, but
    not those that yield to it in turn, nor those of the same road.
    """
    links = ways.link_ints
    foes = [row for row in sorted(ways.responses.get(entry, ())) if int(links[row, LINK_FROM]) in incoming]
    behind = [_link_behind(ways, lane) for row in foes for lane in lanes_of.get(row, [])]
    behind += [_link_behind(ways, lane) for lane in inside]
    entry_of = {lane: row for row, lanes in lanes_of.items() for lane in lanes}
    waiting = [row for row in behind if links[row, LINK_VIA] >= 0]
    waiting = [row for row in waiting if entry not in ways.responses.get(entry_of[int(links[row, LINK_FROM])], ())]
    edges = ways.lane_ints[:, LANE_EDGE]
    road = edges[links[entry, LINK_FROM]]
    waiting = [row for row in waiting if edges[links[entry_of[int(links[row, LINK_FROM])], LINK_FROM]] != road]
    return list(dict.fromkeys([*foes, *waiting]))


def _conflict(
    ways: Ways, lanes_of: dict[int, list[int]], entry: int, lane: int, foe: int, other: int
) -> tuple[list[int], list[float]]:
    """Return a row of ``ints`` and one of ``floats``."""
    links = ways.link_ints
    last, last_foe = lane == lanes_of[entry][-1], other == lanes_of[foe][-1]
    waits = not last_foe
    yields = foe in ways.responses.get(entry, ())
    if links[entry, LINK_FROM] == links[foe, LINK_FROM]:
        kind = DIVERGING
        own, theirs = _divergence(ways, lanes_of, entry, lane, foe, other)
        sizes = ways.width_m[other], ways.width_m[lane]
    elif last and last_foe and links[entry, LINK_TO] == links[foe, LINK_TO]:
        kind = MERGING
        own, theirs = _overlap(ways, lane, other, at_begin=False)
        sizes = ways.width_m[other], ways.width_m[lane]
    else:
        kind = CROSSING
        own, own_size = _crossing(ways, lane, other)
        theirs, their_size = _crossing(ways, other, lane)
        sizes = own_size, their_size
        if own > 0.0 and theirs == 0.0 and not _intersections(ways.shapes[lane], ways.shapes[other]):
            own_road, their_road = (ways.lane_ints[links[row, LINK_FROM], LANE_EDGE] for row in (entry, foe))
            if own_road == their_road:
                # It only ends beside a way of the same road: no conflict.
                own = theirs = 0.0
            else:
                theirs = NOWHERE
        elif own == theirs == 0.0 and last and waits and yields and links[entry, LINK_TO] == links[foe, LINK_TO]:
            # The foe is before its waiting point and will merge.
            theirs = NOWHERE
    foe_yields = entry in ways.responses.get(foe, ())
    radius = _radius(ways, lanes_of, entry)
    return [other, foe, kind, int(yields), int(foe_yields), int(waits)], [own, sizes[0], theirs, sizes[1], radius]


def _radius(ways: Ways, lanes_of: dict[int, list[int]], entry: int) -> float:
    """Return the radius (m) of the arc that is as long as the ways behind ``entry`` and turns as far."""
    link = ways.link_ints[entry]
    if chr(link[LINK_DIRECTION]) in "sr":
        return 0.0
    before, after = ways.shapes[link[LINK_FROM]][-2:, :2], ways.shapes[link[LINK_TO]][:2, :2]
    headings = [math.atan2(*(shape[1] - shape[0])[::-1]) for shape in (before, after)]
    angle = abs((headings[1] - headings[0] + math.pi) % (2.0 * math.pi) - math.pi)
    return sum(float(_lengths(ways.shapes[lane])[-1]) for lane in lanes_of[entry]) / angle if angle > 0.0 else 0.0


def _lengths(shape: np.ndarray) -> np.ndarray:
    """Return the horizontal distance ``[n]`` along a shape to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape[:, :2], axis=0), axis=1))])


def _scale(ways: Ways, lane: int) -> float:
    """Return metres of lane position per metre of drawn shape."""
    return float(ways.lane_floats[lane, LANE_LENGTH]) / max(_drawn_m(ways, lane), 1e-9)


def _drawn_m(ways: Ways, lane: int) -> float:
    """Return the length of a lane's shape, slopes included."""
    return float(np.linalg.norm(np.diff(ways.shapes[lane], axis=0), axis=1).sum())


def _intersections(one: np.ndarray, other: np.ndarray) -> list[tuple[float, float, float]]:
    """Return ``(distance along one, distance along other, sine of the angle)`` of each crossing of two shapes."""
    found = []
    along_one, along_other = _lengths(one), _lengths(other)
    for i, (a, b) in enumerate(itertools.pairwise(one[:, :2])):
        for j, (c, d) in enumerate(itertools.pairwise(other[:, :2])):
            u, w = b - a, d - c
            cross = u[0] * w[1] - u[1] * w[0]
            if abs(cross) < 1e-9:
                continue
            to = c - a
            s, t = (to[0] * w[1] - to[1] * w[0]) / cross, (to[0] * u[1] - to[1] * u[0]) / cross
            if -1e-9 <= s <= 1.0 + 1e-9 and -1e-9 <= t <= 1.0 + 1e-9:
                long_u, long_w = np.hypot(*u), np.hypot(*w)
                found.append((along_one[i] + s * long_u, along_other[j] + t * long_w, abs(cross) / (long_u * long_w)))
    return sorted(found)


def _crossing(ways: Ways, lane: int, other: int) -> tuple[float, float]:
    """Return how far before the end of ``lane`` its conflict with a crossing way begins, and the conflict's length."""
    shape, foe = ways.shapes[lane], ways.shapes[other]
    length = ways.lane_floats[lane, LANE_LENGTH]
    width = ways.width_m[other]
    found = _intersections(shape, foe)
    if found:
        along, _, sine = found[-1]
    else:
        along, distance, sine = _nearest_end(shape, foe)
        if distance >= 0.5 * width:
            return 0.0, float(width)
    size = width * (2.0 / max(sine, _LEAST_SINE) - 1.0)
    size = min(size, 2.0 * length)
    begin = max(0.0, (along - 0.5 * size) * _scale(ways, lane))
    return float(length - begin), float(size)


def _nearest_end(shape: np.ndarray, foe: np.ndarray) -> tuple[float, float, float]:
    """Return where ``shape`` is nearest to the end of ``foe``, the distance there, and the sine of the angle."""
    along, distance, direction = _nearest(shape, foe[-1, :2])
    ahead = foe[-1, :2] - foe[-2, :2]
    cross = abs(direction[0] * ahead[1] - direction[1] * ahead[0]) / max(float(np.hypot(*ahead)), 1e-9)
    return along, distance, float(cross)


def _nearest(shape: np.ndarray, point: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return the distance along ``shape`` to its point nearest to ``point``, that from it, and the direction there."""
    best = (0.0, np.inf, np.array([1.0, 0.0]))
    along = _lengths(shape)
    for i, (a, b) in enumerate(itertools.pairwise(shape[:, :2])):
        u = b - a
        long_u = float(np.hypot(*u))
        if long_u < 1e-9:
            continue
        t = float(np.clip((point - a) @ u / long_u**2, 0.0, 1.0))
        distance = float(np.hypot(*(a + t * u - point)))
        if distance < best[1]:
            best = (float(along[i] + t * long_u), distance, u / long_u)
    return best


def _divergence(
    ways: Ways, lanes_of: dict[int, list[int]], entry: int, lane: int, foe: int, other: int
) -> tuple[float, float]:
    """Return how far before their ends two ways from one lane have diverged."""
    own, theirs = lanes_of[entry], lanes_of[foe]
    if lane == own[0] and other == theirs[0]:
        return _overlap(ways, lane, other, at_begin=True)
    # Ways behind a waiting point count as never diverging: up to the end of the shorter. Two such ways are assumed to
    # begin side by side.
    behind = lane != own[0] and other != theirs[0]
    lengths = [
        sum(float(ways.lane_floats[k, LANE_LENGTH]) for k in chain[int(behind) : chain.index(end) + 1])
        for chain, end in ((own, lane), (theirs, other))
    ]
    return lengths[0] - min(lengths), lengths[1] - min(lengths)


def _diverge_before(ways: Ways, lanes_of: dict[int, list[int]], entry: int, lane: int, foe: int, other: int) -> bool:
    """Whether two ways from one lane, one or both of them behind waiting points, have diverged before."""
    own, theirs = lanes_of[entry][0], lanes_of[foe][0]
    if ways.link_ints[entry, LINK_FROM] != ways.link_ints[foe, LINK_FROM] or (lane == own and other == theirs):
        return False
    return min(_overlap(ways, own, theirs, at_begin=True)) > _APART_BEFORE_M


def _overlap(ways: Ways, lane: int, other: int, at_begin: bool) -> tuple[float, float]:
    """Return the distances to the ends of two ways from where they diverge or merge.

    The distance between two ways is measured at the points of each shape and interpolated linearly.
    """
    one, two = ways.shapes[lane][:, :2], ways.shapes[other][:, :2]
    if not at_begin:
        one, two = one[::-1], two[::-1]
    ends = [float(ways.lane_floats[k, LANE_LENGTH]) for k in (lane, other)]
    # SUMO subtracts the rest of the drawn shape from the nominal length.
    common = max(
        _apart(a, b) - float(_lengths(a)[-1]) + end for a, b, end in ((one, two, ends[0]), (two, one, ends[1]))
    )
    common = min(common, float(_lengths(one)[-1]), float(_lengths(two)[-1]))
    if not at_begin:
        return common * _scale(ways, lane), common * _scale(ways, other)
    if ways.lane_ints[lane, LANE_EDGE] == ways.lane_ints[other, LANE_EDGE]:
        # Ways into neighbouring lanes of one road are measured from their common begin.
        return ends[0] - common, ends[1] - common
    # The rest of a way that ends before the two have diverged is in metres of the drawing.
    own, theirs = (
        _drawn_m(ways, k) - common if common >= end else end - common * _scale(ways, k)
        for k, end in zip((lane, other), ends, strict=True)
    )
    return own, theirs


def _apart(shape: np.ndarray, other: np.ndarray) -> float:
    """Return the distance along ``shape`` at which it is :data:`APART_M` from ``other``, its length if it never is."""
    along = _lengths(shape)
    distances = [_nearest(other, point)[1] for point in shape]
    for k in range(1, len(shape)):
        if distances[k] > APART_M:
            before = distances[k - 1]
            if before >= APART_M:
                return float(along[k - 1])
            share = (APART_M - before) / (distances[k] - before)
            return float(along[k - 1] + share * (along[k] - along[k - 1]))
    return float(along[-1])
