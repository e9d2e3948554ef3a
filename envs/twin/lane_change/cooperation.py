"""Cooperation: speeds advised for the next step to the vehicle that wants to change lanes and to its neighbours.

After the moves of a step, vehicles add advice for each other and for themselves; :func:`advised_speed` evaluates it
when the vehicle moves next, and :func:`clear_advice` clears it then.
"""

from __future__ import annotations

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
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACCEL,
    ADVICES,
    BLOCKER_LENGTH,
    CHANGE_STATE,
    DECEL,
    EDGE_LANES,
    KEEP_RIGHT,
    LANE,
    LANE_EDGE,
    LANE_INSIDE,
    LANE_LENGTH,
    LEFT_SPACE,
    LENGTH,
    LOOK_AHEAD_SPEED,
    MAX_ACCEL,
    MAX_ADVICES,
    MIN_GAP,
    POSITION,
    SPEED,
    SPEED_GAIN,
    SPEED_GAIN_RIGHT,
    TAU,
    TOP_SPEED,
    WAITING_MS,
)

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
    state.ints[v, ADVICES] = 0
    state.ints[v, CHANGE_STATE] = 0
    state.floats[v, LEFT_SPACE] = 0.0
    state.floats[v, BLOCKER_LENGTH] = 0.0


@compiled
def clear_memories(state, v):  # type: ignore[no-untyped-def]
    """Clear the lane-changing memories: after a change, and on a road of one lane."""
    floats = state.floats
    floats[v, BLOCKER_LENGTH] = 0.0
    floats[v, SPEED_GAIN] = floats[v, SPEED_GAIN_RIGHT] = floats[v, KEEP_RIGHT] = floats[v, LOOK_AHEAD_SPEED] = 0.0


@compiled
def add_advice(state, v, speed):  # type: ignore[no-untyped-def]
    """Advise ``v`` to take ``speed`` (m/s) in the next step; with too many advices the highest is dropped."""
    count = state.ints[v, ADVICES]
    if count < MAX_ADVICES:
        state.advice[v, count] = speed
        state.ints[v, ADVICES] = count + 1
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
    return (state.advice[v, k] - state.floats[v, SPEED]) / step_s


@compiled
def advised_speed(net, traffic, state, v, low, desired, high, step_s):  # type: ignore[no-untyped-def]
    """Return the speed in ``[low, high]`` (m/s) for the coming step, ``desired`` without advice."""
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    best, advised = desired, False
    blocker = state.floats[v, BLOCKER_LENGTH]
    if blocker != 0.0:
        space = state.floats[v, LEFT_SPACE] - blocker - POSITION_EPS
        if space > 0.0:
            # Leave room for the vehicle that must cross over.
            limit = desired_speed(net, state, v, state.ints[v, LANE])
            safe = stop_speed(driver, space, speed, limit, driver[DECEL], step_s)
            high = min(high, safe)
            if safe < desired:
                best, advised = max(low, safe), True
    for k in range(state.ints[v, ADVICES]):
        advice = speed + _advised_accel_mps2(state, v, k, step_s) * step_s
        if low <= advice <= high:
            best, advised = min(best, advice), True
    if advised:
        return best
    flags = state.ints[v, CHANGE_STATE]
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
    if net.edge_ints[net.lane_ints[state.ints[v, LANE], LANE_EDGE], EDGE_LANES] == 1:
        clear_memories(state, v)
    return desired


@compiled
def is_congested(state, v):  # type: ignore[no-untyped-def]
    """Whether ``v`` is too slow for the rules on passing on the right."""
    return state.floats[v, SPEED] < _CONGESTED_MPS


@compiled
def slow_for_blocked(net, traffic, state, v, blocked, flags, step_s):  # type: ignore[no-untyped-def]
    """Slow ``v`` down for a blocked vehicle ahead on the neighbouring lane that must change; return the state bits."""
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    gap = state.floats[blocked, POSITION] - traffic.floats[blocked, LENGTH] - state.floats[v, POSITION]
    gap -= driver[MIN_GAP]
    if gap <= POSITION_EPS or speed >= driver[DECEL]:
        return flags
    other = state.floats[blocked, SPEED]
    limit = desired_speed(net, state, v, state.ints[v, LANE])
    add_advice(state, v, follow_speed(driver, gap - POSITION_EPS, speed, other, limit, step_s))
    return flags | (BLOCKS_BEHIND_STANDING if other < STANDING_MPS else BLOCKS_BEHIND)


@compiled
def reserve_room(net, traffic, state, v, blocker, counter, step_s):  # type: ignore[no-untyped-def]
    """Leave room at the lane's end for a ``blocker`` that wants to change the other way (state bit ``counter``)."""
    if blocker < 0 or not state.ints[blocker, CHANGE_STATE] & counter:
        return
    floats = state.floats
    room = traffic.floats[blocker, LENGTH] + traffic.floats[blocker, MIN_GAP]
    if _can_reserve(traffic, state, v, room, step_s):
        floats[v, BLOCKER_LENGTH] = max(room + traffic.floats[v, MIN_GAP], floats[v, BLOCKER_LENGTH])
        return
    # There is no room for the blocker: the blocker leaves room.
    own = traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
    if _can_reserve(traffic, state, blocker, own, step_s) or floats[blocker, LEFT_SPACE] > floats[v, LEFT_SPACE]:
        floats[blocker, BLOCKER_LENGTH] = max(own + traffic.floats[blocker, MIN_GAP], floats[blocker, BLOCKER_LENGTH])


