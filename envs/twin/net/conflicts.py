"""Where the ways through a junction cross, merge and diverge, tabulated once per net.

A *way* is a lane inside a junction. A conflict of one way with another begins at some distance before the own way's end
and has a length. Both follow from the shapes of the two lanes, by rules found from the distances of vehicles to their
junction foes that SUMO reports for many pairs of ways (see the tests).
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from izoo.envs.twin.net.polylines import Polylines
from izoo.envs.twin.net.tables import NetTables

CROSSING, MERGING, DIVERGING = range(3)
"""Values of ``kind``: the ways cross; lead to one lane; come from one lane."""

NOWHERE = 10000.0
_APART_BEFORE_M = 0.1
"""Ways that have diverged at least this far before a waiting point are not in conflict behind it."""
_LEAST_SINE = 0.2


Row = tuple[float, float, float, float, float, int, int, int, int, int, int]
"""A :data:`~izoo.envs.twin.runtime.layout.Conflict`."""


class Ways(NamedTuple):
    """Input of the search for conflicts: a net, its lanes' shapes and widths (m), and what each link yields to and its
    foes."""

    net: NetTables
    shapes: list[np.ndarray]
    width_m: list[float]
    responses: dict[int, set[int]]
    foes: dict[int, set[int]]


def find_conflicts(root: Any, lane_rows: dict[str, int], ways: Ways) -> tuple[list[Row], list[int]]:
    """Find the conflicts of all junctions of a net, and set the ranges of its links.

    Args:
        root: the ``<net>`` element.
        lane_rows: rows of lanes by name.
        ways: the net.

    Returns:
        The conflicts, those of one way in neighbouring rows, and the links whose vehicles others yield to at waiting
        points.
    """
    search = _Search(ways)
    links, lanes_of, entry_of = search.links, search.lanes_of, search.entry_of
    inner = _inner_junctions(root, lane_rows)
    same_origin: dict[int, list[int]] = defaultdict(list)
    for row in lanes_of:
        same_origin[links[row].from_lane].append(row)
    pairs_of: dict[int, list[_Pair]] = {}
    wait_foes: list[int] = []
    for entry, lanes in lanes_of.items():
        siblings = [lane for row in same_origin[links[entry].from_lane] if row != entry for lane in lanes_of[row]]
        crossed = [lane for row in sorted(ways.foes.get(entry, ())) for lane in reversed(lanes_of.get(row, []))]
        for place, lane in enumerate(lanes):
            row = search.behind[lane]
            if len(lanes) > 1:
                incoming, inside = inner.get(lanes[-1], ([], []))
                crossed = list(dict.fromkeys(k for w in inside for k in (w, *lanes_of[entry_of[w]]) if w in entry_of))
                if place + 1 < len(lanes):
                    found = search.waiting_foes(entry, incoming, inside)
                    links[row].first_wait, links[row].waits = len(wait_foes), len(found)
                    wait_foes += found
            others = dict.fromkeys([*crossed, *siblings])
            pairs_of[row] = [_Pair(entry, lane, entry_of[k], k) for k in others if entry_of[k] != entry]
    rows: list[Row] = []
    geometry = _Geometry(search, [pair for pairs in pairs_of.values() for pair in pairs])
    for row, pairs in pairs_of.items():
        links[row].first_conflict = len(rows)
        rows += filter(None, map(geometry.conflict, pairs))
        links[row].conflicts = len(rows) - links[row].first_conflict
    return rows, wait_foes


def _inner_junctions(root: Any, lane_rows: dict[str, int]) -> dict[int, tuple[list[int], list[int]]]:
    """Return, by the way behind each waiting point, the lanes that it yields to, and the ways in conflict."""

    def rows(names: str | None) -> list[int]:
        return [lane_rows[name] for name in (names or "").split() if name in lane_rows]

    return {
        lane_rows[junction.get("id")]: (rows(junction.get("incLanes"))[1:], rows(junction.get("intLanes")))
        for junction in root.findall("junction")
        if junction.get("type") == "internal" and junction.get("id") in lane_rows
    }


class _Pair(NamedTuple):
    """Two ways and the links by which vehicles enter them: the own one, and the foe's."""

    entry: int
    lane: int
    foe: int
    other: int


