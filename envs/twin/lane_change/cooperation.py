"""Cooperation: speeds advised for the next step to the vehicle that wants to change lanes and to its neighbours.

After the moves of a step, vehicles add advice for each other and for themselves; :func:`advised_speed` evaluates it
when the vehicle moves next, and :func:`clear_advice` clears it then.
"""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import (
    brake_gap,
    desired_speed,
    follow_speed,
    max_speed,
    min_speed,
    secure_gap,
    stop_speed,
)
from izoo.envs.twin.driving.tolerances import EPS, POSITION_EPS, STANDING_MPS
from izoo.envs.twin.lane_change.flags import (
    BLOCKED,
    BLOCKED_BY_FOLLOWER,
    BLOCKED_BY_LEADER,
    BLOCKS_BEHIND,
    BLOCKS_BEHIND_STANDING,
    BLOCKS_FOLLOWER,
    BLOCKS_LEADER,
    COOPERATIVE,
    STRATEGIC,
    WANTED_LEFTWARD,
    WANTED_RIGHTWARD,
    WANTS_CHANGE,
)
from izoo.envs.twin.runtime.layout import MAX_ADVICES

OVERTAKING_MPS = 10.0 / 3.6
"""Speed difference at which a follower that lets another vehicle in is passed, or passes it."""
_FALLING_BEHIND_MPS2 = 7.0 / 3.6
_DAWDLING_MPS2 = 1.0
_CONGESTED_MPS = 60.0 / 3.6
_RAMP_M = 200.0
"""A shorter road may be a ramp; the bound lies between 118 and 268 m."""
_PATIENCE_MS = 5000
"""A leader that has stood for longer may be passed."""


@compiled
def clear_advice(state, v):  # type: ignore[no-untyped-def]
    """Clear the advice for the move that ``v`` has made, before lanes are changed."""
    state.vehicles[v].advices = 0
    state.vehicles[v].change_state = 0
    state.vehicles[v].left_space = 0.0
    state.vehicles[v].blocker_length = 0.0


@compiled
def clear_memories(state, v):  # type: ignore[no-untyped-def]
    """Clear the lane-changing memories: after a change, and on a road of one lane."""
    vehicles = state.vehicles
    vehicles[v].blocker_length = 0.0
    vehicles[v].speed_gain = vehicles[v].speed_gain_right = vehicles[v].keep_right = vehicles[v].look_ahead_speed = 0.0


@compiled
def add_advice(state, v, speed):  # type: ignore[no-untyped-def]
    """Advise ``v`` to take ``speed`` (m/s) in the next step; with too many advices the highest is dropped."""
    count = state.vehicles[v].advices
    if count < MAX_ADVICES:
        state.advice[v, count] = speed
        state.vehicles[v].advices = count + 1
        return
    highest = 0
    for k in range(1, MAX_ADVICES):
        if state.advice[v, k] > state.advice[v, highest]:
            highest = k
    state.advice[v, highest] = min(state.advice[v, highest], speed)


@compiled
def _advised_accel_mps2(state, v, k, step_s):  # type: ignore[no-untyped-def]
    """Return the acceleration (m/s^2) to the ``k``-th speed advised to ``v``.

    SUMO stores advice as accelerations. The conversion may change the last bit, which decides whether braking is too
    hard.
    """
    return (state.advice[v, k] - state.vehicles[v].speed) / step_s


@compiled
def advised_speed(net, traffic, state, v, low, desired, high, step_s):  # type: ignore[no-untyped-def]
    """Return the speed in ``[low, high]`` (m/s) for the coming step, ``desired`` without advice."""
    driver, speed = traffic.drivers[v], state.vehicles[v].speed
    best, advised = desired, False
    blocker = state.vehicles[v].blocker_length
    if blocker != 0.0:
        space = state.vehicles[v].left_space - blocker - POSITION_EPS
        if space > 0.0:
            # Leave room for the vehicle that must cross over.
            limit = desired_speed(net, state, v, state.vehicles[v].lane)
            safe = stop_speed(driver, space, speed, limit, driver.decel, step_s)
            high = min(high, safe)
            if safe < desired:
                best, advised = max(low, safe), True
    for k in range(state.vehicles[v].advices):
        advice = speed + _advised_accel_mps2(state, v, k, step_s) * step_s
        if low <= advice <= high:
            best, advised = min(best, advice), True
    if advised:
        return best
    flags = state.vehicles[v].change_state
    if flags & WANTS_CHANGE and flags & BLOCKED:
        if flags & STRATEGIC:
            return (high + desired) * 0.5
        if flags & COOPERATIVE:
            if flags & BLOCKED_BY_LEADER:
                return (low + desired) * 0.5
            if flags & BLOCKED_BY_FOLLOWER:
                return (high + desired) * 0.5
    if flags & BLOCKS_LEADER:
        return (high + desired) * 0.5
    if net.edges[net.lanes[state.vehicles[v].lane].edge].lanes == 1:
        clear_memories(state, v)
    return desired