@compiled
def _can_reserve(traffic, state, v, room, step_s):  # type: ignore[no-untyped-def]
    speed = state.floats[v, SPEED]
    return room <= state.floats[v, LEFT_SPACE] - brake_gap(speed, traffic.floats[v, DECEL], 0.0, step_s)


@compiled
def inform_leader(net, traffic, state, v, around, blocked, leftward, remaining_s, step_s):  # type: ignore[no-untyped-def]
    """Fall back behind the leader on the target lane, or pass it; return the planned speed (m/s), -1 to pass."""
    leader, gap = around.target_leader, around.target_leader_gap
    driver, speed, floats = traffic.floats[v], state.floats[v, SPEED], state.floats
    limit = desired_speed(net, state, v, state.ints[v, LANE])
    left = floats[v, LEFT_SPACE] - floats[v, BLOCKER_LENGTH]
    planned = min(speed, stop_speed(driver, left, speed, limit, driver[DECEL], step_s))
    for k in range(state.ints[v, ADVICES]):
        accel = _advised_accel_mps2(state, v, k, step_s)
        if accel >= -driver[DECEL]:
            planned = min(planned, speed + accel * step_s)
    if leader < 0:
        return planned
    leader_mps = floats[leader, SPEED]
    # The leader may go on braking, or begin to brake a little.
    pessimistic = leader_mps + min(floats[leader, ACCEL], -_DAWDLING_MPS2) * step_s
    target = follow_speed(driver, gap + (pessimistic - planned) * step_s, speed, pessimistic, limit, step_s)
    if not blocked & BLOCKED_BY_LEADER:
        add_advice(state, v, target)
        return min(target, planned)
    faster = planned - leader_mps
    passing_m = gap + traffic.floats[leader, LENGTH] + traffic.floats[leader, MIN_GAP] + driver[LENGTH]
    passing_m += secure_gap(traffic.floats[leader], leader_mps, speed)
    flag = WANTED_LEFTWARD if leftward else WANTED_RIGHTWARD
    state.ints[leader, CHANGE_STATE] |= flag | BLOCKS_LEADER
    if speed == leader_mps == 0.0 and state.ints[leader, WAITING_MS] > _PATIENCE_MS and left >= passing_m:
        # A stopped vehicle passes a leader that has stood for long, if both fit before the lane's end.
        room = driver[LENGTH] + driver[MIN_GAP] + traffic.floats[leader, LENGTH] + traffic.floats[leader, MIN_GAP]
        if floats[v, LEFT_SPACE] >= room:
            return -1.0
    if not (
        faster < EPS
        or (leftward and not is_congested(state, v))
        or left - brake_gap(speed, driver[DECEL], driver[TAU], step_s) < passing_m
        or faster * remaining_s < passing_m
    ):
        if state.ints[leader, WAITING_MS] <= _PATIENCE_MS:
            add_advice(state, leader, leader_mps)
        return -1.0
    target = max(target, max(0.0, speed - driver[DECEL] * step_s))
    if net.lane_ints[state.ints[v, LANE], LANE_INSIDE]:
        # It does not stop inside a junction to fall behind.
        target = max(target, driver[MAX_ACCEL] * step_s)
    if target >= speed:
        add_advice(state, v, target)
        return planned
    decel = min(driver[DECEL], max(_FALLING_BEHIND_MPS2, (speed - target) / remaining_s))
    target = min(planned, max(0.0, speed - decel * step_s))
    add_advice(state, v, target)
    return target


@compiled
def inform_follower(net, traffic, state, v, around, blocked, leftward, remaining_s, planned, step_s):  # type: ignore[no-untyped-def]
    """Ask the follower on the target lane to let ``v`` in, or to pass it."""
    follower, gap = around.target_follower, around.target_follower_gap
    if follower < 0:
        return
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    helper, follower_mps = traffic.floats[follower], state.floats[follower, SPEED]
    limit = desired_speed(net, state, follower, state.ints[follower, LANE])
    flags = WANTED_LEFTWARD if leftward else WANTED_RIGHTWARD
    if not blocked & BLOCKED_BY_FOLLOWER:
        if blocked & BLOCKED_BY_LEADER:
            state.ints[follower, CHANGE_STATE] |= flags
            top = state.floats[follower, TOP_SPEED]
            add_advice(state, follower, _speed_staying_behind(helper, gap, follower_mps, planned, limit, top, step_s))
        return
    state.ints[follower, CHANGE_STATE] |= flags | BLOCKS_FOLLOWER
    # A follower that was asked for this difference in the last step has it up to rounding, which decides here.
    if planned - follower_mps >= OVERTAKING_MPS:
        needed = secure_gap(helper, follower_mps, planned)
        if (needed - gap) / remaining_s < planned - follower_mps:
            add_advice(state, follower, max(follower_mps, planned - OVERTAKING_MPS))
            return
    braked = max(0.0, follower_mps - helper[DECEL] * step_s)
    braked_1s = max(0.0, follower_mps - helper[DECEL])
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
        short = leftward and net.lane_floats[state.ints[v, LANE], LANE_LENGTH] < _RAMP_M
        yields = follower_mps > speed and not short
        passing = max(braked if yields else follower_mps, speed + OVERTAKING_MPS)
        add_advice(state, follower, passing)
        if not yields or follower_mps - helper[DECEL] * remaining_s > speed:
            # It passes slowly: the changing vehicle waits for it.
            way = gap + driver[LENGTH] + driver[MIN_GAP] + helper[LENGTH] + secure_gap(driver, planned, passing)
            add_advice(state, v, max(passing - way / remaining_s, speed - driver[DECEL] * step_s))


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
