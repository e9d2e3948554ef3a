"""Vehicles inside a junction: whom a driver heeds on ways that cross, merge with or part from his, and how much."""

from __future__ import annotations

import math

from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import back_on
from izoo.envs.twin.driving.tolerances import POSITION_EPS, STANDING_MPS
from izoo.envs.twin.driving.traffic_lights import OFF_YELLOW, RED, YELLOW, is_green, is_major
from izoo.envs.twin.net.conflicts import (
    CONFLICT_BEHIND,
    CONFLICT_ENTRY,
    CONFLICT_FOE_BEHIND,
    CONFLICT_FOE_SIZE,
    CONFLICT_FOE_WAITS,
    CONFLICT_FOE_YIELDS,
    CONFLICT_KIND,
    CONFLICT_LANE,
    CONFLICT_RADIUS,
    CONFLICT_SIZE,
    CONFLICT_YIELDS,
    CROSSING,
    MERGING,
    NOWHERE,
    PARTING,
)
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    BEHIND,
    CONFLICT_MS,
    DECEL,
    ENTERED_MS,
    JUNCTION_MS,
    LANE,
    LANE_FRONT,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_TAILS,
    LENGTH,
    LINK_CONT,
    LINK_ENTRY,
    LINK_FROM,
    LINK_VIA,
    MAX_ACCEL,
    MIN_GAP,
    NEVER_MS,
    POSITION,
    SPEED,
    TAU,
    WAITING_MS,
    WILL_PASS,
)

BLOCKED_AFTER_MS = 5000
"""Who stands behind a vehicle that has stood for longer than this does not ask to pass."""


@compiled
def limit_by_foes(net, traffic, state, v, link, distance_m, best, passing, request, floor, step_s):  # type: ignore[no-untyped-def]
    """Return the plan's speeds and its request, lowered by vehicles on ways in conflict.

    Args:
        link: the next link of vehicle ``v``; it has conflicts if it begins inside the junction.
        distance_m: from the front to that link, that is to the end of a way.
        best, passing: speed (m/s) for the coming step, and at the link.
        request: whether the vehicle asks to pass the link.
        floor: speed (m/s) with which it can stop before the link that it comes to before, 0 where there is none.
    """
    first = net.conflict_first[link]
    for row in range(first, first + net.conflict_count[link]):
        lane = net.conflict_ints[row, CONFLICT_LANE]
        if state.lanes[lane, LANE_FRONT] < 0 and state.lanes[lane, LANE_TAILS] == 0:
            continue
        w = state.lanes[lane, LANE_FRONT]
        while w >= 0:
            best, passing, request = _heed(
                net, traffic, state, v, w, link, row, distance_m, best, passing, request, floor, step_s
            )
            w = state.ints[w, BEHIND]
        for k in range(state.lanes[lane, LANE_TAILS]):
            w = state.tails[lane, k]
            best, passing, request = _heed(
                net, traffic, state, v, w, link, row, distance_m, best, passing, request, floor, step_s
            )
    return best, passing, request


