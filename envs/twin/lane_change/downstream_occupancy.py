"""How full the roads are that a driver will come to, as far as changing lanes asks
(:mod:`~izoo.envs.twin.lane_change.decision`)."""

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
def look_behind_junction(net, state, lane_room, v, lane):  # type: ignore[no-untyped-def]
    """Let ``v``, which comes to ``lane`` inside a junction, remember how full the roads behind it are.

    On other lanes nothing happens. It does not look again before it comes to another lane.

    Args:
        lane_room: ``[L]`` how full each lane is, in m.
    """
    edge = net.lane_ints[lane, LANE_EDGE]
    lanes = net.edge_ints[edge, EDGE_LANES]
    if lanes == 1 or net.lane_ints[lane, LANE_INSIDE] == 0:
        return
    first = net.edge_ints[edge, EDGE_FIRST_LANE]
    for k in range(min(lanes, MAX_LANES_SEEN)):
        state.room_seen[v, k] = _room_taken_now(net, lane_room, state.ints[v, VARIANT], first + k)


@compiled
def room_taken(net, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the road (m) that vehicles take up on the lanes behind ``lane`` along the route of ``v``.

    Lanes inside junctions are left out. Who is inside of one goes by what was there when it came to its lane.
    """
    index = net.lane_ints[lane, LANE_INDEX]
    if net.lane_ints[lane, LANE_INSIDE] and index < MAX_LANES_SEEN:
        return state.room_seen[v, index]
    return _room_taken_now(net, state.lane_room, state.ints[v, VARIANT], lane)


@compiled
def _room_taken_now(net, lane_room, variant, lane):  # type: ignore[no-untyped-def]
    taken = 0.0
    lane = net.best_road[variant, lane]
    while lane >= 0:
        taken += lane_room[lane]
        lane = net.best_road[variant, lane]
    return taken
