"""Right of way: vehicles inside the junction, gaps between those that approach it, and keeping it clear.

The rules were found by probing SUMO with two and three vehicles that meet (see the tests); ``sumo --link-output`` and
``getJunctionFoes`` print what they are fed with.
"""

from __future__ import annotations

import math

from izoo.envs.twin.arrays import (
    BEHIND,
    CONFLICT_MS,
    DECEL,
    FIRST_ITEM,
    ITEM_ARRIVAL_MS,
    ITEM_ARRIVAL_SPEED,
    ITEM_BRAKED_SPEED,
    ITEM_DISTANCE,
    ITEM_LEAVE_MS,
    ITEM_LEAVE_SPEED,
    ITEM_LINK,
    ITEM_NEXT,
    ITEM_REQUEST,
    ITEM_VEHICLE,
    ITEMS,
    JUNCTION_MS,
    LANE,
    LANE_FRONT,
    LANE_INSIDE,
    LANE_LENGTH,
    LANE_LIMIT,
    LANE_TAILS,
    LENGTH,
    LINK_CONT,
    LINK_ENTRY,
    LINK_FIRST_RESPONSE,
    LINK_FROM,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_RESPONSES,
    LINK_TO,
    MIN_GAP,
    NEVER_MS,
    NOW_MS,
    SPEED,
    STOOD_FOR,
    WAITING_MS,
    WILL_PASS,
)
from izoo.envs.twin.compiled import compiled
from izoo.envs.twin.conflicts import (
    CONFLICT_BEHIND,
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
from izoo.envs.twin.following import follow_speed, stop_speed
from izoo.envs.twin.lights import is_major
from izoo.envs.twin.order import back_on

RED, STOP = ord("r"), ord("s")
STANDING_MPS = 0.1
STOP_NEAR_M = 4.5
"""A vehicle that has stood this close to a link counts as having stopped for it."""
MARGIN_MS = 1000
"""Time that lies between the passages of two vehicles in conflict."""
IMPATIENT_AFTER_MS = 180_000.0
NEVER_LATER_S = 30.0
"""Delay of a vehicle that would stop instead of passing."""
POSITION_EPS = 0.1
VISIBILITY_M = 4.5


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
def _heed(net, traffic, state, v, w, link, row, distance_m, best, passing, request, floor, step_s):  # type: ignore[no-untyped-def]
    """Lower the speeds of vehicle ``v`` for vehicle ``w`` on the way of conflict ``row``."""
    if w == v:
        return best, passing, request
    kind = net.conflict_ints[row, CONFLICT_KIND]
    size = foe_size = 0.0
    if kind == CROSSING:
        size, foe_size = net.conflict_floats[row, CONFLICT_SIZE], net.conflict_floats[row, CONFLICT_FOE_SIZE]
    foe_behind = net.conflict_floats[row, CONFLICT_FOE_BEHIND]
    to_conflict = distance_m - net.conflict_floats[row, CONFLICT_BEHIND]
    if kind != MERGING and to_conflict + size < 0.0:
        return best, passing, request
    outside = net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    nowhere = foe_behind == NOWHERE
    if nowhere and not outside:
        return best, passing, request
    lane = net.conflict_ints[row, CONFLICT_LANE]
    in_front = state.ints[w, LANE] == lane
    before_wait = kind == CROSSING and (nowhere or net.conflict_ints[row, CONFLICT_FOE_WAITS] == 1)
    back_left = net.lane_floats[lane, LANE_LENGTH] - foe_behind - back_on(net, traffic, state, w, lane)
    swing = _swing(traffic, v, net.conflict_floats[row, CONFLICT_RADIUS])
    past = back_left + foe_size + swing < 0.0 and not nowhere
    entered = back_left < traffic.floats[w, LENGTH]
    in_the_way = (to_conflict > 0.0 and not past and entered) or (
        kind == MERGING and to_conflict > back_left - traffic.floats[w, LENGTH] and entered
    )
    if kind != MERGING and past:
        return best, passing, request
    if kind == CROSSING and in_front and not in_the_way and state.ints[w, WILL_PASS] == 0:
        return best, passing, request
    if not (outside or in_the_way or _goes_first(net, state, v, w, link, row)):
        return best, passing, request
    driver = traffic.floats[v]
    speed = state.floats[v, SPEED]
    wish = net.lane_floats[state.ints[v, LANE], LANE_LIMIT]
    to_way = distance_m - net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
    gap = to_conflict - driver[MIN_GAP] - back_left
    if kind == CROSSING:
        if to_way >= 0.0 and net.link_ints[net.link_ints[link, LINK_ENTRY], LINK_CONT]:
            # Before the waiting point, that is where the conflict is taken to begin.
            gap += to_way - to_conflict
            to_conflict = to_way
        gap -= foe_size
    if gap >= 0.0 and not before_wait:
        safe = follow_speed(driver, gap, speed, state.floats[w, SPEED], wish, step_s)
    else:
        safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver[DECEL], step_s)
    if before_wait:
        if not in_front and to_conflict >= 0.0:
            # It has passed the waiting point but for its tail: up to the conflict, and not behind it.
            stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
            safe = max(safe, stop)
    elif kind == CROSSING and to_conflict >= 0.0:
        stop = stop_speed(driver, to_conflict - driver[MIN_GAP], speed, wish, driver[DECEL], step_s)
        leave_s = (to_conflict - gap) / max(state.floats[w, SPEED], STANDING_MPS)
        final = max(speed, 2.0 * (to_conflict - driver[MIN_GAP]) / leave_s - speed)
        in_time = speed + (final - speed) / leave_s * step_s
        safe = max(safe, min(in_time, stop))
    # It may always drive up to the link before and stop there.
    best = max(min(best, safe), floor)
    passing = min(passing, safe)
    if best < STANDING_MPS and state.floats[w, SPEED] < STANDING_MPS:
        request = False
    return best, passing, request


