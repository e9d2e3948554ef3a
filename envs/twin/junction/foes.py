"""Foes: vehicles inside a junction on ways that cross, merge with or diverge from a vehicle's own, and their effect."""

from __future__ import annotations

import math
from typing import NamedTuple

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import brake_gap, desired_speed, follow_speed, stop_speed
from izoo.envs.twin.driving.lane_queues import rear_position
from izoo.envs.twin.driving.tolerances import POSITION_EPS, STANDING_MPS
from izoo.envs.twin.driving.traffic_lights import OFF_YELLOW, RED, YELLOW, is_green, is_major
from izoo.envs.twin.net.conflicts import CROSSING, DIVERGING, MERGING, NOWHERE
from izoo.envs.twin.runtime.layout import NEVER_MS

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
    first = net.links[link].first_conflict
    for row in range(first, first + net.links[link].conflicts):
        lane = net.conflicts[row].lane
        if state.lanes[lane].front < 0 and state.lanes[lane].tails == 0:
            continue
        ahead = Encounter(link, row, distance_m)
        w = state.lanes[lane].front
        while w >= 0:
            plan = _yield_to(net, traffic, state, v, w, ahead, plan, floor, step_s)
            w = state.vehicles[w].behind
        for k in range(state.lanes[lane].tails):
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
    kind = net.conflicts[row].kind
    crosses, foe_size = kind == CROSSING, net.conflicts[row].foe_size
    foe_to_end = net.conflicts[row].foe_to_end
    to_conflict = distance_m - net.conflicts[row].to_end
    if kind != MERGING and to_conflict + net.conflicts[row].size < 0.0:
        return False, 0.0, 0.0
    outside = net.lanes[state.vehicles[v].lane].inside == 0
    nowhere = foe_to_end == NOWHERE
    lane = net.conflicts[row].lane
    in_front = state.vehicles[w].lane == lane
    if nowhere and not outside:
        # A vehicle without right of way yields to a foe on the way to a waiting point, at any distance.
        waits = state.vehicles[v].junction_ms == NEVER_MS and to_conflict >= -POSITION_EPS
        requests = not in_front or state.vehicles[w].will_pass == 1
        yields = waits and requests and _has_precedence(net, traffic, state, v, w, ahead, -math.inf, step_s)
        return yields, to_conflict, -math.inf
    if nowhere and is_green(state.link_letter[net.conflicts[row].entry]):
        # From outside, it yields to such a foe only while the foe's signal is not green.
        return False, 0.0, 0.0
    back_left = net.lanes[lane].length - foe_to_end - rear_position(net, traffic, state, w, lane)
    swept = _swept_width(traffic, v, net.conflicts[row].radius)
    past = back_left + foe_size + swept < 0.0 and not nowhere
    entered = back_left < traffic.drivers[w].length
    in_the_way = (to_conflict > 0.0 and not past and entered) or (
        kind == MERGING and to_conflict > back_left - traffic.drivers[w].length and entered
    )
    if kind != MERGING and past:
        return False, 0.0, 0.0
    if kind != DIVERGING and in_front and not in_the_way and state.vehicles[w].will_pass == 0:
        return False, 0.0, 0.0
    gap = to_conflict - traffic.drivers[v].min_gap - back_left
    if kind == MERGING and back_left < 0.0:
        # Once the foe's rear is in the conflict, the remaining distances to the common end count as well.
        gap += min(0.0, net.conflicts[row].to_end - foe_to_end)
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
    before, entry = net.links[ahead.link].from_lane, net.links[ahead.link].entry
    to_way = ahead.distance_m - net.lanes[before].length
    if net.links[entry].cont and before != net.links[entry].via_lane and to_way > -POSITION_EPS:
        return to_way - to_conflict
    return 0.0


@compiled
def _overlap_from_begin(net, ahead):  # type: ignore[no-untyped-def]
    """Whether the vehicle's way is in the conflict from its begin."""
    length = net.lanes[net.links[ahead.link].from_lane].length
    return net.conflicts[ahead.row].to_end > length - POSITION_EPS


@compiled
def is_before_wait(net, row):  # type: ignore[no-untyped-def]
    """Whether vehicles on the other way of conflict ``row`` still come to a waiting point."""
    nowhere = net.conflicts[row].foe_to_end == NOWHERE
    crosses = net.conflicts[row].kind == CROSSING
    return crosses and (nowhere or net.conflicts[row].foe_waits == 1)


@compiled
def _blocks_for_long(net, state, v, w):  # type: ignore[no-untyped-def]
    """Whether vehicle ``w`` comes from the lane of ``v`` or the one before it, or has stood for long."""
    if state.vehicles[w].waiting_ms > BLOCKED_AFTER_MS:
        return True
    before_w = _lane_before(net, state.vehicles[w].lane)
    return before_w >= 0 and (
        before_w == state.vehicles[v].lane or before_w == _lane_before(net, state.vehicles[v].lane)
    )


@compiled
def _lane_before(net, lane):  # type: ignore[no-untyped-def]
    """Return the lane that leads to ``lane`` inside a junction, -1 for other lanes."""
    if net.lanes[lane].inside == 0:
        return -1
    return net.links[net.incoming_links[net.incoming_start[lane]]].from_lane