@compiled
def gap_before(net, traffic, state, v, w, link, row, distance_m, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` heeds ``w`` on the way of conflict ``row``, and how far it is.

    Returns:
        Whether it does; from its front to the conflict; the same less the standstill gap and what of ``w`` is still to
        come past the begin of the conflict (m).
    """
    if w == v:
        return False, 0.0, 0.0
    kind = net.conflict_ints[row, CONFLICT_KIND]
    crosses = kind == CROSSING
    size = foe_size = 0.0
    if crosses:
        size, foe_size = net.conflict_floats[row, CONFLICT_SIZE], net.conflict_floats[row, CONFLICT_FOE_SIZE]
    foe_behind = net.conflict_floats[row, CONFLICT_FOE_BEHIND]
    to_conflict = distance_m - net.conflict_floats[row, CONFLICT_BEHIND]
    if kind != MERGING and to_conflict + size < 0.0:
        return False, 0.0, 0.0
    outside = net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    nowhere = foe_behind == NOWHERE
    lane = net.conflict_ints[row, CONFLICT_LANE]
    in_front = state.ints[w, LANE] == lane
    if nowhere and not outside:
        # One on the way to a waiting point, however far, is waited for by those who have lost their turn.
        waits = state.ints[v, JUNCTION_MS] == NEVER_MS and to_conflict >= -POSITION_EPS
        asks = not in_front or state.ints[w, WILL_PASS] == 1
        heeds = waits and asks and _goes_first(net, traffic, state, v, w, link, row, -math.inf, step_s)
        return heeds, to_conflict, -math.inf
    if nowhere and is_green(state.link_letter[net.conflict_ints[row, CONFLICT_ENTRY]]):
        # From outside it is waited for only while its signal is not green.
        return False, 0.0, 0.0
    back_left = net.lane_floats[lane, LANE_LENGTH] - foe_behind - back_on(net, traffic, state, w, lane)
    swing = _swing(traffic, v, net.conflict_floats[row, CONFLICT_RADIUS])
    past = back_left + foe_size + swing < 0.0 and not nowhere
    entered = back_left < traffic.floats[w, LENGTH]
    in_the_way = (to_conflict > 0.0 and not past and entered) or (
        kind == MERGING and to_conflict > back_left - traffic.floats[w, LENGTH] and entered
    )
    if kind != MERGING and past:
        return False, 0.0, 0.0
    if kind != PARTING and in_front and not in_the_way and state.ints[w, WILL_PASS] == 0:
        return False, 0.0, 0.0
    gap = to_conflict - traffic.floats[v, MIN_GAP] - back_left
    if kind == MERGING and back_left < 0.0:
        # Once its rear is in the conflict, what each has left to the common end counts as well.
        gap += min(0.0, net.conflict_floats[row, CONFLICT_BEHIND] - foe_behind)
    is_first = to_conflict < -POSITION_EPS and not outside and not in_the_way
    if is_first and (crosses or (kind == MERGING and not _never_apart(net, link, row))):
        # It is in the conflict already: it goes on, where ways merge unless the other is ahead.
        return False, 0.0, 0.0
    ahead = gap - foe_size
    if crosses and not outside:
        ahead += _conflict_at_wait(net, link, distance_m, to_conflict)
    heeds = outside or in_the_way or _goes_first(net, traffic, state, v, w, link, row, ahead, step_s)
    return heeds, to_conflict, gap


@compiled
def _conflict_at_wait(net, link, distance_m, to_conflict):  # type: ignore[no-untyped-def]
    """Return what to add to ``to_conflict`` (m): for those who come to a waiting point, the conflict begins there.

    Who is past it by a few centimetres still comes to it.
    """
    before, entry = net.link_ints[link, LINK_FROM], net.link_ints[link, LINK_ENTRY]
    to_way = distance_m - net.lane_floats[before, LANE_LENGTH]
    if net.link_ints[entry, LINK_CONT] and before != net.link_ints[entry, LINK_VIA] and to_way > -POSITION_EPS:
        return to_way - to_conflict
    return 0.0


@compiled
def _never_apart(net, link, row):  # type: ignore[no-untyped-def]
    """Whether the way before ``link`` is in the conflict of ``row`` as soon as it begins."""
    length = net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
    return net.conflict_floats[row, CONFLICT_BEHIND] > length - POSITION_EPS


@compiled
def is_before_wait(net, row):  # type: ignore[no-untyped-def]
    """Whether those on the way of conflict ``row`` still come to a waiting point."""
    nowhere = net.conflict_floats[row, CONFLICT_FOE_BEHIND] == NOWHERE
    crosses = net.conflict_ints[row, CONFLICT_KIND] == CROSSING
    return crosses and (nowhere or net.conflict_ints[row, CONFLICT_FOE_WAITS] == 1)


@compiled
def _is_stuck(net, state, v, w):  # type: ignore[no-untyped-def]
    """Whether vehicle ``w`` comes from where ``v`` comes from or is, or has stood for long."""
    if state.ints[w, WAITING_MS] > BLOCKED_AFTER_MS:
        return True
    before_w = _lane_before(net, state.ints[w, LANE])
    return before_w >= 0 and (before_w == state.ints[v, LANE] or before_w == _lane_before(net, state.ints[v, LANE]))


@compiled
def _lane_before(net, lane):  # type: ignore[no-untyped-def]
    """Return the lane that leads to ``lane`` inside a junction, -1 for other lanes."""
    if net.lane_ints[lane, LANE_INSIDE] == 0:
        return -1
    return net.link_ints[net.incoming_links[net.incoming_start[lane]], LINK_FROM]


@compiled
def _heed(net, traffic, state, v, w, link, row, distance_m, best, passing, request, floor, step_s):  # type: ignore[no-untyped-def]
    """Lower the speeds of vehicle ``v`` for vehicle ``w`` on the way of conflict ``row``."""
    heeds, to_conflict, gap = gap_before(net, traffic, state, v, w, link, row, distance_m, step_s)
    if not heeds:
        return best, passing, request
    kind, before_wait = net.conflict_ints[row, CONFLICT_KIND], is_before_wait(net, row)
    if net.conflict_floats[row, CONFLICT_FOE_BEHIND] == NOWHERE:
        # Who is inside, and has lost its turn, goes on no faster; who stands does not move.
        before_wait = before_wait and net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    crosses = kind == CROSSING
    driver = traffic.floats[v]
    speed = state.floats[v, SPEED]
    wish = desired_speed(net, state, v, state.ints[v, LANE])
    to_way = distance_m - net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
    if crosses:
        nearer = _conflict_at_wait(net, link, distance_m, to_conflict)
        gap, to_conflict = gap + nearer, to_conflict + nearer
        gap -= net.conflict_floats[row, CONFLICT_FOE_SIZE]
    cleared = to_conflict  # the other is out of the way once its rear has passed this place
    if kind == MERGING and to_conflict < -POSITION_EPS and gap < 0.0 and _never_apart(net, link, row):
        # It is in the conflict since its way began, and waits where that ends, as before a crossing there.
        crosses, to_conflict = True, distance_m
    if gap >= 0.0 and not before_wait:
        safe = follow_speed(driver, gap, speed, state.floats[w, SPEED], wish, step_s)
    else:
        safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver[DECEL], step_s)
    if before_wait:
        if state.ints[w, LANE] != net.conflict_ints[row, CONFLICT_LANE] and to_conflict >= 0.0:
            # It has passed the waiting point but for its tail: up to the conflict, and not behind it.
            stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
            safe = max(safe, stop)
    elif crosses and to_conflict >= 0.0:
        stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
        leave_s = (cleared - gap) / max(state.floats[w, SPEED], STANDING_MPS)
        final = max(speed, 2.0 * (to_conflict - driver[MIN_GAP]) / leave_s - speed)
        in_time = speed + (final - speed) / leave_s * step_s
        safe = max(safe, min(in_time, stop))
    # It may always drive up to the link before and stop there.
    best = max(min(best, safe), floor)
    passing = min(passing, safe)
    if best < STANDING_MPS and _is_stuck(net, state, v, w):
        request = False
    return best, passing, request


@compiled
def _swing(traffic, v, radius):  # type: ignore[no-untyped-def]
    """Return how far (m) the body of vehicle ``v``, with a metre at both ends, reaches inside a turn: the sagitta.

    It is infinite where the body is longer than the turn is wide: nobody is ever past such a vehicle.
    """
    if radius == 0.0:
        return 0.0
    half = 0.5 * (traffic.floats[v, LENGTH] + 2.0)
    rest = radius * radius - half * half
    return radius - math.sqrt(rest) if rest >= 0.0 else math.inf


@compiled
def _goes_first(net, traffic, state, v, w, link, row, gap, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``w``, inside the junction, goes before vehicle ``v``.

    Whoever came first does: of those with the right of way that is by the time at which they entered the junction, of
    those who have to yield by the time at which they came into conflict, past their waiting point. Who did not ask to
    pass has lost both times; on ways that part, that of entry goes on counting. While one of the two signals is red,
    who comes by the other waits for those left over if it can still brake; otherwise those at waiting points wait.

    Args:
        link, row: the link at the end of the way of ``v``, and the conflict.
        gap: from ``v`` to the rear of ``w`` (m), less the standstill gap and, on ways that cross, the conflict's
            length; below 0 where ``v`` would be at the conflict before.
    """
    own_letter = state.link_letter[net.link_ints[link, LINK_ENTRY]]
    other_letter = state.link_letter[net.conflict_ints[row, CONFLICT_ENTRY]]
    own, foe = state.ints[v, JUNCTION_MS], state.ints[w, CONFLICT_MS]
    if net.conflict_ints[row, CONFLICT_KIND] == PARTING:
        own, foe = state.ints[v, ENTERED_MS], state.ints[w, ENTERED_MS]
    elif own_letter == RED or other_letter == RED:
        drives = other_letter != RED and state.floats[w, SPEED] > STANDING_MPS
        if drives and gap < 0.0 and _can_brake(traffic, state, v, w, gap, step_s):
            return False
        if other_letter == RED or state.ints[v, CONFLICT_MS] == NEVER_MS or state.floats[v, POSITION] < POSITION_EPS:
            # Where ``w`` is left over as well, or ``v`` still at its waiting point.
            own = state.ints[v, CONFLICT_MS]
    else:
        yields, gives = _who_yields(net, state, v, w, row, own_letter, other_letter)
        if yields:
            own = state.ints[v, CONFLICT_MS]
            if not gives:
                foe = state.ints[w, JUNCTION_MS]
    if own != foe:
        return own > foe
    if state.floats[v, SPEED] != state.floats[w, SPEED]:
        return state.floats[v, SPEED] < state.floats[w, SPEED]
    return named_before(v, w)


@compiled
def _can_brake(traffic, state, v, w, gap, step_s):  # type: ignore[no-untyped-def]
    """Whether ``w``, ``gap`` (m) before vehicle ``v`` (below 0: behind it), could brake for it after this step."""
    driver = traffic.floats[w]
    soon = state.floats[w, SPEED] + driver[MAX_ACCEL] * step_s
    room = -gap - driver[LENGTH] - 2.0 * traffic.floats[v, MIN_GAP]
    return brake_gap(soon, driver[DECEL], driver[TAU], step_s) < room


@compiled
def _who_yields(net, state, v, w, row, own_letter, other_letter):  # type: ignore[no-untyped-def]
    """Return whether ``v`` has to yield to ``w``, and ``w`` to ``v``, by what the signals behind them show now."""
    if is_major(own_letter) != is_major(other_letter):
        return not is_major(own_letter), not is_major(other_letter)
    if own_letter in (YELLOW, OFF_YELLOW) and other_letter in (YELLOW, OFF_YELLOW):
        own, other = state.floats[v, SPEED], state.floats[w, SPEED]
        return other >= own, own >= other
    return net.conflict_ints[row, CONFLICT_YIELDS] == 1, net.conflict_ints[row, CONFLICT_FOE_YIELDS] == 1


@compiled
def named_before(v, w):  # type: ignore[no-untyped-def]
    """Return whether the decimal name of ``v`` sorts before that of ``w``."""
    one, other = v, w
    digits, other_digits = _digits(v), _digits(w)
    while digits > other_digits:
        one, digits = one // 10, digits - 1
    while other_digits > digits:
        other, other_digits = other // 10, other_digits - 1
    # Now both have the same number of digits, or one begins the other.
    return one < other or (one == other and v < w)


@compiled
def _digits(number):  # type: ignore[no-untyped-def]
    digits = 1
    while number >= 10:
        number, digits = number // 10, digits + 1
    return digits
