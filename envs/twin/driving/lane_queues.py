"""The vehicles of each lane in order, and the lanes that their tails are still on."""

from __future__ import annotations

from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    AHEAD,
    BEHIND,
    LANE,
    LANE_BACK,
    LANE_COUNT,
    LANE_FRONT,
    LANE_LENGTH,
    LANE_TAILS,
    LENGTH,
    LOST_TAILS,
    MAX_TAIL_LANES,
    POSITION,
    TAIL_LANES,
)


@compiled
def insert_into_lane(state, v, lane):  # type: ignore[no-untyped-def]
    """Insert vehicle ``v`` into the queue of ``lane`` by its position, behind others at the same position."""
    ints, lanes = state.ints, state.lanes
    position = state.floats[v, POSITION]
    # From upstream, because a vehicle that comes to a lane is mostly its last.
    ahead, behind = lanes[lane, LANE_BACK], -1
    while ahead >= 0 and state.floats[ahead, POSITION] < position:
        behind = ahead
        ahead = ints[ahead, AHEAD]
    ints[v, LANE] = lane
    ints[v, AHEAD], ints[v, BEHIND] = ahead, behind
    if ahead >= 0:
        ints[ahead, BEHIND] = v
    else:
        lanes[lane, LANE_FRONT] = v
    if behind >= 0:
        ints[behind, AHEAD] = v
    else:
        lanes[lane, LANE_BACK] = v
    lanes[lane, LANE_COUNT] += 1


@compiled
def remove_from_lane(state, v):  # type: ignore[no-untyped-def]
    """Remove vehicle ``v`` from the queue of its lane."""
    ints, lanes = state.ints, state.lanes
    lane, ahead, behind = ints[v, LANE], ints[v, AHEAD], ints[v, BEHIND]
    if ahead >= 0:
        ints[ahead, BEHIND] = behind
    else:
        lanes[lane, LANE_FRONT] = behind
    if behind >= 0:
        ints[behind, AHEAD] = ahead
    else:
        lanes[lane, LANE_BACK] = ahead
    lanes[lane, LANE_COUNT] -= 1
    ints[v, AHEAD] = ints[v, BEHIND] = -1


@compiled
def clear_tail(state, v):  # type: ignore[no-untyped-def]
    """Remove the tail of vehicle ``v`` from all lanes."""
    for k in range(state.ints[v, TAIL_LANES]):
        lane = state.tail_lane[v, k]
        count = state.lanes[lane, LANE_TAILS]
        for j in range(count):
            if state.tails[lane, j] == v:
                state.tails[lane, j] = state.tails[lane, count - 1]
                state.lanes[lane, LANE_TAILS] = count - 1
                break
    state.ints[v, TAIL_LANES] = 0


@compiled
def set_tail(net, traffic, state, v, count):  # type: ignore[no-untyped-def]
    """Put the tail of vehicle ``v`` on as many of the first ``count`` lanes in its ``tail_lane`` as it reaches.

    If the tables have no room for it, that is counted: see
    :func:`izoo.envs.twin.runtime.episode_setup.TwinRun.finish`.
    """
    rest = traffic.floats[v, LENGTH] - state.floats[v, POSITION]
    kept = 0
    while kept < count and rest > 0.0:
        lane = state.tail_lane[v, kept]
        tails = state.lanes[lane, LANE_TAILS]
        if tails == MAX_TAIL_LANES:
            break
        state.tails[lane, tails] = v
        state.lanes[lane, LANE_TAILS] = tails + 1
        rest -= net.lane_floats[lane, LANE_LENGTH]
        kept += 1
    if rest > 0.0 and (kept < count or kept == MAX_TAIL_LANES):
        state.clock[LOST_TAILS] += 1
    state.ints[v, TAIL_LANES] = kept


@compiled
def rear_position(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the position (m) of the rear bumper of vehicle ``v`` on ``lane``, its own or one that its tail is on."""
    back = state.floats[v, POSITION] - traffic.floats[v, LENGTH]
    if state.ints[v, LANE] == lane:
        return back
    for k in range(state.ints[v, TAIL_LANES]):
        behind = state.tail_lane[v, k]
        back += net.lane_floats[behind, LANE_LENGTH]
        if behind == lane:
            break
    return back


@compiled
def last_vehicle(net, traffic, state, lane, but):  # type: ignore[no-untyped-def]
    """Return the vehicle furthest upstream on ``lane``, else one whose tail is on it; -1 where there is none.

    Args:
        but: a vehicle to leave out.
    """
    last = state.lanes[lane, LANE_BACK]
    if last == but and last >= 0:
        last = state.ints[last, AHEAD]
    if last >= 0:
        return last
    return last_tail(net, traffic, state, lane, but)


@compiled
def last_tail(net, traffic, state, lane, but):  # type: ignore[no-untyped-def]
    """Return the vehicle whose tail is on ``lane`` and reaches furthest back; -1 where there is none."""
    found, nearest = -1, 0.0
    for j in range(state.lanes[lane, LANE_TAILS]):
        v = state.tails[lane, j]
        if v == but:
            continue
        front = rear_position(net, traffic, state, v, lane) + traffic.floats[v, LENGTH]
        if found < 0 or front < nearest:
            found, nearest = v, front
    return found
