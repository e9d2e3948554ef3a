"""Foes: vehicles inside a junction on ways that cross, merge with or diverge from a vehicle's own, and their effect."""

from __future__ import annotations

import math
from typing import NamedTuple

from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS, STANDING_MPS
from izoo.envs.twin.driving.traffic_lights import OFF_YELLOW, RED, YELLOW, is_green, is_major
from izoo.envs.twin.net.conflicts import (
    CONFLICT_ENTRY,
    CONFLICT_FOE_SIZE,
    CONFLICT_FOE_TO_END,
    CONFLICT_FOE_WAITS,
    CONFLICT_FOE_YIELDS,
    CONFLICT_KIND,
    CONFLICT_LANE,
    CONFLICT_RADIUS,
    CONFLICT_SIZE,
    CONFLICT_TO_END,
    CONFLICT_YIELDS,
    CROSSING,
    DIVERGING,
    MERGING,
    NOWHERE,
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
"""A vehicle behind one that has stood for longer than this does not request to pass."""


class Plan(NamedTuple):
    """What a vehicle plans at its next link.

    Attributes:
        speed_mps: for the coming step.
        passing_mps: at the link.
        requests: whether it requests to pass the link.
    """

    speed_mps: float
    passing_mps: float
    requests: bool


class Encounter(NamedTuple):
    """A conflict ahead of a vehicle.

    Attributes:
        link: the link at the end of the vehicle's way.
        row: of the conflict, whose foe is on the other way.
        distance_m: from the vehicle's front to the link.
    """

    link: int
    row: int
    distance_m: float


@compiled
def limit_by_foes(net, traffic, state, v, link, distance_m, plan, floor, step_s):  # type: ignore[no-untyped-def]
    """Return the plan, with its speeds lowered and its request withdrawn for vehicles on ways in conflict.

    Args:
        link: the next link of vehicle ``v``; it has conflicts if it begins inside the junction.
        distance_m: from the front to that link, which is the end of a way.
        plan: a :class:`Plan`.
        floor: speed (m/s) with which it can stop before the link before that one, 0 if there is none.
    """
    first = net.conflict_first[link]
    for row in range(first, first + net.conflict_count[link]):
        lane = net.conflict_ints[row, CONFLICT_LANE]
        if state.lanes[lane, LANE_FRONT] < 0 and state.lanes[lane, LANE_TAILS] == 0:
            continue
        ahead = Encounter(link, row, distance_m)
        w = state.lanes[lane, LANE_FRONT]
        while w >= 0:
            plan = _yield_to(net, traffic, state, v, w, ahead, plan, floor, step_s)
            w = state.ints[w, BEHIND]
        for k in range(state.lanes[lane, LANE_TAILS]):
            plan = _yield_to(net, traffic, state, v, state.tails[lane, k], ahead, plan, floor, step_s)
    return plan


@compiled
def gap_to_foe(net, traffic, state, v, w, ahead, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` must yield to ``w``, which is on the other way of a conflict, and the gap.

    Args:
        ahead: the :class:`Encounter`.

    Returns:
        Whether it must; the distance from its front to the conflict; the same less the standstill gap and the part of
        ``w`` that has yet to pass the begin of the conflict (m).
    """
    if w == v:
        return False, 0.0, 0.0
    row, distance_m = ahead.row, ahead.distance_m
    kind = net.conflict_ints[row, CONFLICT_KIND]
    crosses = kind == CROSSING
    size = foe_size = 0.0
    if crosses:
        size, foe_size = net.conflict_floats[row, CONFLICT_SIZE], net.conflict_floats[row, CONFLICT_FOE_SIZE]
    foe_to_end = net.conflict_floats[row, CONFLICT_FOE_TO_END]
    to_conflict = distance_m - net.conflict_floats[row, CONFLICT_TO_END]
    if kind != MERGING and to_conflict + size < 0.0:
        return False, 0.0, 0.0
    outside = net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    nowhere = foe_to_end == NOWHERE
    lane = net.conflict_ints[row, CONFLICT_LANE]
    in_front = state.ints[w, LANE] == lane
    if nowhere and not outside:
        # A vehicle without right of way yields to a foe on the way to a waiting point, at any distance.
        waits = state.ints[v, JUNCTION_MS] == NEVER_MS and to_conflict >= -POSITION_EPS
        requests = not in_front or state.ints[w, WILL_PASS] == 1
        yields = waits and requests and _has_precedence(net, traffic, state, v, w, ahead, -math.inf, step_s)
        return yields, to_conflict, -math.inf
    if nowhere and is_green(state.link_letter[net.conflict_ints[row, CONFLICT_ENTRY]]):
        # From outside, it yields to such a foe only while the foe's signal is not green.
        return False, 0.0, 0.0
    back_left = net.lane_floats[lane, LANE_LENGTH] - foe_to_end - rear_position(net, traffic, state, w, lane)
    swept = _swept_width(traffic, v, net.conflict_floats[row, CONFLICT_RADIUS])
    past = back_left + foe_size + swept < 0.0 and not nowhere
    entered = back_left < traffic.floats[w, LENGTH]
    in_the_way = (to_conflict > 0.0 and not past and entered) or (
        kind == MERGING and to_conflict > back_left - traffic.floats[w, LENGTH] and entered
    )
    if kind != MERGING and past:
        return False, 0.0, 0.0
    if kind != DIVERGING and in_front and not in_the_way and state.ints[w, WILL_PASS] == 0:
        return False, 0.0, 0.0
    gap = to_conflict - traffic.floats[v, MIN_GAP] - back_left
    if kind == MERGING and back_left < 0.0:
        # Once the foe's rear is in the conflict, the remaining distances to the common end count as well.
        gap += min(0.0, net.conflict_floats[row, CONFLICT_TO_END] - foe_to_end)
    is_first = to_conflict < -POSITION_EPS and not outside and not in_the_way
    if is_first and (crosses or (kind == MERGING and not _overlap_from_begin(net, ahead))):
        # It is in the conflict already and goes on, on merging ways unless the foe is ahead.
        return False, 0.0, 0.0
    rear_gap = gap - foe_size
    if crosses and not outside:
        rear_gap += _conflict_at_wait(net, ahead, to_conflict)
    yields = outside or in_the_way or _has_precedence(net, traffic, state, v, w, ahead, rear_gap, step_s)
    return yields, to_conflict, gap


@compiled
def _conflict_at_wait(net, ahead, to_conflict):  # type: ignore[no-untyped-def]
    """Return what to add to ``to_conflict`` (m) for a vehicle that comes to a waiting point: its conflict begins there.

    A vehicle past it by a few centimetres still comes to it.
    """
    before, entry = net.link_ints[ahead.link, LINK_FROM], net.link_ints[ahead.link, LINK_ENTRY]
    to_way = ahead.distance_m - net.lane_floats[before, LANE_LENGTH]
    if net.link_ints[entry, LINK_CONT] and before != net.link_ints[entry, LINK_VIA] and to_way > -POSITION_EPS:
        return to_way - to_conflict
    return 0.0


@compiled
def _overlap_from_begin(net, ahead):  # type: ignore[no-untyped-def]
    """Whether the vehicle's way is in the conflict from its begin."""
    length = net.lane_floats[net.link_ints[ahead.link, LINK_FROM], LANE_LENGTH]
    return net.conflict_floats[ahead.row, CONFLICT_TO_END] > length - POSITION_EPS


@compiled
def is_before_wait(net, row):  # type: ignore[no-untyped-def]
    """Whether vehicles on the other way of conflict ``row`` still come to a waiting point."""
    nowhere = net.conflict_floats[row, CONFLICT_FOE_TO_END] == NOWHERE
    crosses = net.conflict_ints[row, CONFLICT_KIND] == CROSSING
    return crosses and (nowhere or net.conflict_ints[row, CONFLICT_FOE_WAITS] == 1)


@compiled
def _blocks_for_long(net, state, v, w):  # type: ignore[no-untyped-def]
    """Whether vehicle ``w`` comes from the lane of ``v`` or the one before it, or has stood for long."""
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
def _yield_to(net, traffic, state, v, w, ahead, plan, floor, step_s):  # type: ignore[no-untyped-def]
    """Return the plan of vehicle ``v``, restricted by vehicle ``w`` on the other way of a conflict."""
    yields, to_conflict, gap = gap_to_foe(net, traffic, state, v, w, ahead, step_s)
    if not yields:
        return plan
    row, distance_m = ahead.row, ahead.distance_m
    kind, before_wait = net.conflict_ints[row, CONFLICT_KIND], is_before_wait(net, row)
    if net.conflict_floats[row, CONFLICT_FOE_TO_END] == NOWHERE:
        # A vehicle in the junction that lost right of way must not accelerate; if stopped, it stays.
        before_wait = before_wait and net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    crosses = kind == CROSSING
    driver = traffic.floats[v]
    speed = state.floats[v, SPEED]
    wish = desired_speed(net, state, v, state.ints[v, LANE])
    to_way = distance_m - net.lane_floats[net.link_ints[ahead.link, LINK_FROM], LANE_LENGTH]
    if crosses:
        nearer = _conflict_at_wait(net, ahead, to_conflict)
        gap, to_conflict = gap + nearer, to_conflict + nearer
        gap -= net.conflict_floats[row, CONFLICT_FOE_SIZE]
    cleared = to_conflict  # the foe is out of the way once its rear has passed this place
    if kind == MERGING and to_conflict < -POSITION_EPS and gap < 0.0 and _overlap_from_begin(net, ahead):
        # It has been in the conflict since its way began, and waits where that ends, as before a crossing there.
        crosses, to_conflict = True, distance_m
    if gap >= 0.0 and not before_wait:
        safe = follow_speed(driver, gap, speed, state.floats[w, SPEED], wish, step_s)
    else:
        safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver[DECEL], step_s)
    if before_wait:
        if state.ints[w, LANE] != net.conflict_ints[row, CONFLICT_LANE] and to_conflict >= 0.0:
            # The foe has passed the waiting point except for its tail: up to the conflict, and not behind it.
            stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
            safe = max(safe, stop)
    elif crosses and to_conflict >= 0.0:
        stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
        leave_s = (cleared - gap) / max(state.floats[w, SPEED], STANDING_MPS)
        final = max(speed, 2.0 * (to_conflict - driver[MIN_GAP]) / leave_s - speed)
        in_time = speed + (final - speed) / leave_s * step_s
        safe = max(safe, min(in_time, stop))
    # It may always drive up to the link before and stop there.
    planned = max(min(plan.speed_mps, safe), floor)
    requests = plan.requests and not (planned < STANDING_MPS and _blocks_for_long(net, state, v, w))
    return Plan(planned, min(plan.passing_mps, safe), requests)


@compiled
def _swept_width(traffic, v, radius):  # type: ignore[no-untyped-def]
    """Return how far (m) the body of vehicle ``v``, with a metre at both ends, cuts the inside of a turn: the sagitta.

    It is infinite if the body is longer than the turn is wide: no foe is ever past such a vehicle.
    """
    if radius == 0.0:
        return 0.0
    half = 0.5 * (traffic.floats[v, LENGTH] + 2.0)
    rest = radius * radius - half * half
    return radius - math.sqrt(rest) if rest >= 0.0 else math.inf


@compiled
def _has_precedence(net, traffic, state, v, w, ahead, gap, step_s):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``w``, inside the junction, has precedence over vehicle ``v``.

    The first to come has: with right of way by the time of entering the junction, without it by the time of coming
    into conflict, past the waiting point. A vehicle that did not request to pass has lost both times; on diverging ways
    its entry time still counts. While one of the two signals is red, vehicles from the other wait for those left over
    if they can still brake; otherwise vehicles at waiting points wait.

    Args:
        ahead: the :class:`Encounter` of ``v``.
        gap: from ``v`` to the rear of ``w`` (m), less the standstill gap and, on crossing ways, the conflict's length;
            below 0 if ``v`` would reach the conflict first.
    """
    row = ahead.row
    own_letter = state.link_letter[net.link_ints[ahead.link, LINK_ENTRY]]
    other_letter = state.link_letter[net.conflict_ints[row, CONFLICT_ENTRY]]
    own, foe = state.ints[v, JUNCTION_MS], state.ints[w, CONFLICT_MS]
    if net.conflict_ints[row, CONFLICT_KIND] == DIVERGING:
        own, foe = state.ints[v, ENTERED_MS], state.ints[w, ENTERED_MS]
    elif own_letter == RED or other_letter == RED:
        drives = other_letter != RED and state.floats[w, SPEED] > STANDING_MPS
        if drives and gap < 0.0 and _can_brake(traffic, state, v, w, gap, step_s):
            return False
        if other_letter == RED or state.ints[v, CONFLICT_MS] == NEVER_MS or state.floats[v, POSITION] < POSITION_EPS:
            # ``w`` is left over as well, or ``v`` is still at its waiting point.
            own = state.ints[v, CONFLICT_MS]
    else:
        yields, gives = _yields(net, state, v, w, row, own_letter, other_letter)
        if yields:
            own = state.ints[v, CONFLICT_MS]
            if not gives:
                foe = state.ints[w, JUNCTION_MS]
    if own != foe:
        return own > foe
    if state.floats[v, SPEED] != state.floats[w, SPEED]:
        return state.floats[v, SPEED] < state.floats[w, SPEED]
    return id_sorts_before(v, w)


@compiled
def _can_brake(traffic, state, v, w, gap, step_s):  # type: ignore[no-untyped-def]
    """Whether ``w``, ``gap`` (m) ahead of vehicle ``v`` (below 0: behind it), could brake for it after this step."""
    driver = traffic.floats[w]
    soon = state.floats[w, SPEED] + driver[MAX_ACCEL] * step_s
    room = -gap - driver[LENGTH] - 2.0 * traffic.floats[v, MIN_GAP]
    return brake_gap(soon, driver[DECEL], driver[TAU], step_s) < room


@compiled
def _yields(net, state, v, w, row, own_letter, other_letter):  # type: ignore[no-untyped-def]
    """Return whether ``v`` has to yield to ``w``, and ``w`` to ``v``, by what their entry links show now."""
    if is_major(own_letter) != is_major(other_letter):
        return not is_major(own_letter), not is_major(other_letter)
    if own_letter in (YELLOW, OFF_YELLOW) and other_letter in (YELLOW, OFF_YELLOW):
        own, other = state.floats[v, SPEED], state.floats[w, SPEED]
        return other >= own, own >= other
    return net.conflict_ints[row, CONFLICT_YIELDS] == 1, net.conflict_ints[row, CONFLICT_FOE_YIELDS] == 1


@compiled
def id_sorts_before(v, w):  # type: ignore[no-untyped-def]
    """Return whether the decimal id of ``v`` sorts before that of ``w``, which is SUMO's last tie-break."""
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
