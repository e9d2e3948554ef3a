"""The active lanes, those with vehicles, in the order in which SUMO processes them.

Lanes of edges with several lanes come first, the last activated one before the others; then the single lanes in the
order of their activation. Lanes are changed in this order: a vehicle that looks past the end of its edge sees the
changes made on edges before it in this order, but not those after it.
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
    """Add ``lane`` to the active lanes, unless it is there."""
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
def deactivate_empty(state):  # type: ignore[no-untyped-def]
    """Remove the lanes without vehicles."""
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
def activate_occupied(net, state):  # type: ignore[no-untyped-def]
    """Add the lanes that vehicles have come to since, in the order of their rows."""
    for lane in range(state.lanes.shape[0]):
        if state.lanes[lane, LANE_COUNT] > 0:
            activate(net, state, lane)