@compiled
def _yield_to(net, traffic, state, v, w, ahead, plan, floor, step_s):  # type: ignore[no-untyped-def]
    """Return the plan of vehicle ``v``, restricted by vehicle ``w`` on the other way of a conflict."""
    yields, to_conflict, gap = gap_to_foe(net, traffic, state, v, w, ahead, step_s)
    if not yields:
        return plan
    row, distance_m = ahead.row, ahead.distance_m
    kind, before_wait = net.conflicts[row].kind, is_before_wait(net, row)
    if net.conflicts[row].foe_to_end == NOWHERE:
        # A vehicle in the junction that lost right of way must not accelerate; if stopped, it stays.
        before_wait = before_wait and net.lanes[state.vehicles[v].lane].inside == 0
    crosses = kind == CROSSING
    driver = traffic.drivers[v]
    speed = state.vehicles[v].speed
    wish = desired_speed(net, state, v, state.vehicles[v].lane)
    to_way = distance_m - net.lanes[net.links[ahead.link].from_lane].length
    if crosses:
        nearer = _conflict_at_wait(net, ahead, to_conflict)
        gap, to_conflict = gap + nearer, to_conflict + nearer
        gap -= net.conflicts[row].foe_size
    cleared = to_conflict  # the foe is out of the way once its rear has passed this place
    if kind == MERGING and to_conflict < -POSITION_EPS and gap < 0.0 and _overlap_from_begin(net, ahead):
        # It has been in the conflict since its way began, and waits where that ends, as before a crossing there.
        crosses, to_conflict = True, distance_m
    if gap >= 0.0 and not before_wait:
        safe = follow_speed(driver, gap, speed, state.vehicles[w].speed, wish, step_s)
    else:
        safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver.decel, step_s)
    if before_wait:
        if state.vehicles[w].lane != net.conflicts[row].lane and to_conflict >= 0.0:
            # The foe has passed the waiting point except for its tail: up to the conflict, and not behind it.
            stop = stop_speed(driver, to_conflict - driver.min_gap, speed, wish, driver.decel, step_s)
            safe = max(safe, stop)
    elif crosses and to_conflict >= 0.0:
        stop = stop_speed(driver, to_conflict - driver.min_gap, speed, wish, driver.decel, step_s)
        leave_s = (cleared - gap) / max(state.vehicles[w].speed, STANDING_MPS)
        final = max(speed, 2.0 * (to_conflict - driver.min_gap) / leave_s - speed)
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
    half = 0.5 * (traffic.drivers[v].length + 2.0)
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
    own_letter = state.link_letter[net.links[ahead.link].entry]
    other_letter = state.link_letter[net.conflicts[row].entry]
    own, foe = state.vehicles[v].junction_ms, state.vehicles[w].conflict_ms
    if net.conflicts[row].kind == DIVERGING:
        own, foe = state.vehicles[v].entered_ms, state.vehicles[w].entered_ms
    elif own_letter == RED or other_letter == RED:
        drives = other_letter != RED and state.vehicles[w].speed > STANDING_MPS
        if drives and gap < 0.0 and _can_brake(traffic, state, v, w, gap, step_s):
            return False
        if (
            other_letter == RED
            or state.vehicles[v].conflict_ms == NEVER_MS
            or state.vehicles[v].position < POSITION_EPS
        ):
            # ``w`` is left over as well, or ``v`` is still at its waiting point.
            own = state.vehicles[v].conflict_ms
    else:
        yields, gives = _yields(net, state, v, w, row, own_letter, other_letter)
        if yields:
            own = state.vehicles[v].conflict_ms
            if not gives:
                foe = state.vehicles[w].junction_ms
    if own != foe:
        return own > foe
    if state.vehicles[v].speed != state.vehicles[w].speed:
        return state.vehicles[v].speed < state.vehicles[w].speed
    return id_sorts_before(v, w)


@compiled
def _can_brake(traffic, state, v, w, gap, step_s):  # type: ignore[no-untyped-def]
    """Whether ``w``, ``gap`` (m) ahead of vehicle ``v`` (below 0: behind it), could brake for it after this step."""
    driver = traffic.drivers[w]
    soon = state.vehicles[w].speed + driver.max_accel * step_s
    room = -gap - driver.length - 2.0 * traffic.drivers[v].min_gap
    return brake_gap(soon, driver.decel, driver.tau, step_s) < room


@compiled
def _yields(net, state, v, w, row, own_letter, other_letter):  # type: ignore[no-untyped-def]
    """Return whether ``v`` has to yield to ``w``, and ``w`` to ``v``, by what their entry links show now."""
    if is_major(own_letter) != is_major(other_letter):
        return not is_major(own_letter), not is_major(other_letter)
    if own_letter in (YELLOW, OFF_YELLOW) and other_letter in (YELLOW, OFF_YELLOW):
        own, other = state.vehicles[v].speed, state.vehicles[w].speed
        return other >= own, own >= other
    return net.conflicts[row].yields == 1, net.conflicts[row].foe_yields == 1


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
