"""The active lanes, those with vehicles, in the order in which SUMO processes them.

Lanes of edges with several lanes come first, the last activated one before the others; then the single lanes in the
order of their activation. Lanes are changed in this order: a vehicle that looks past the end of its edge sees the
changes made on edges before it in this order, but not those after it.
"""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.runtime.layout import NOT_ACTIVE


@compiled
def activate(net, state, lane):  # type: ignore[no-untyped-def]
    """Add ``lane`` to the active lanes, unless it is there."""
    active, clock = state.active, state.clock
    if active[lane].next != NOT_ACTIVE:
        return
    if net.edges[net.lanes[lane].edge].lanes > 1:
        after = clock.first_active
        active[lane].previous, active[lane].next = -1, after
        clock.first_active = lane
        if after >= 0:
            active[after].previous = lane
        else:
            clock.last_active = lane
        return
    before = clock.last_active
    active[lane].previous, active[lane].next = before, -1
    clock.last_active = lane
    if before >= 0:
        active[before].next = lane
    else:
        clock.first_active = lane


@compiled
def deactivate_empty(state):  # type: ignore[no-untyped-def]
    """Remove the lanes without vehicles."""
    active, clock = state.active, state.clock
    lane = clock.first_active
    while lane >= 0:
        before, after = active[lane].previous, active[lane].next
        if state.lanes[lane].count == 0:
            if before >= 0:
                active[before].next = after
            else:
                clock.first_active = after
            if after >= 0:
                active[after].previous = before
            else:
                clock.last_active = before
            active[lane].next = NOT_ACTIVE
        lane = after


@compiled
def activate_occupied(net, state):  # type: ignore[no-untyped-def]
    """Add the lanes that vehicles have come to since, in the order of their rows."""
    for lane in range(state.lanes.shape[0]):
        if state.lanes[lane].count > 0:
            activate(net, state, lane)
