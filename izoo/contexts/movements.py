"""Which way a movement turns, and which movements conflict, from the bearings of an intersection's legs alone."""

from __future__ import annotations

from collections.abc import Sequence

from izoo.contexts.spec import Leg

STRAIGHT_WITHIN_DEG = 45.0
_SIDE_DEG = 1.0
"""Incoming and outgoing lanes lie this far to either side of a leg's bearing (traffic keeps right)."""


def deflection_deg(from_bearing_deg: float, to_bearing_deg: float) -> float:
    """Return by how much a movement turns, in (-180, 180]: positive to the right, 180 for a U-turn."""
    turn = (to_bearing_deg - from_bearing_deg - 180.0) % 360.0
    return turn - 360.0 if turn > 180.0 else turn


def turn_of(from_bearing_deg: float, to_bearing_deg: float) -> str:
    """Return ``r``, ``s`` or ``l``; straight means a deflection below 45 degrees."""
    deflection = deflection_deg(from_bearing_deg, to_bearing_deg)
    if abs(deflection) < STRAIGHT_WITHIN_DEG:
        return "s"
    return "r" if deflection > 0.0 else "l"


def exits_by_turn(legs: Sequence[Leg], name: str) -> dict[str, tuple[str, ...]]:
    """Return, per turn from leg ``name``, the legs that it leads to; turns without an exit are left out."""
    bearings = {leg.name: leg.bearing_deg for leg in legs}
    exits: dict[str, tuple[str, ...]] = {}
    for leg in legs:
        if leg.exit_lanes and leg.name != name:
            turn = turn_of(bearings[name], leg.bearing_deg)
            exits[turn] = (*exits.get(turn, ()), leg.name)
    return {turn: exits[turn] for turn in "rsl" if turn in exits}


def conflict(one: tuple[float, float], two: tuple[float, float]) -> bool:
    """Say whether two movements, each ``(from bearing, to bearing)`` in degrees, cross or merge."""
    if one[0] == two[0]:
        return False
    if one[1] == two[1]:
        return True
    start, end = (one[0] - _SIDE_DEG) % 360.0, (one[1] + _SIDE_DEG) % 360.0
    sides = [(point - start) % 360.0 < (end - start) % 360.0 for point in (two[0] - _SIDE_DEG, two[1] + _SIDE_DEG)]
    return sides[0] != sides[1]