@compiled
def leader_in_conflict(net, traffic, state, v, link, distance_m, step_s):  # type: ignore[no-untyped-def]
    """Return who inside the junction would hold ``v`` up most if it went on by ``link``, or -1, and the gap (m).

    Args:
        distance_m: from the front of ``v``, whatever its lane, to ``link``.
    """
    driver, speed = traffic.floats[v], state.floats[v, SPEED]
    wish = net.lane_floats[state.ints[v, LANE], LANE_LIMIT]
    found, found_gap, least = -1, 0.0, math.inf
    first = net.conflict_first[link]
    for row in range(first, first + net.conflict_count[link]):
        lane = net.conflict_ints[row, CONFLICT_LANE]
        front, tails = state.lanes[lane, LANE_FRONT], state.lanes[lane, LANE_TAILS]
        k = 0
        while front >= 0 or k < tails:
            if front >= 0:
                w = front
                front = state.ints[w, BEHIND]
            else:
                w = state.tails[lane, k]
                k += 1
            counts, gap = _conflict_gap(net, traffic, state, v, w, link, row, distance_m)
            if not counts:
                continue
            if gap >= 0.0:
                safe = follow_speed(driver, gap, speed, state.floats[w, SPEED], wish, step_s)
            else:
                to_way = distance_m - net.lane_floats[net.link_ints[link, LINK_FROM], LANE_LENGTH]
                safe = stop_speed(driver, to_way - POSITION_EPS, speed, wish, driver[DECEL], step_s)
            if safe < least:
                found, found_gap, least = w, gap, safe
    return found, found_gap


