"""Lane changes of a step: per edge, vehicle by vehicle from downstream, each seeing the changes made before it."""

from __future__ import annotations

from izoo.envs.twin.driving.active_lanes import activate
from izoo.envs.twin.driving.car_following import secure_gap
from izoo.envs.twin.driving.lane_queues import clear_tail, insert_into_lane, remove_from_lane, set_tail
from izoo.envs.twin.lane_change.cooperation import clear_advice, clear_memories
from izoo.envs.twin.lane_change.decision import apply_request, decide_lane_change
from izoo.envs.twin.lane_change.downstream_occupancy import remember_downstream_occupancy
from izoo.envs.twin.lane_change.flags import (
    BLOCKED,
    LEFT_FOLLOWER_BLOCKS,
    LEFT_LEADER_BLOCKS,
    LEFTWARD,
    OVERLAPS,
    RIGHT_FOLLOWER_BLOCKS,
    RIGHT_LEADER_BLOCKS,
    RIGHTWARD,
    URGENT,
)
from izoo.envs.twin.lane_change.neighbours import Neighbours, follower_on_lane, leader_beyond, leader_on_lane
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACTIVE_FIRST,
    ACTIVE_NEXT,
    ACTIVE_SERVED,
    ADVICES,
    BEHIND,
    CHANGE_COMMAND,
    CHANGE_STATE,
    CHANGE_TARGET,
    CHANGE_UNTIL_MS,
    CHANGER_FIRST_BLOCKED,
    CHANGER_LAST_BLOCKED,
    CHANGER_NEXT,
    EDGE_CHANGES,
    EDGE_FIRST_LANE,
    EDGE_LANES,
    LANE,
    LANE_COUNT,
    LANE_EDGE,
    LANE_FRONT,
    LANE_INDEX,
    LANE_LEFT,
    LANE_RIGHT,
    LENGTH,
    LINK_FROM,
    MAX_TAIL_LANES,
    MIN_GAP,
    NOW_MS,
    POSITION,
    SPEED,
    STEP_COUNT,
    TAIL_LANES,
)


@compiled
def read_lane_command(net, state, v, step_ms):  # type: ignore[no-untyped-def]
    """Turn the commanded change of this step into a target lane, as ``vehicle.changeLaneRelative`` does."""
    change = state.ints[v, CHANGE_COMMAND]
    if change == 0:
        return
    state.ints[v, CHANGE_COMMAND] = 0
    target = net.lane_ints[state.ints[v, LANE], LANE_INDEX] + change
    if target >= 0:
        state.ints[v, CHANGE_TARGET] = target
        state.ints[v, CHANGE_UNTIL_MS] = state.clock[NOW_MS] + step_ms


@compiled
def change_lanes(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Change lanes on every edge with several lanes, after all vehicles have moved."""
    _measure_room(traffic, state)
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        edge = net.lane_ints[lane, LANE_EDGE]
        if net.edge_ints[edge, EDGE_LANES] == 1:
            break
        first = net.edge_ints[edge, EDGE_FIRST_LANE]
        if net.edge_ints[edge, EDGE_CHANGES] and state.active[first, ACTIVE_SERVED] != state.clock[STEP_COUNT]:
            state.active[first, ACTIVE_SERVED] = state.clock[STEP_COUNT]
            change_on_edge(net, traffic, state, edge, step_ms / 1000.0)
        lane = state.active[lane, ACTIVE_NEXT]
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0 and net.edge_ints[net.lane_ints[lane, LANE_EDGE], EDGE_LANES] > 1:
        after = state.active[lane, ACTIVE_NEXT]
        if net.lane_ints[lane, LANE_LEFT] >= 0 and state.lanes[lane + 1, LANE_COUNT] > 0:
            activate(net, state, lane + 1)
        if net.lane_ints[lane, LANE_RIGHT] >= 0 and state.lanes[lane - 1, LANE_COUNT] > 0:
            activate(net, state, lane - 1)
        lane = after


@compiled
def _measure_room(traffic, state):  # type: ignore[no-untyped-def]
    """Compute the occupancy of each lane: the vehicles' lengths and standstill gaps."""
    for lane in range(state.lane_room.shape[0]):
        state.lane_room[lane] = 0.0
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        v = state.lanes[lane, LANE_FRONT]
        while v >= 0:
            state.lane_room[lane] += traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
            v = state.ints[v, BEHIND]
        lane = state.active[lane, ACTIVE_NEXT]


@compiled
def change_on_edge(net, traffic, state, edge, step_s):  # type: ignore[no-untyped-def]
    """Change lanes on one edge."""
    first = net.edge_ints[edge, EDGE_FIRST_LANE]
    end = first + net.edge_ints[edge, EDGE_LANES]
    total = 0
    for lane in range(first, end):
        total += state.lanes[lane, LANE_COUNT]
        state.changer[lane, CHANGER_NEXT] = state.lanes[lane, LANE_FRONT]
        state.changer[lane, CHANGER_FIRST_BLOCKED] = state.changer[lane, CHANGER_LAST_BLOCKED] = -1
        state.changer_density[lane] = 0.0
    for _ in range(total):
        lane = -1
        for k in range(first, end):
            v = state.changer[k, CHANGER_NEXT]
            if v >= 0 and (
                lane < 0 or state.floats[v, POSITION] > state.floats[state.changer[lane, CHANGER_NEXT], POSITION]
            ):
                lane = k
        v = state.changer[lane, CHANGER_NEXT]
        state.changer[lane, CHANGER_NEXT] = state.ints[v, BEHIND]
        now_on = _consider_change(net, traffic, state, v, lane, step_s)
        state.changer_density[now_on] += traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]