@compiled
def is_congested(state, v):  # type: ignore[no-untyped-def]
    """Whether ``v`` is too slow for the rules on passing on the right."""
    return state.vehicles[v].speed < _CONGESTED_MPS


@compiled
def slow_for_blocked(net, traffic, state, v, blocked, flags, step_s):  # type: ignore[no-untyped-def]
    """Slow ``v`` down for a blocked vehicle ahead on the neighbouring lane that must change; return the state bits."""
    driver, speed = traffic.drivers[v], state.vehicles[v].speed
    gap = state.vehicles[blocked].position - traffic.drivers[blocked].length - state.vehicles[v].position
    gap -= driver.min_gap
    if gap <= POSITION_EPS or speed >= driver.decel:
        return flags
    other = state.vehicles[blocked].speed
    limit = desired_speed(net, state, v, state.vehicles[v].lane)
    add_advice(state, v, follow_speed(driver, gap - POSITION_EPS, speed, other, limit, step_s))
    return flags | (BLOCKS_BEHIND_STANDING if other < STANDING_MPS else BLOCKS_BEHIND)


@compiled
def reserve_room(traffic, state, v, blocker, counter, step_s):  # type: ignore[no-untyped-def]
    """Leave room at the lane's end for a ``blocker`` that wants to change the other way (state bit ``counter``)."""
    if blocker < 0 or not state.vehicles[blocker].change_state & counter:
        return
    vehicles = state.vehicles
    room = traffic.drivers[blocker].length + traffic.drivers[blocker].min_gap
    if _can_reserve(traffic, state, v, room, step_s):
        vehicles[v].blocker_length = max(room + traffic.drivers[v].min_gap, vehicles[v].blocker_length)
        return
    # There is no room for the blocker: the blocker leaves room.
    own = traffic.drivers[v].length + traffic.drivers[v].min_gap
    if _can_reserve(traffic, state, blocker, own, step_s) or vehicles[blocker].left_space > vehicles[v].left_space:
        vehicles[blocker].blocker_length = max(own + traffic.drivers[blocker].min_gap, vehicles[blocker].blocker_length)


@compiled
def _can_reserve(traffic, state, v, room, step_s):  # type: ignore[no-untyped-def]
    speed = state.vehicles[v].speed
    return room <= state.vehicles[v].left_space - brake_gap(speed, traffic.drivers[v].decel, 0.0, step_s)


@compiled
def inform_leader(net, traffic, state, v, around, blocked, leftward, remaining_s, step_s):  # type: ignore[no-untyped-def]
    """Fall back behind the leader on the target lane, or pass it; return the planned speed (m/s), -1 to pass."""
    leader, gap = around.target_leader, around.target_leader_gap
    driver, speed, vehicles = traffic.drivers[v], state.vehicles[v].speed, state.vehicles
    limit = desired_speed(net, state, v, state.vehicles[v].lane)
    left = vehicles[v].left_space - vehicles[v].blocker_length
    planned = min(speed, stop_speed(driver, left, speed, limit, driver.decel, step_s))
    for k in range(state.vehicles[v].advices):
        accel = _advised_accel_mps2(state, v, k, step_s)
        if accel >= -driver.decel:
            planned = min(planned, speed + accel * step_s)
    if leader < 0:
        return planned
    leader_mps = vehicles[leader].speed
    # The leader may go on braking, or begin to brake a little.
    pessimistic = leader_mps + min(vehicles[leader].accel, -_DAWDLING_MPS2) * step_s
    target = follow_speed(driver, gap + (pessimistic - planned) * step_s, speed, pessimistic, limit, step_s)
    if not blocked & BLOCKED_BY_LEADER:
        add_advice(state, v, target)
        return min(target, planned)
    faster = planned - leader_mps
    passing_m = gap + traffic.drivers[leader].length + traffic.drivers[leader].min_gap + driver.length
    passing_m += secure_gap(traffic.drivers[leader], leader_mps, speed)
    flag = WANTED_LEFTWARD if leftward else WANTED_RIGHTWARD
    state.vehicles[leader].change_state |= flag | BLOCKS_LEADER
    if speed == leader_mps == 0.0 and state.vehicles[leader].waiting_ms > _PATIENCE_MS and left >= passing_m:
        # A stopped vehicle passes a leader that has stood for long, if both fit before the lane's end.
        room = driver.length + driver.min_gap + traffic.drivers[leader].length + traffic.drivers[leader].min_gap
        if vehicles[v].left_space >= room:
            return -1.0
    if not (
        faster < EPS
        or (leftward and not is_congested(state, v))
        or left - brake_gap(speed, driver.decel, driver.tau, step_s) < passing_m
        or faster * remaining_s < passing_m
    ):
        if state.vehicles[leader].waiting_ms <= _PATIENCE_MS:
            add_advice(state, leader, leader_mps)
        return -1.0
    target = max(target, max(0.0, speed - driver.decel * step_s))
    if net.lanes[state.vehicles[v].lane].inside:
        # It does not stop inside a junction to fall behind.
        target = max(target, driver.max_accel * step_s)
    if target >= speed:
        add_advice(state, v, target)
        return planned
    decel = min(driver.decel, max(_FALLING_BEHIND_MPS2, (speed - target) / remaining_s))
    target = min(planned, max(0.0, speed - decel * step_s))
    add_advice(state, v, target)
    return target


