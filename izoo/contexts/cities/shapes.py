"""The kinds of intersections that a city is made of, and how an approach shares out its lanes among the turns."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import LEG_NAMES, Leg

SHARED_LEFT_CHANCE = {2: 0.7, 3: 0.3}
"""Share of approaches without a left phase whose lefts share the leftmost lane, by lane count (60 measured nets)."""


@dataclass(frozen=True)
class Shape:
    """A kind of intersection.

    Attributes:
        bearings: of its legs, degrees clockwise from north, in letter order.
        incoming, outgoing: positions of the legs with an incoming and with an outgoing side.
        axes: positions of incoming legs that the signal serves together.
        weight: how many of the 282 Salt Lake City intersections are of this kind.
    """

    bearings: tuple[float, ...]
    incoming: tuple[int, ...]
    outgoing: tuple[int, ...]
    axes: tuple[tuple[int, ...], ...]
    weight: int

    @functools.cached_property
    def relations(self) -> tuple[tuple[str, ...], ...]:
        """How the incoming approaches lie to each other, for :func:`izoo.contexts.cities.copula.latent_root`."""
        return tuple(
            tuple(
                "same"
                if one == two
                else "opposite"
                if abs(self.bearings[one] - self.bearings[two]) == 180
                else "adjacent"
                for two in self.incoming
            )
            for one in self.incoming
        )

    @functools.cached_property
    def turns(self) -> dict[int, dict[str, tuple[str, ...]]]:
        """Per incoming leg, the legs that each turn leads to."""
        legs = [
            Leg(name, bearing, None, 1, 100.0, 10.0) for name, bearing in zip(LEG_NAMES, self.bearings, strict=False)
        ]
        out = [leg for index, leg in enumerate(legs) if index in self.outgoing]
        return {
            index: exits_by_turn([legs[index], *(leg for leg in out if leg is not legs[index])], LEG_NAMES[index])
            for index in self.incoming
        }


_CROSS, _TEE = (0.0, 90.0, 180.0, 270.0), (0.0, 90.0, 180.0)
_STAR5, _STAR6 = (0.0, 90.0, 180.0, 230.0, 270.0), (0.0, 50.0, 90.0, 180.0, 230.0, 270.0)
SHAPES = (
    Shape(_CROSS, (0, 1, 2, 3), (0, 1, 2, 3), ((0, 2), (1, 3)), 197),
    Shape(_CROSS, (0, 1, 2), (0, 2, 3), ((0, 2), (1,)), 32),
    Shape(_CROSS, (0, 1), (2, 3), ((0,), (1,)), 2),
    Shape(_TEE, (0, 1, 2), (0, 1, 2), ((0, 2), (1,)), 42),
    Shape(_TEE, (0, 2), (0, 1, 2), ((0,), (2,)), 2),
    Shape(_STAR5, (0, 1, 2, 3, 4), (0, 1, 2, 3, 4), ((0, 2), (1, 4), (3,)), 3),
    Shape(_STAR5, (0, 1, 2, 4), (0, 1, 2, 3, 4), ((0, 2), (1, 4)), 2),
    Shape(_STAR5, (0, 1, 2), (0, 2, 3, 4), ((0, 2), (1,)), 1),
    Shape(_STAR6, (0, 1, 3, 4), (0, 1, 2, 3, 4, 5), ((0, 3), (1, 4)), 1),
)
"""Kinds of intersections. Their weights reproduce both published counts, of legs (3: 44, 4: 231, 5: 6, 6: 1) and of
incoming approaches (2: 4, 3: 75, 4: 200, 5: 3). A leg that is incoming only and one that is outgoing only are the two
ends of a one-way street."""


def share_out_lanes(turns: Sequence[str], count: int, left_phase: bool, chance: float) -> tuple[str, ...]:
    """Share out turns over lanes, right to left, as the measured nets do."""
    turns = list(turns)
    if count == 1:
        return ("rs",) if {"r", "s"} <= set(turns) else ("".join(turns),)
    if len(turns) == 1:
        return (turns[0],) * count
    if "s" not in turns:
        return ("r", *["l"] * (count - 1)) if left_phase else ("rl", *["l"] * (count - 1))
    lefts = 0 if "l" not in turns else 2 if count >= 5 else 1
    shared = lefts == 1 and not left_phase and chance < SHARED_LEFT_CHANCE.get(count, 0.0)
    lanes = ["s"] * (count - lefts) + ["l"] * lefts
    if shared:
        lanes[-1] = "sl"
    if "r" in turns:
        lanes[0] = "r" if count >= 5 else "r" + lanes[0]
    return tuple(lanes)
