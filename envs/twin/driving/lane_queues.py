"""The vehicles of each lane in order, and the lanes that their tails are still on."""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.runtime.layout import MAX_TAIL_LANES


@compiled
def insert_into_lane(state, v, lane):  # type: ignore[no-untyped-def]
    """Insert vehicle ``v`` into the queue of ``lane`` by its position, behind others at the same position."""
    vehicles, lanes = state.vehicles, state.lanes
    position = vehicles[v].position
    # From upstream, because a vehicle that comes to a lane is mostly its last.
    ahead, behind = lanes[lane].back, -1
    while ahead >= 0 and vehicles[ahead].position < position:
        behind = ahead
        ahead = vehicles[ahead].ahead
    vehicles[v].lane = lane
    vehicles[v].ahead, vehicles[v].behind = ahead, behind
    if ahead >= 0:
        vehicles[ahead].behind = v
    else:
        lanes[lane].front = v
    if behind >= 0:
        vehicles[behind].ahead = v
    else:
        lanes[lane].back = v
    lanes[lane].count += 1


@compiled
def remove_from_lane(state, v):  # type: ignore[no-untyped-def]
    """Remove vehicle ``v`` from the queue of its lane."""
    vehicles, lanes = state.vehicles, state.lanes
    lane, ahead, behind = vehicles[v].lane, vehicles[v].ahead, vehicles[v].behind
    if ahead >= 0:
        vehicles[ahead].behind = behind
    else:
        lanes[lane].front = behind
    if behind >= 0:
        vehicles[behind].ahead = ahead
    else:
        lanes[lane].back = ahead
    lanes[lane].count -= 1
    vehicles[v].ahead = vehicles[v].behind = -1


@compiled
def clear_tail(state, v):  # type: ignore[no-untyped-def]
    """Remove the tail of vehicle ``v`` from all lanes."""
    for k in range(state.vehicles[v].tail_lanes):
        lane = state.tail_lane[v, k]
        count = state.lanes[lane].tails
        for j in range(count):
            if state.tails[lane, j] == v:
                state.tails[lane, j] = state.tails[lane, count - 1]
                state.lanes[lane].tails = count - 1
                break
    state.vehicles[v].tail_lanes = 0


@compiled
def set_tail(net, traffic, state, v, count):  # type: ignore[no-untyped-def]
    """Put the tail of vehicle ``v`` on as many of the first ``count`` lanes in its ``tail_lane`` as it reaches.

    If the tables have no room for it, that is counted: see
    :func:`izoo.envs.twin.runtime.episode_setup.TwinRun.end_step`.
    """
    rest = traffic.drivers[v].length - state.vehicles[v].position
    kept = 0
    while kept < count and rest > 0.0:
        lane = state.tail_lane[v, kept]
        tails = state.lanes[lane].tails
        if tails == MAX_TAIL_LANES:
            break
        state.tails[lane, tails] = v
        state.lanes[lane].tails = tails + 1
        rest -= net.lanes[lane].length
        kept += 1
    if rest > 0.0 and (kept < count or kept == MAX_TAIL_LANES):
        state.clock.lost_tails += 1
    state.vehicles[v].tail_lanes = kept


@compiled
def rear_position(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the position (m) of the rear bumper of vehicle ``v`` on ``lane``, its own or one that its tail is on."""
    back = state.vehicles[v].position - traffic.drivers[v].length
    if state.vehicles[v].lane == lane:
        return back
    for k in range(state.vehicles[v].tail_lanes):
        behind = state.tail_lane[v, k]
        back += net.lanes[behind].length
        if behind == lane:
            break
    return back


@compiled
def last_vehicle(net, traffic, state, lane, but):  # type: ignore[no-untyped-def]
    """Return the vehicle furthest upstream on ``lane``, else one whose tail is on it; -1 where there is none.

    Args:
        but: a vehicle to leave out.
    """
    last = state.lanes[lane].back
    if last == but and last >= 0:
        last = state.vehicles[last].ahead
    if last >= 0:
        return last
    return last_tail(net, traffic, state, lane, but)


@compiled
def last_tail(net, traffic, state, lane, but):  # type: ignore[no-untyped-def]
    """Return the vehicle whose tail is on ``lane`` and reaches furthest back; -1 where there is none."""
    found, nearest = -1, 0.0
    for j in range(state.lanes[lane].tails):
        v = state.tails[lane, j]
        if v == but:
            continue
        front = rear_position(net, traffic, state, v, lane) + traffic.drivers[v].length
        if found < 0 or front < nearest:
            found, nearest = v, front
    return found