class _Search:
    """Which links lead to which ways.

    Attributes:
        links, lanes: rows of the net.
        behind: by lane, the first link that begins on it.
        lanes_of: by entry link, the ways behind it in order: one, or two with a waiting point between them.
        entry_of: by way, its entry link.
    """

    def __init__(self, ways: Ways) -> None:
        self.ways = ways
        self.links, self.lanes = ways.net.links, ways.net.lanes
        self.behind = {link.from_lane: row for row, link in reversed(list(enumerate(self.links)))}
        self.lanes_of = {
            row: ways.net.inside_lanes(row)
            for row, link in enumerate(self.links)
            if link.via_lane >= 0 and not self.lanes[link.from_lane].inside
        }
        self.entry_of = {lane: row for row, lanes in self.lanes_of.items() for lane in lanes}

    def waiting_foes(self, entry: int, incoming: list[int], inside: list[int]) -> list[int]:
        """Return the links that a waiting point yields to.

        They are the foes from ``incoming``, and the waiting points of these and of the ways ``inside`` that conflict,
        but not those that yield to it in turn, nor those of the same road.
        """
        links, responses = self.links, self.ways.responses
        foes = [row for row in sorted(responses.get(entry, ())) if links[row].from_lane in incoming]
        lanes = [*(lane for row in foes for lane in self.lanes_of.get(row, [])), *inside]
        waiting = [row for row in (self.behind[lane] for lane in lanes) if links[row].via_lane >= 0]
        entries = {row: self.entry_of[links[row].from_lane] for row in waiting}
        road = self.lanes[links[entry].from_lane].edge
        waiting = [
            row
            for row in waiting
            if entry not in responses.get(entries[row], ()) and self.lanes[links[entries[row]].from_lane].edge != road
        ]
        return list(dict.fromkeys([*foes, *waiting]))

    def kind(self, pair: _Pair) -> int:
        """Return the kind of conflict that two ways may be in."""
        own, theirs = self.links[pair.entry], self.links[pair.foe]
        if own.from_lane == theirs.from_lane:
            return DIVERGING
        ends = pair.lane == self.lanes_of[pair.entry][-1] and pair.other == self.lanes_of[pair.foe][-1]
        return MERGING if ends and own.to_lane == theirs.to_lane else CROSSING


