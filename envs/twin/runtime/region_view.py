"""Who of the twin's vehicles is in the region, for the MDP."""

from __future__ import annotations

from typing import NamedTuple

from izoo.envs.twin.runtime.compiled import Float1, Int1, Long1, opener, tables_type


class Guests(NamedTuple):
    """Who of the twin's vehicles is in the region, and where, for the MDP.

    Attributes:
        row_of: ``[N]`` int64, row of each vehicle of the demand in the MDP's tables, -1 where it has none.
        entry_lanes: int32, rows of the twin's lanes on which vehicles are first seen in the region.
        lane, position, speed, signals: ``[C]``: what was last reported of the members: region lane, m, m/s, bits.
        begun_s: ``[1]`` float64, simulated time at the first frame.
    """

    row_of: Long1
    entry_lanes: Int1
    lane: Long1
    position: Float1
    speed: Float1
    signals: Long1
    begun_s: Float1


READING = ("lane", "position", "speed", "signals")
"""Arrays of :class:`Guests` that are written and read within a step; nothing in them lasts."""
GUESTS = tables_type(Guests)
open_guests = opener(GUESTS)