@compiled
def _conflict_gap(net, traffic, state, v, w, link, row, distance_m):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``v`` heeds ``w`` on the way of conflict ``row``, and the gap (m, less minGap)."""
    if w == v:
        return False, 0.0
    kind = net.conflict_ints[row, CONFLICT_KIND]
    size = foe_size = 0.0
    if kind == CROSSING:
        size, foe_size = net.conflict_floats[row, CONFLICT_SIZE], net.conflict_floats[row, CONFLICT_FOE_SIZE]
    foe_behind = net.conflict_floats[row, CONFLICT_FOE_BEHIND]
    to_conflict = distance_m - net.conflict_floats[row, CONFLICT_BEHIND]
    if kind != MERGING and to_conflict + size < 0.0:
        return False, 0.0
    outside = net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 0
    nowhere = foe_behind == NOWHERE
    if nowhere and not outside:
        return False, 0.0
    lane = net.conflict_ints[row, CONFLICT_LANE]
    in_front = state.ints[w, LANE] == lane
    back_left = net.lane_floats[lane, LANE_LENGTH] - foe_behind - back_on(net, traffic, state, w, lane)
    swing = _swing(traffic, v, net.conflict_floats[row, CONFLICT_RADIUS])
    past = back_left + foe_size + swing < 0.0 and not nowhere
    entered = back_left < traffic.floats[w, LENGTH]
    in_the_way = (to_conflict > 0.0 and not past and entered) or (
        kind == MERGING and to_conflict > back_left - traffic.floats[w, LENGTH] and entered
    )
    if kind != MERGING and past:
        return False, 0.0
    if kind == CROSSING and in_front and not in_the_way and state.ints[w, WILL_PASS] == 0:
        return False, 0.0
    if not (outside or in_the_way or _goes_first(net, state, v, w, link, row)):
        return False, 0.0
    gap = to_conflict - traffic.floats[v, MIN_GAP] - back_left
    if kind == CROSSING:
        if nowhere or net.conflict_ints[row, CONFLICT_FOE_WAITS] == 1:
            return True, -1.0
        gap -= foe_size
    return True, gap


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
def is_lingering(net, state, link):  # type: ignore[no-untyped-def]
    """Whether those on the way before ``link`` came into the junction by a signal that is red now."""
    return state.link_letter[net.link_ints[link, LINK_ENTRY]] == RED


@compiled
def is_protected(net, state, link):  # type: ignore[no-untyped-def]
    """Whether ``link`` is a waiting point behind a signal that gives priority now: nobody need wait there."""
    entry = net.link_ints[link, LINK_ENTRY]
    return entry != link and net.link_ints[entry, LINK_PROGRAM] >= 0 and is_major(state.link_letter[entry])


@compiled
def _goes_first(net, state, v, w, link, row):  # type: ignore[no-untyped-def]
    """Return whether vehicle ``w``, inside the junction, goes before vehicle ``v``."""
    own, foe = state.ints[v, JUNCTION_MS], state.ints[w, CONFLICT_MS]
    if net.conflict_ints[row, CONFLICT_KIND] == PARTING:
        foe = state.ints[w, JUNCTION_MS]
    if net.conflict_ints[row, CONFLICT_YIELDS] and state.ints[v, CONFLICT_MS] == NEVER_MS:
        # At a waiting point one goes after everybody, but leaves before those whose signal has changed to green.
        lingers = net.conflict_ints[row, CONFLICT_FOE_YIELDS] and is_lingering(net, state, link)
        own = own if lingers else NEVER_MS
    if own != foe:
        return own > foe
    if state.floats[v, SPEED] != state.floats[w, SPEED]:
        return state.floats[v, SPEED] < state.floats[w, SPEED]
    return _named_before(v, w)


@compiled
def _named_before(v, w):  # type: ignore[no-untyped-def]
    """Return whether the decimal name of ``v`` sorts before that of ``w``."""
    one, other = v, w
    while one >= 10 * max(other, 1) or (one >= 10 and other < 10):
        one //= 10
    while other >= 10 * max(one, 1) or (other >= 10 and one < 10):
        other //= 10
    # Now both have the same number of digits, or one begins the other.
    return one < other or (one == other and v < w)


@compiled
def pass_link(net, state, v, link):  # type: ignore[no-untyped-def]
    """Note that the front of vehicle ``v`` passed ``link`` in this step."""
    ints = state.ints
    inside_before = net.lane_ints[net.link_ints[link, LINK_FROM], LANE_INSIDE] == 1
    inside_after = net.lane_ints[net.link_ints[link, LINK_NEXT], LANE_INSIDE] == 1
    now_ms = state.clock[NOW_MS]
    if not inside_before and inside_after:
        ints[v, JUNCTION_MS] = now_ms
    if inside_after and (inside_before or not net.link_ints[link, LINK_CONT]):
        ints[v, CONFLICT_MS] = now_ms
    if not inside_after:
        ints[v, JUNCTION_MS] = ints[v, CONFLICT_MS] = NEVER_MS


@compiled
def note_request(net, state, v):  # type: ignore[no-untyped-def]
    """Note whether vehicle ``v``, if it is inside a junction now, asked to pass the link at the end of its lane."""
    lane = state.ints[v, LANE]
    if net.lane_ints[lane, LANE_INSIDE] == 0:
        return
    state.ints[v, WILL_PASS] = 0
    first = state.ints[v, FIRST_ITEM]
    for item in range(first, first + state.ints[v, ITEMS]):
        link = state.item_ints[item, ITEM_LINK]
        if link >= 0 and net.link_ints[link, LINK_FROM] == lane:
            state.ints[v, WILL_PASS] = state.item_ints[item, ITEM_REQUEST]


@compiled
def may_pass(net, traffic, state, item, step_ms):  # type: ignore[no-untyped-def]
    """Return whether the vehicle of ``item`` may pass its link in this step, foes considered."""
    numbers = state.item_ints[item]
    link, v = numbers[ITEM_LINK], numbers[ITEM_VEHICLE]
    letter = state.link_letter[link]
    if letter == RED:
        return False
    if is_major(letter) or net.link_ints[link, LINK_CONT] or is_protected(net, state, link):
        return True
    if letter == STOP and state.ints[v, STOOD_FOR] != link and state.ints[v, WAITING_MS] == 0:
        return False
    # Who was let pass after standing may go on; who was not must stand again.
    state.ints[v, STOOD_FOR] = -1
    if net.wait_count[link] > 0:
        first = net.wait_first[link]
        for k in range(first, first + net.wait_count[link]):
            if _blocks(net, traffic, state, item, net.wait_foes[k]):
                return False
    else:
        first = net.link_ints[link, LINK_FIRST_RESPONSE]
        for k in range(first, first + net.link_ints[link, LINK_RESPONSES]):
            if _blocks(net, traffic, state, item, net.responses[k]):
                return False
    if letter == STOP and state.item_floats[item, ITEM_DISTANCE] <= VISIBILITY_M:
        state.ints[v, STOOD_FOR] = link
    return True


@compiled
def _blocks(net, traffic, state, item, foe_link):  # type: ignore[no-untyped-def]
    """Return whether a vehicle that approaches ``foe_link`` keeps the one of ``item`` from passing."""
    foe = state.link_first[foe_link]
    link, v = state.item_ints[item, ITEM_LINK], state.item_ints[item, ITEM_VEHICLE]
    merging = net.link_ints[link, LINK_TO] == net.link_ints[foe_link, LINK_TO]
    # Who lingers inside the junction does not wait for those who stand.
    lingers = net.link_ints[link, LINK_ENTRY] != link and is_lingering(net, state, link)
    while foe >= 0:
        w = state.item_ints[foe, ITEM_VEHICLE]
        no_foe = w == v or (lingers and state.floats[w, SPEED] <= STANDING_MPS)
        if not no_foe and state.item_ints[foe, ITEM_REQUEST] and _meets(traffic, state, item, foe, merging):
            return True
        foe = state.item_ints[foe, ITEM_NEXT]
    return False


@compiled
def _meets(traffic, state, item, foe, merging):  # type: ignore[no-untyped-def]
    """Return whether the passages of two items come too close; ``merging`` if both lead to one lane."""
    own, other = state.item_ints[item], state.item_ints[foe]
    v, w = own[ITEM_VEHICLE], other[ITEM_VEHICLE]
    arrival, leave = own[ITEM_ARRIVAL_MS], own[ITEM_LEAVE_MS]
    if other[ITEM_LEAVE_MS] < arrival:
        return merging and (
            arrival - other[ITEM_LEAVE_MS] < MARGIN_MS
            or _unsafe(
                state.item_floats[foe, ITEM_LEAVE_SPEED],
                traffic.floats[w, DECEL],
                state.item_floats[item, ITEM_ARRIVAL_SPEED],
                traffic.floats[v, DECEL],
            )
        )
    foe_arrival, foe_speed = float(other[ITEM_ARRIVAL_MS]), state.item_floats[foe, ITEM_BRAKED_SPEED]
    impatience = min(1.0, state.ints[v, WAITING_MS] / IMPATIENT_AFTER_MS)
    if impatience > 0.0 and foe_arrival > arrival:
        later_s, foe_speed = _braking_for(
            0.001 * (foe_arrival - arrival),
            state.item_floats[foe, ITEM_ARRIVAL_SPEED],
            impatience * traffic.floats[w, DECEL],
        )
        foe_arrival += 1000.0 * later_s
    if foe_arrival > leave + MARGIN_MS:
        return merging and _unsafe(
            state.item_floats[item, ITEM_LEAVE_SPEED],
            traffic.floats[v, DECEL],
            foe_speed,
            traffic.floats[w, DECEL],
        )
    return True


@compiled
def _braking_for(ahead_s, speed, decel):  # type: ignore[no-untyped-def]
    """Return how much later (s) and how fast (m/s) a vehicle arrives that brakes from ``ahead_s`` before its arrival.

    Args:
        speed: with which it would arrive. decel: how hard it brakes for someone who has waited for long.
    """
    slowed = speed - decel * ahead_s
    missing_m = 0.5 * decel * ahead_s * ahead_s
    rest = slowed * slowed - 2.0 * decel * missing_m
    if slowed <= 0.0 or rest <= 0.0:
        return NEVER_LATER_S, 0.0
    arrival_speed = math.sqrt(rest)
    return (slowed - arrival_speed) / decel, arrival_speed


@compiled
def _unsafe(leader_mps, leader_decel, follower_mps, follower_decel):  # type: ignore[no-untyped-def]
    """Return whether a follower at the same place would need more room to stop than its leader."""
    return leader_mps * leader_mps / leader_decel <= follower_mps * follower_mps / follower_decel


@compiled
def keep_clear(net, traffic, state, v):  # type: ignore[no-untyped-def]
    """Leave the items as they are."""