@compiled
def _consider_change(net, traffic, state, v, lane, step_s):  # type: ignore[no-untyped-def]
    """Consider a change to the right, then to the left; execute it if it is wanted and not blocked; return the lane."""
    leader, gap = leader_on_lane(net, traffic, state, v, lane, step_s)
    rightward = leftward = 0
    if net.lane_ints[lane, LANE_RIGHT] >= 0:
        rightward = _evaluate_change(net, traffic, state, v, lane - 1, leader, gap, step_s)
        if rightward & RIGHTWARD and not rightward & BLOCKED:
            _execute_change(net, traffic, state, v, lane - 1)
            return lane - 1
        if rightward & RIGHTWARD and rightward & URGENT:
            _record_blocked(state, v, lane - 1)
    if net.lane_ints[lane, LANE_LEFT] >= 0:
        advices = state.ints[v, ADVICES]
        leftward = _evaluate_change(net, traffic, state, v, lane + 1, leader, gap, step_s)
        if leftward & LEFTWARD and not leftward & BLOCKED:
            _execute_change(net, traffic, state, v, lane + 1)
            return lane + 1
        if leftward & LEFTWARD and leftward & URGENT:
            _record_blocked(state, v, lane + 1)
        if rightward & RIGHTWARD:
            # With a wish to the right, the speeds advised for the left are dropped.
            state.ints[v, ADVICES] = advices
    state.ints[v, CHANGE_STATE] = rightward | leftward
    return lane


@compiled
def _record_blocked(state, v, lane):  # type: ignore[no-untyped-def]
    """Make the blocked ``v`` known to vehicles behind it on the lane that it must change to."""
    state.changer[lane, CHANGER_LAST_BLOCKED] = v
    if state.changer[lane, CHANGER_FIRST_BLOCKED] < 0:
        state.changer[lane, CHANGER_FIRST_BLOCKED] = v


@compiled
def _evaluate_change(net, traffic, state, v, lane, leader, gap, step_s):  # type: ignore[no-untyped-def]
    """Return the state bits for a change to the target ``lane``: what blocks it, and whether it is wanted."""
    right = lane < state.ints[v, LANE]
    by_leader = RIGHT_LEADER_BLOCKS if right else LEFT_LEADER_BLOCKS
    by_follower = RIGHT_FOLLOWER_BLOCKS if right else LEFT_FOLLOWER_BLOCKS
    target_leader, target_gap = leader_on_lane(net, traffic, state, v, lane, step_s)
    follower, follower_gap = follower_on_lane(net, traffic, state, v, lane)
    speed, blocked = state.floats[v, SPEED], 0
    if follower >= 0:
        if follower_gap < 0.0:
            blocked |= by_follower | OVERLAPS
        elif follower_gap < secure_gap(traffic.floats[follower], state.floats[follower, SPEED], speed):
            blocked |= by_follower
    if target_leader >= 0:
        if target_gap < 0.0:
            blocked |= by_leader | OVERLAPS
        elif target_gap < secure_gap(traffic.floats[v], speed, state.floats[target_leader, SPEED]):
            blocked |= by_leader
    around = Neighbours(leader, gap, target_leader, target_gap, follower, follower_gap)
    wish = decide_lane_change(net, traffic, state, v, -1 if right else 1, around, blocked, step_s)
    flags = blocked | wish
    if not blocked and flags & (RIGHTWARD | LEFTWARD):
        # Before it changes, it also checks for a vehicle beyond the leader that restricts it more.
        other, other_gap = leader_beyond(net, traffic, state, v, lane, False, step_s)
        is_beyond = other >= 0 and other != target_leader
        if is_beyond and other_gap < secure_gap(traffic.floats[v], speed, state.floats[other, SPEED]):
            flags |= by_leader
    return apply_request(net, state, v, flags)


@compiled
def _execute_change(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Move ``v`` with its tail to the neighbouring ``lane``, and clear its memories."""
    ints = state.ints
    room = traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
    state.lane_room[ints[v, LANE]] -= room
    state.lane_room[lane] += room
    tails = ints[v, TAIL_LANES]
    clear_tail(state, v)
    remove_from_lane(state, v)
    insert_into_lane(state, v, lane)
    remember_downstream_occupancy(net, state, state.lane_room, v, lane)
    if tails > 0:
        _set_tail_after_change(net, traffic, state, v, lane, tails)
    clear_advice(state, v)
    clear_memories(state, v)


@compiled
def _set_tail_after_change(net, traffic, state, v, lane, count):  # type: ignore[no-untyped-def]
    """Put the tail on the lanes that lead to the new one, on the edges that it was on."""
    known, before = 0, lane
    for k in range(min(count, MAX_TAIL_LANES)):
        edge = net.lane_ints[state.tail_lane[v, k], LANE_EDGE]
        found = -1
        for j in range(net.incoming_start[before], net.incoming_start[before + 1]):
            candidate = net.link_ints[net.incoming_links[j], LINK_FROM]
            if net.lane_ints[candidate, LANE_EDGE] == edge:
                found = candidate
                break
        if found < 0:
            # No link leads from there to the new lane: the tail stays where it was.
            found = state.tail_lane[v, k]
        state.tail_lane[v, known] = before = found
        known += 1
    set_tail(net, traffic, state, v, known)