class _Geometry:
    """Where ways conflict, by their shapes.

    Args:
        search: which links lead to which ways.
        pairs: all that :meth:`conflict` will be asked for.
    """

    def __init__(self, search: _Search, pairs: list[_Pair]) -> None:
        self.search, self.ways = search, search.ways
        self.width_m = self.ways.width_m
        self.length_m: list[float] = [lane.length for lane in search.lanes]
        steps = {lane: np.diff(self.ways.shapes[lane], axis=0) for lane in search.entry_of}
        self.drawn_m = {lane: float(np.linalg.norm(step, axis=1).sum()) for lane, step in steps.items()}
        """Lengths of shapes, slopes included."""
        self.scale = {lane: self.length_m[lane] / max(drawn_m, 1e-9) for lane, drawn_m in self.drawn_m.items()}
        """Metres of lane position per metre of drawn shape."""
        shapes = [shape[:, :2] for shape in self.ways.shapes]
        self.shapes, backwards = Polylines(shapes), Polylines([shape[::-1] for shape in shapes])
        by_kind: dict[int, list[_Pair]] = {kind: [] for kind in (CROSSING, MERGING, DIVERGING)}
        for pair in pairs:
            by_kind[search.kind(pair)].append(pair)
        first = {row: lanes[0] for row, lanes in search.lanes_of.items()}
        self.diverging = self._overlaps(self.shapes, {(first[p.entry], first[p.foe]) for p in by_kind[DIVERGING]})
        self.merging = self._overlaps(backwards, {(p.lane, p.other) for p in by_kind[MERGING]})
        ways = dict.fromkeys(ways for p in by_kind[CROSSING] for ways in ((p.lane, p.other), (p.other, p.lane)))
        self.meetings = self.shapes.crossings(list(ways))
        apart = [pair for pair in ways if pair not in self.meetings]
        ends = np.array([shapes[other][-1] for _, other in apart])
        self.nearest = dict(zip(apart, self.shapes.nearest([lane for lane, _ in apart], ends), strict=True))
        self.radius_m = {entry: self._radius_m(entry) for entry in search.lanes_of}

    def conflict(self, pair: _Pair) -> Row | None:
        """Return the record of two ways, or ``None`` where they are not in conflict."""
        links, responses = self.search.links, self.ways.responses
        entry, lane, foe, other = pair
        own_link, foe_link = links[entry], links[foe]
        waits = other != self.search.lanes_of[foe][-1]
        yields, foe_yields = foe in responses.get(entry, ()), entry in responses.get(foe, ())
        sizes = 0.0, 0.0
        kind = self.search.kind(pair)
        if kind == DIVERGING:
            if self._diverged_before(pair):
                return None
            own, theirs = self._divergence(pair)
        elif kind == MERGING:
            own, theirs = (self.merging[lane, other] * self.scale[k] for k in (lane, other))
        else:
            own, own_size = self._crossing(lane, other)
            theirs, their_size = self._crossing(other, lane)
            sizes = own_size, their_size
            last = lane == self.search.lanes_of[entry][-1]
            if own > 0.0 and theirs == 0.0 and (lane, other) not in self.meetings:
                if self.search.lanes[own_link.from_lane].edge == self.search.lanes[foe_link.from_lane].edge:
                    return None  # It only ends beside a way of the same road.
                theirs = NOWHERE
            elif own == theirs == 0.0 and last and waits and yields and own_link.to_lane == foe_link.to_lane:
                # The foe is before its waiting point and will merge.
                theirs = NOWHERE
            if own <= 0.0 and theirs != NOWHERE:
                return None
        where = own, sizes[0], theirs, sizes[1], self.radius_m[entry]
        return *where, other, foe, kind, int(yields), int(foe_yields), int(waits)

    def _radius_m(self, entry: int) -> float:
        """Return the radius of the arc that is as long as the ways behind ``entry`` and turns as far."""
        link = self.search.links[entry]
        if chr(link.direction) in "sr":
            return 0.0
        before, after = self.ways.shapes[link.from_lane][-2:, :2], self.ways.shapes[link.to_lane][:2, :2]
        headings = [math.atan2(*(shape[1] - shape[0])[::-1]) for shape in (before, after)]
        angle = abs((headings[1] - headings[0] + math.pi) % (2.0 * math.pi) - math.pi)
        return sum(self.shapes.length_m[lane] for lane in self.search.lanes_of[entry]) / angle if angle > 0.0 else 0.0

    def _crossing(self, lane: int, other: int) -> tuple[float, float]:
        """Return how far before the end of ``lane`` its conflict with a crossing way begins, and its length."""
        length, width = self.length_m[lane], self.width_m[other]
        if (meeting := self.meetings.get((lane, other))) is not None:
            along, sine = meeting.along_m, meeting.sine
        else:
            nearest = self.nearest[lane, other]
            if nearest.distance_m >= 0.5 * width:
                return 0.0, width
            along, (x, y) = nearest.along_m, nearest.direction
            ahead = self.ways.shapes[other][-1, :2] - self.ways.shapes[other][-2, :2]
            sine = abs(x * float(ahead[1]) - y * float(ahead[0])) / max(float(np.hypot(*ahead)), 1e-9)
        size = min(width * (2.0 / max(sine, _LEAST_SINE) - 1.0), 2.0 * length)
        return length - max(0.0, (along - 0.5 * size) * self.scale[lane]), size

    def _divergence(self, pair: _Pair) -> tuple[float, float]:
        """Return how far before their ends two ways from one lane have diverged."""
        own, theirs = self.search.lanes_of[pair.entry], self.search.lanes_of[pair.foe]
        if pair.lane == own[0] and pair.other == theirs[0]:
            return self._rest_behind(pair.lane, pair.other)
        # Ways behind a waiting point count as never diverging: up to the end of the shorter. Two such ways are assumed
        # to begin side by side.
        behind = pair.lane != own[0] and pair.other != theirs[0]
        lengths = [
            sum(self.length_m[k] for k in chain[int(behind) : chain.index(end) + 1])
            for chain, end in ((own, pair.lane), (theirs, pair.other))
        ]
        return lengths[0] - min(lengths), lengths[1] - min(lengths)

    def _diverged_before(self, pair: _Pair) -> bool:
        """Whether two ways from one lane, one or both of them behind waiting points, have diverged before."""
        own, theirs = self.search.lanes_of[pair.entry][0], self.search.lanes_of[pair.foe][0]
        if pair.lane == own and pair.other == theirs:
            return False
        return min(self._rest_behind(own, theirs)) > _APART_BEFORE_M

    def _overlaps(self, shapes: Polylines, pairs: set[tuple[int, int]]) -> dict[tuple[int, int], float]:
        """Return for how many metres, from where they begin, two shapes are less than :data:`APART_M` apart."""
        both = [ways for lane, other in sorted(pairs) for ways in ((lane, other), (other, lane))]
        apart, length = shapes.apart(both), shapes.length_m
        # SUMO subtracts the rest of the drawn shape from the nominal length.
        common = {ways: apart[ways] - length[ways[0]] + self.length_m[ways[0]] for ways in both}
        return {
            (lane, other): min(max(common[lane, other], common[other, lane]), length[lane], length[other])
            for lane, other in pairs
        }

    def _rest_behind(self, lane: int, other: int) -> tuple[float, float]:
        """Return how far before their ends two ways that begin together have diverged."""
        common = self.diverging[lane, other]
        ends = [self.length_m[k] for k in (lane, other)]
        if self.search.lanes[lane].edge == self.search.lanes[other].edge:
            # Ways into neighbouring lanes of one road are measured from their common begin.
            return ends[0] - common, ends[1] - common
        # The rest of a way that ends before the two have diverged is in metres of the drawing.
        own, theirs = (
            self.drawn_m[k] - common if common >= end else end - common * self.scale[k]
            for k, end in zip((lane, other), ends, strict=True)
        )
        return own, theirs