@compiled
def inform_follower(net, traffic, state, v, around, blocked, leftward, remaining_s, planned, step_s):  # type: ignore[no-untyped-def]
    """Ask the follower on the target lane to let ``v`` in, or to pass it."""
    follower, gap = around.target_follower, around.target_follower_gap
    if follower < 0:
        return
    driver, speed = traffic.drivers[v], state.vehicles[v].speed
    helper, follower_mps = traffic.drivers[follower], state.vehicles[follower].speed
    limit = desired_speed(net, state, follower, state.vehicles[follower].lane)
    flags = WANTED_LEFTWARD if leftward else WANTED_RIGHTWARD
    if not blocked & BLOCKED_BY_FOLLOWER:
        if blocked & BLOCKED_BY_LEADER:
            state.vehicles[follower].change_state |= flags
            top = state.vehicles[follower].top_speed
            add_advice(state, follower, _speed_staying_behind(helper, gap, follower_mps, planned, limit, top, step_s))
        return
    state.vehicles[follower].change_state |= flags | BLOCKS_FOLLOWER
    # A follower that was asked for this difference in the last step has it up to rounding, which decides here.
    if planned - follower_mps >= OVERTAKING_MPS:
        needed = secure_gap(helper, follower_mps, planned)
        if (needed - gap) / remaining_s < planned - follower_mps:
            add_advice(state, follower, max(follower_mps, planned - OVERTAKING_MPS))
            return
    braked = max(0.0, follower_mps - helper.decel * step_s)
    braked_1s = max(0.0, follower_mps - helper.decel)
    faster = planned - braked_1s
    opened = gap + faster
    secure = secure_gap(helper, braked_1s, planned)
    if opened > 0.0 and opened >= secure:
        add_advice(state, follower, _speed_behind(helper, gap, follower_mps, planned, braked, limit, step_s))
    elif faster > 0.0 and faster * remaining_s > secure - opened + POSITION_EPS:
        add_advice(state, follower, braked)
    elif not leftward and not is_congested(state, follower):
        add_advice(state, follower, max(braked, OVERTAKING_MPS))
    else:
        # On a short road, which may be a ramp, followers on the left pass; elsewhere a faster follower brakes, so far
        # that later ones can help and that it still passes.
        short = leftward and net.lanes[state.vehicles[v].lane].length < _RAMP_M
        yields = follower_mps > speed and not short
        passing = max(braked if yields else follower_mps, speed + OVERTAKING_MPS)
        add_advice(state, follower, passing)
        if not yields or follower_mps - helper.decel * remaining_s > speed:
            # It passes slowly: the changing vehicle waits for it.
            way = gap + driver.length + driver.min_gap + helper.length + secure_gap(driver, planned, passing)
            add_advice(state, v, max(passing - way / remaining_s, speed - driver.decel * step_s))


@compiled
def _speed_staying_behind(helper, gap, speed, planned, limit, top, step_s):  # type: ignore[no-untyped-def]
    """Return the speed with which a follower does not become a blocker: it accelerates only if there is room.

    It keeps its speed if the gap is secure after the step, and otherwise brakes comfortably.
    """
    left = gap + (planned - max_speed(helper, speed, top, step_s)) * step_s
    faster = follow_speed(helper, left, speed, planned, limit, step_s)
    if faster >= speed:
        return faster
    left = gap + (planned - speed) * step_s
    if left >= secure_gap(helper, speed, planned):
        return speed
    return max(min_speed(helper, speed, step_s), follow_speed(helper, left, speed, planned, limit, step_s))


@compiled
def _speed_behind(helper, gap, speed, planned, least, limit, step_s):  # type: ignore[no-untyped-def]
    """Return the speed with which a follower leaves room for a vehicle that goes on with ``planned``."""
    first = max(least, max(0.0, follow_speed(helper, gap + planned * step_s, speed, planned, limit, step_s)))
    return max(least, follow_speed(helper, gap + (planned - first) * step_s, speed, planned, limit, step_s))
