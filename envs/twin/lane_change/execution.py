"""Lane changes of a step: per edge, vehicle by vehicle from downstream, each seeing the changes made before it."""

from __future__ import annotations

from izoo.envs.tables import compiled
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
from izoo.envs.twin.runtime.layout import MAX_TAIL_LANES


@compiled
def read_lane_command(net, state, v, step_ms):  # type: ignore[no-untyped-def]
    """Turn the commanded change of this step into a target lane, as ``vehicle.changeLaneRelative`` does."""
    change = state.vehicles[v].change_command
    if change == 0:
        return
    state.vehicles[v].change_command = 0
    target = net.lanes[state.vehicles[v].lane].index + change
    if target >= 0:
        state.vehicles[v].change_target = target
        state.vehicles[v].change_until_ms = state.clock.now_ms + step_ms


@compiled
def change_lanes(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Change lanes on every edge with several lanes, after all vehicles have moved."""
    _measure_room(traffic, state)
    lane = state.clock.first_active
    while lane >= 0:
        edge = net.lanes[lane].edge
        if net.edges[edge].lanes == 1:
            break
        first = net.edges[edge].first_lane
        if net.edges[edge].changes and state.active[first].served != state.clock.steps:
            state.active[first].served = state.clock.steps
            change_on_edge(net, traffic, state, edge, step_ms / 1000.0)
        lane = state.active[lane].next
    lane = state.clock.first_active
    while lane >= 0 and net.edges[net.lanes[lane].edge].lanes > 1:
        after = state.active[lane].next
        if net.lanes[lane].left >= 0 and state.lanes[lane + 1].count > 0:
            activate(net, state, lane + 1)
        if net.lanes[lane].right >= 0 and state.lanes[lane - 1].count > 0:
            activate(net, state, lane - 1)
        lane = after


@compiled
def _measure_room(traffic, state):  # type: ignore[no-untyped-def]
    """Compute the occupancy of each lane: the vehicles' lengths and standstill gaps."""
    for lane in range(state.lane_room.shape[0]):
        state.lane_room[lane] = 0.0
    lane = state.clock.first_active
    while lane >= 0:
        v = state.lanes[lane].front
        while v >= 0:
            state.lane_room[lane] += traffic.drivers[v].length + traffic.drivers[v].min_gap
            v = state.vehicles[v].behind
        lane = state.active[lane].next


@compiled
def change_on_edge(net, traffic, state, edge, step_s):  # type: ignore[no-untyped-def]
    """Change lanes on one edge."""
    first = net.edges[edge].first_lane
    end = first + net.edges[edge].lanes
    total = 0
    for lane in range(first, end):
        total += state.lanes[lane].count
        state.changer[lane].next = state.lanes[lane].front
        state.changer[lane].first_blocked = state.changer[lane].last_blocked = -1
        state.changer_density[lane] = 0.0
    for _ in range(total):
        lane = -1
        for k in range(first, end):
            v = state.changer[k].next
            if v >= 0 and (lane < 0 or state.vehicles[v].position > state.vehicles[state.changer[lane].next].position):
                lane = k
        v = state.changer[lane].next
        state.changer[lane].next = state.vehicles[v].behind
        now_on = _consider_change(net, traffic, state, v, lane, step_s)
        state.changer_density[now_on] += traffic.drivers[v].length + traffic.drivers[v].min_gap


@compiled
def _consider_change(net, traffic, state, v, lane, step_s):  # type: ignore[no-untyped-def]
    """Consider a change to the right, then to the left; execute it if it is wanted and not blocked; return the lane."""
    leader, gap = leader_on_lane(net, traffic, state, v, lane, step_s)
    rightward = leftward = 0
    if net.lanes[lane].right >= 0:
        rightward = _evaluate_change(net, traffic, state, v, lane - 1, leader, gap, step_s)
        if rightward & RIGHTWARD and not rightward & BLOCKED:
            _execute_change(net, traffic, state, v, lane - 1)
            return lane - 1
        if rightward & RIGHTWARD and rightward & URGENT:
            _record_blocked(state, v, lane - 1)
    if net.lanes[lane].left >= 0:
        advices = state.vehicles[v].advices
        leftward = _evaluate_change(net, traffic, state, v, lane + 1, leader, gap, step_s)
        if leftward & LEFTWARD and not leftward & BLOCKED:
            _execute_change(net, traffic, state, v, lane + 1)
            return lane + 1
        if leftward & LEFTWARD and leftward & URGENT:
            _record_blocked(state, v, lane + 1)
        if rightward & RIGHTWARD:
            # With a wish to the right, the speeds advised for the left are dropped.
            state.vehicles[v].advices = advices
    state.vehicles[v].change_state = rightward | leftward
    return lane


@compiled
def _record_blocked(state, v, lane):  # type: ignore[no-untyped-def]
    """Make the blocked ``v`` known to vehicles behind it on the lane that it must change to."""
    state.changer[lane].last_blocked = v
    if state.changer[lane].first_blocked < 0:
        state.changer[lane].first_blocked = v


@compiled
def _evaluate_change(net, traffic, state, v, lane, leader, gap, step_s):  # type: ignore[no-untyped-def]
    """Return the state bits for a change to the target ``lane``: what blocks it, and whether it is wanted."""
    right = lane < state.vehicles[v].lane
    by_leader = RIGHT_LEADER_BLOCKS if right else LEFT_LEADER_BLOCKS
    by_follower = RIGHT_FOLLOWER_BLOCKS if right else LEFT_FOLLOWER_BLOCKS
    target_leader, target_gap = leader_on_lane(net, traffic, state, v, lane, step_s)
    follower, follower_gap = follower_on_lane(net, traffic, state, v, lane)
    speed, blocked = state.vehicles[v].speed, 0
    if follower >= 0:
        if follower_gap < 0.0:
            blocked |= by_follower | OVERLAPS
        elif follower_gap < secure_gap(traffic.drivers[follower], state.vehicles[follower].speed, speed):
            blocked |= by_follower
    if target_leader >= 0:
        if target_gap < 0.0:
            blocked |= by_leader | OVERLAPS
        elif target_gap < secure_gap(traffic.drivers[v], speed, state.vehicles[target_leader].speed):
            blocked |= by_leader
    around = Neighbours(leader, gap, target_leader, target_gap, follower, follower_gap)
    wish = decide_lane_change(net, traffic, state, v, -1 if right else 1, around, blocked, step_s)
    flags = blocked | wish
    if not blocked and flags & (RIGHTWARD | LEFTWARD):
        # Before it changes, it also checks for a vehicle beyond the leader that restricts it more.
        other, other_gap = leader_beyond(net, traffic, state, v, lane, False, step_s)
        is_beyond = other >= 0 and other != target_leader
        if is_beyond and other_gap < secure_gap(traffic.drivers[v], speed, state.vehicles[other].speed):
            flags |= by_leader
    return apply_request(net, state, v, flags)


@compiled
def _execute_change(net, traffic, state, v, lane):  # type: ignore[no-untyped-def]
    """Move ``v`` with its tail to the neighbouring ``lane``, and clear its memories."""
    vehicles = state.vehicles
    room = traffic.drivers[v].length + traffic.drivers[v].min_gap
    state.lane_room[vehicles[v].lane] -= room
    state.lane_room[lane] += room
    tails = vehicles[v].tail_lanes
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
        edge = net.lanes[state.tail_lane[v, k]].edge
        found = -1
        for j in range(net.incoming_start[before], net.incoming_start[before + 1]):
            candidate = net.links[net.incoming_links[j]].from_lane
            if net.lanes[candidate].edge == edge:
                found = candidate
                break
        if found < 0:
            # No link leads from there to the new lane: the tail stays where it was.
            found = state.tail_lane[v, k]
        state.tail_lane[v, known] = before = found
        known += 1
    set_tail(net, traffic, state, v, known)
