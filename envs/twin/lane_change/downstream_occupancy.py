"""How much of the lanes downstream is occupied, for the decision to change lanes."""

from __future__ import annotations

from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    EDGE_FIRST_LANE,
    EDGE_LANES,
    LANE_EDGE,
    LANE_INDEX,
    LANE_INSIDE,
    MAX_LANES_SEEN,
    VARIANT,
)


@compiled
def remember_downstream_occupancy(net, state, lane_room, v, lane):  # type: ignore[no-untyped-def]
    """Store the downstream occupancy for ``v``, which comes to ``lane``, if that is inside a junction.

    It is not updated before the vehicle comes to another lane.

    Args:
        lane_room: ``[L]`` occupancy of each lane, m.
    """
    edge = net.lane_ints[lane, LANE_EDGE]
    lanes = net.edge_ints[edge, EDGE_LANES]
    if lanes == 1 or net.lane_ints[lane, LANE_INSIDE] == 0:
        return
    first = net.edge_ints[edge, EDGE_FIRST_LANE]
    for k in range(min(lanes, MAX_LANES_SEEN)):
        state.room_seen[v, k] = _occupancy_now(net, lane_room, state.ints[v, VARIANT], first + k)


@compiled
def downstream_occupancy(net, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the occupancy (m) of the lanes beyond ``lane`` along the route of ``v``, junctions left out.

    For a vehicle inside a junction it is that of when the vehicle came to its lane.
    """
    index = net.lane_ints[lane, LANE_INDEX]
    if net.lane_ints[lane, LANE_INSIDE] and index < MAX_LANES_SEEN:
        return state.room_seen[v, index]
    return _occupancy_now(net, state.lane_room, state.ints[v, VARIANT], lane)


@compiled
def _occupancy_now(net, lane_room, variant, lane):  # type: ignore[no-untyped-def]
    taken = 0.0
    lane = net.best_road[variant, lane]
    while lane >= 0:
        taken += lane_room[lane]
        lane = net.best_road[variant, lane]
    return taken
