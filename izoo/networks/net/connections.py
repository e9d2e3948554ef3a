"""Which lane of an approach leads to which lane of which exit at the main signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from izoo.contexts.movements import deflection_deg, exits_by_turn
from izoo.contexts.spec import IntersectionSpec, Leg
from izoo.errors import IzooError

_TURN_WORDS = {"r": "right", "s": "straight on", "l": "left"}


@dataclass(frozen=True)
class Link:
    """One lane connection across the junction; lanes count from the right, from 0."""

    from_leg: str
    from_lane: int
    to_leg: str
    to_lane: int
    turn: str


def signal_links(spec: IntersectionSpec) -> tuple[Link, ...]:
    """Return all connections across the junction; the position of a link is its index at the signal.

    Lanes that share a turn with several exits divide these among themselves from right to left, so that each exit is
    reached and paths do not cross. Right turns and straight movements fill the exit from its right lane, lefts from its
    left lane.

    Raises:
        IzooError: a lane may take a turn that leads to no exit.
    """
    links: list[Link] = []
    for leg in spec.legs:
        if leg.approach is not None:
            links += sorted(_approach_links(spec, leg), key=lambda link: (link.from_lane, "rsl".index(link.turn)))
    return tuple(links)


def _approach_links(spec: IntersectionSpec, leg: Leg) -> list[Link]:
    assert leg.approach is not None
    exits = exits_by_turn(spec.legs, leg.name)
    for index, turns in enumerate(leg.approach.lanes):
        for turn in turns:
            # In finished nets a turn without an exit is a U-turn.
            if turn not in exits and spec.net_path is None:
                raise IzooError(
                    f"intersection {spec.name}: lane {index} of approach {leg.name} may go {_TURN_WORDS[turn]}, but no "
                    f"leg with outgoing lanes lies there (exits of {leg.name}: {exits}); remove the turn from the lane."
                )
    links: list[Link] = []
    for turn, names in exits.items():
        lanes = [index for index, turns in enumerate(leg.approach.lanes) if turn in turns]
        if lanes:
            # Right to left, like the lanes.
            ordered = sorted((spec.leg(name) for name in names), key=lambda to: -_deflection(leg, to))
            for to, served in zip(ordered, _divide(lanes, len(ordered)), strict=True):
                targets = _target_lanes(len(served), to.exit_lanes, from_left=turn == "l")
                links += [
                    Link(leg.name, lane, to.name, target, turn) for lane, target in zip(served, targets, strict=True)
                ]
    return links


def _deflection(leg: Leg, to: Leg) -> float:
    return deflection_deg(leg.bearing_deg, to.bearing_deg)


def _divide(lanes: Sequence[int], exit_count: int) -> list[list[int]]:
    """Return, per exit from right to left, the lanes that lead to it: contiguous, every lane and every exit used."""
    served: list[list[int]] = [[] for _ in range(exit_count)]
    for position, lane in enumerate(lanes):
        first = position * exit_count // len(lanes)
        last = -(-(position + 1) * exit_count // len(lanes)) - 1
        for exit_ in range(first, last + 1):
            served[exit_].append(lane)
    return served


def _target_lanes(lane_count: int, exit_lanes: int, *, from_left: bool) -> list[int]:
    """Return the exit lane of each of ``lane_count`` lanes; surplus lanes merge into the last one on the far side."""
    if from_left:
        return [max(exit_lanes - lane_count + position, 0) for position in range(lane_count)]
    return [min(position, exit_lanes - 1) for position in range(lane_count)]
