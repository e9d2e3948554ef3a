"""The lanes with vehicles, in the order in which SUMO serves them.

Lanes with neighbours come first, those that became busy last before the others; then the lanes without neighbours, in
the order in which they became busy. Lane changing goes along this order: a driver who looks across the end of his edge
sees the changes that were made on edges before it, and not yet those behind it.
"""

from __future__ import annotations

from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACTIVE_FIRST,
    ACTIVE_LAST,
    ACTIVE_NEXT,
    ACTIVE_PREVIOUS,
    EDGE_LANES,
    LANE_COUNT,
    LANE_EDGE,
    NOT_ACTIVE,
)


@compiled
def activate(net, state, lane):  # type: ignore[no-untyped-def]
    """Enter ``lane`` into the order, unless it is there."""
    active, clock = state.active, state.clock
    if active[lane, ACTIVE_NEXT] != NOT_ACTIVE:
        return
    if net.edge_ints[net.lane_ints[lane, LANE_EDGE], EDGE_LANES] > 1:
        after = clock[ACTIVE_FIRST]
        active[lane, ACTIVE_PREVIOUS], active[lane, ACTIVE_NEXT] = -1, after
        clock[ACTIVE_FIRST] = lane
        if after >= 0:
            active[after, ACTIVE_PREVIOUS] = lane
        else:
            clock[ACTIVE_LAST] = lane
        return
    before = clock[ACTIVE_LAST]
    active[lane, ACTIVE_PREVIOUS], active[lane, ACTIVE_NEXT] = before, -1
    clock[ACTIVE_LAST] = lane
    if before >= 0:
        active[before, ACTIVE_NEXT] = lane
    else:
        clock[ACTIVE_FIRST] = lane


@compiled
def forget_empty(state):  # type: ignore[no-untyped-def]
    """Take the lanes without vehicles out of the order."""
    active, clock = state.active, state.clock
    lane = clock[ACTIVE_FIRST]
    while lane >= 0:
        before, after = active[lane, ACTIVE_PREVIOUS], active[lane, ACTIVE_NEXT]
        if state.lanes[lane, LANE_COUNT] == 0:
            if before >= 0:
                active[before, ACTIVE_NEXT] = after
            else:
                clock[ACTIVE_FIRST] = after
            if after >= 0:
                active[after, ACTIVE_PREVIOUS] = before
            else:
                clock[ACTIVE_LAST] = before
            active[lane, ACTIVE_NEXT] = NOT_ACTIVE
        lane = after


@compiled
def activate_busy(net, state):  # type: ignore[no-untyped-def]
    """Enter the lanes that vehicles came onto since, in the order of their rows."""
    for lane in range(state.lanes.shape[0]):
        if state.lanes[lane, LANE_COUNT] > 0:
            activate(net, state, lane)
