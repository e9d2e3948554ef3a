"""The incoming and the outgoing side of a leg, from the carriageways that OpenStreetMap has for it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from izoo.contexts.spec import Approach
from izoo.networks.osm.junctions import StreetGraph
from izoo.networks.osm.legs import CUT_LENGTH_M, Street, Stub
from izoo.networks.osm.tags import MAX_LANES, Lanes, assign_turns, lanes_towards, speed_limit

STOP_ZONE_M = 30.0
"""Of the ways within this distance of the core, the one with most lanes tells what is at the stop line; of several
with as many, one with tagged turns."""
POCKET_WITHIN_M = 150.0
MIN_POCKET_M, MIN_MAIN_M = 20.0, 30.0
MIN_LENGTH_M = 15.0


@dataclass(frozen=True)
class _Side:
    """Lanes of one arriving carriageway, and how many of them begin as pockets, within what distance."""

    lanes: Lanes
    main: int
    pocket_m: float


def exit_of(street: Street) -> tuple[int, float, float]:
    """Lanes, length (m) and speed limit (m/s) of the outgoing side; 0 lanes for a street that only leads in."""
    if not street.leaving:
        return 0, 0.0, 0.0
    lanes = sum(
        len(lanes_towards(stub.pieces[0].way, stub.pieces[0].outward, arriving=False).turns) for stub in street.leaving
    )
    main = max(street.leaving, key=lambda stub: stub.length_m)
    limit, _ = speed_limit(main.pieces[0].way, main.pieces[0].outward)
    return min(lanes, MAX_LANES), _length(main), limit


def approach_of(
    graph: StreetGraph, street: Street, leg: str, available: frozenset[str], banned: frozenset[str], guessed: list[str]
) -> Approach:
    """Describe the incoming side; grade and demand are left at 0.

    Args:
        graph: the streets.
        street: the leg; it has an arriving carriageway.
        leg: its letter.
        available: turns that have an exit.
        banned: turns that restrictions forbid.
        guessed: takes the names of imputed values.
    """
    main = max(street.arriving, key=lambda stub: (len(_side(stub).lanes.turns), stub.length_m))
    sides = [_side(stub) if stub is main else _joining(graph, stub, main, street) for stub in street.arriving]
    limit, limit_guessed = speed_limit(main.pieces[0].way, -main.pieces[0].outward)
    tagged = Lanes(
        tuple(turns for side in sides for turns in side.lanes.turns)[:MAX_LANES],
        any(side.lanes.guessed for side in sides),
        sides[-1].lanes.left_lane,
    )
    turns, turns_guessed = assign_turns(tagged, available, banned)
    if "r" in available - banned and not any("r" in lane for lane in turns) and _has_slip(graph, main):
        turns = ("r" + turns[0], *turns[1:])
    length = _length(main)
    if main.cut:
        # The other carriageway tells how far the neighbour is where this one leaves the extract.
        length = max([length, *(stub.length_m for stub in street.leaving)])
    pocket = max((side.pocket_m for side in sides if side.main < len(side.lanes.turns)), default=0.0)
    pocket = min(max(pocket, MIN_POCKET_M), POCKET_WITHIN_M)
    fits = pocket + MIN_MAIN_M <= length
    right, left = _pockets(sides, street.arriving.index(main), turns) if fits else (0, 0)
    marks = {"lanes": tagged.guessed, "turns": turns_guessed, "speed limit": limit_guessed, "length": main.cut}
    guessed += [f"{what} of {leg}" for what, was_guessed in marks.items() if was_guessed]
    return Approach(
        lanes=turns,
        length_m=length,
        speed_limit_mps=limit,
        grade=0.0,
        aadt_per_lane=0.0,
        right_pockets=right,
        left_pockets=left,
        pocket_length_m=pocket if right + left else 0.0,
    )


def _length(stub: Stub) -> float:
    return max(stub.length_m, CUT_LENGTH_M if stub.cut else MIN_LENGTH_M)


def _profile(stub: Stub) -> list[tuple[float, Lanes]]:
    """Per piece: the distance from the core at which it begins, and its lanes towards the core."""
    found, begin = [], 0.0
    for piece in stub.pieces:
        found.append((begin, lanes_towards(piece.way, -piece.outward, arriving=True)))
        begin += piece.length_m
    return found


def _side(stub: Stub) -> _Side:
    """Lanes at the stop line of a carriageway, and its pockets."""
    profile = _profile(stub)
    near = [lanes for begin, lanes in profile if begin < STOP_ZONE_M]
    # Turns are often tagged on a way that ends a little before the junction.
    lanes = max(near, key=lambda lanes: (len(lanes.turns), not lanes.guessed, any(lanes.turns)))
    for begin, upstream in profile:
        fewer = len(upstream.turns) < len(lanes.turns) and not upstream.guessed and not lanes.guessed
        if 0.0 < begin <= POCKET_WITHIN_M and fewer:
            return _Side(lanes, len(upstream.turns), begin)
    return _Side(lanes, len(lanes.turns), 0.0)


def _joining(graph: StreetGraph, stub: Stub, main: Stub, street: Street) -> _Side:
    """A further arriving carriageway: where it parts from the main one within 150 m, its lanes are pockets."""
    side = _side(stub)
    shared, distance = set(main.nodes), 0.0
    for before, node in itertools.pairwise(stub.nodes):
        distance += graph.distance(before, node)
        if distance > POCKET_WITHIN_M:
            break
        if node in shared:
            turn = "r" if street.arriving.index(stub) < street.arriving.index(main) else "l"
            turns = tuple(turns or turn for turns in side.lanes.turns)
            return _Side(Lanes(turns, side.lanes.guessed), 0, distance)
    return side


def _has_slip(graph: StreetGraph, stub: Stub) -> bool:
    """Whether a one-way street parts from the approach within 150 m of the stop line: a slip lane for right turns."""
    walked, distance = set(stub.nodes), 0.0
    for before, node in itertools.pairwise(stub.nodes):
        distance += graph.distance(before, node)
        if distance > POCKET_WITHIN_M:
            return False
        for other, way, direction in graph.links[node]:
            if other not in walked and way.oneway == direction:
                return True
    return False


def _pockets(sides: list[_Side], main: int, turns: tuple[str, ...]) -> tuple[int, int]:
    """How many of the lanes ``turns`` are pockets, on the right and on the left.

    Lanes of carriageways that join beside the main one lie on their side. Of the main one's, lanes for left turns
    alone come first, then lanes for right turns alone, then the left side if it turns left.
    """
    right, left = (
        sum(len(side.lanes.turns) - side.main for side in part) for part in (sides[:main], sides[main + 1 :])
    )
    extra = min(len(sides[main].lanes.turns) - sides[main].main, len(turns) - 1 - right - left)
    while extra > 0 and turns[len(turns) - 1 - left] == "l":
        left, extra = left + 1, extra - 1
    while extra > 0 and turns[right] == "r":
        right, extra = right + 1, extra - 1
    if extra > 0 and "l" in turns[-1]:
        return right, left + extra
    return right + max(extra, 0), left
