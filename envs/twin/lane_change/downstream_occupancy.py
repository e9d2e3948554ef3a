"""How much of the lanes downstream is occupied, for the decision to change lanes."""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.runtime.layout import MAX_LANES_SEEN


@compiled
def remember_downstream_occupancy(net, state, lane_room, v, lane):  # type: ignore[no-untyped-def]
    """Store the downstream occupancy for ``v``, which comes to ``lane``, if that is inside a junction.

    It is not updated before the vehicle comes to another lane.

    Args:
        lane_room: ``[L]`` occupancy of each lane, m.
    """
    edge = net.lanes[lane].edge
    lanes = net.edges[edge].lanes
    if lanes == 1 or net.lanes[lane].inside == 0:
        return
    first = net.edges[edge].first_lane
    for k in range(min(lanes, MAX_LANES_SEEN)):
        state.room_seen[v, k] = _occupancy_now(net, lane_room, state.vehicles[v].variant, first + k)


@compiled
def downstream_occupancy(net, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the occupancy (m) of the lanes beyond ``lane`` along the route of ``v``, junctions left out.

    For a vehicle inside a junction it is that of when the vehicle came to its lane.
    """
    index = net.lanes[lane].index
    if net.lanes[lane].inside and index < MAX_LANES_SEEN:
        return state.room_seen[v, index]
    return _occupancy_now(net, state.lane_room, state.vehicles[v].variant, lane)


@compiled
def _occupancy_now(net, lane_room, variant, lane):  # type: ignore[no-untyped-def]
    taken = 0.0
    lane = net.best[variant, lane].road
    while lane >= 0:
        taken += lane_room[lane]
        lane = net.best[variant, lane].road
    return taken
