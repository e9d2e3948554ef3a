"""Right of way: gap acceptance at links, red lights, and stops.

The rules were found by probing SUMO with two and three vehicles that meet (see the tests); ``sumo --link-output`` and
``getJunctionFoes`` print their inputs.
"""

from __future__ import annotations

import math

from izoo.envs.twin.driving.tolerances import STANDING_MPS, VISIBILITY_M
from izoo.envs.twin.driving.traffic_lights import RED, STOP, YELLOW, is_major
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    CONFLICT_MS,
    DECEL,
    ENTERED_MS,
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
    LANE_INSIDE,
    LANE_JUNCTION,
    LINK_CONT,
    LINK_ENTRY,
    LINK_FIRST_RESPONSE,
    LINK_FROM,
    LINK_NEXT,
    LINK_PROGRAM,
    LINK_RESPONSES,
    LINK_TO,
    NEVER_MS,
    NOW_MS,
    SPEED,
    STOOD_FOR,
    WAITING_MS,
    WILL_PASS,
)

MARGIN_MS = 1000
"""Least time between the passages of two vehicles in conflict."""
IMPATIENT_AFTER_MS = 180_000.0
NEVER_LATER_S = 30.0
"""Delay of a vehicle that would stop instead of passing."""


@compiled
def entered_on_red(net, state, link):  # type: ignore[no-untyped-def]
    """Whether vehicles on the way before ``link`` entered the junction by a signal that is red now."""
    return state.link_letter[net.link_ints[link, LINK_ENTRY]] == RED


@compiled
def is_protected(net, state, link):  # type: ignore[no-untyped-def]
    """Whether ``link`` is a waiting point behind a signal that gives priority now, so that vehicles need not wait."""
    entry = net.link_ints[link, LINK_ENTRY]
    return entry != link and net.link_ints[entry, LINK_PROGRAM] >= 0 and is_major(state.link_letter[entry])


@compiled
def slows_before(net, state, link):  # type: ignore[no-untyped-def]
    """Whether a vehicle slows down before ``link`` until it sees all foes: not behind a yellow signal."""
    if is_major(state.link_letter[link]) or is_protected(net, state, link):
        return False
    entry = net.link_ints[link, LINK_ENTRY]
    return entry == link or state.link_letter[entry] != YELLOW


@compiled
def pass_link(net, state, v, link):  # type: ignore[no-untyped-def]
    """Record that the front of vehicle ``v`` passed ``link`` in this step."""
    ints = state.ints
    inside_before = net.lane_ints[net.link_ints[link, LINK_FROM], LANE_INSIDE] == 1
    inside_after = net.lane_ints[net.link_ints[link, LINK_NEXT], LANE_INSIDE] == 1
    now_ms = state.clock[NOW_MS]
    if not inside_before and inside_after:
        ints[v, ENTERED_MS] = ints[v, JUNCTION_MS] = now_ms
    if inside_after and (inside_before or not net.link_ints[link, LINK_CONT]):
        ints[v, CONFLICT_MS] = now_ms
        # A vehicle that had lost its right of way has it again.
        ints[v, JUNCTION_MS] = min(ints[v, JUNCTION_MS], now_ms)
    if not inside_after:
        ints[v, ENTERED_MS] = ints[v, JUNCTION_MS] = ints[v, CONFLICT_MS] = NEVER_MS


@compiled
def lose_right_of_way(net, state, v, link):  # type: ignore[no-untyped-def]
    """Take the right of way from ``v``, which does not request ``link``, if both are inside the same junction."""
    lane, before = state.ints[v, LANE], net.link_ints[link, LINK_FROM]
    inside = net.lane_ints[lane, LANE_INSIDE] == 1 and net.lane_ints[before, LANE_INSIDE] == 1
    if inside and net.lane_ints[lane, LANE_JUNCTION] == net.lane_ints[before, LANE_JUNCTION]:
        state.ints[v, JUNCTION_MS] = state.ints[v, CONFLICT_MS] = NEVER_MS


@compiled
def note_request(net, state, v):  # type: ignore[no-untyped-def]
    """Record whether vehicle ``v``, if inside a junction, requested to pass the link at the end of its lane."""
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
    # A vehicle that stopped and was not allowed to pass must stop again.
    state.ints[v, STOOD_FOR] = -1
    if net.wait_count[link] > 0:
        first = net.wait_first[link]
        for k in range(first, first + net.wait_count[link]):
            if _blocks(net, traffic, state, item, net.wait_foes[k], step_ms):
                return False
    else:
        first = net.link_ints[link, LINK_FIRST_RESPONSE]
        for k in range(first, first + net.link_ints[link, LINK_RESPONSES]):
            if _blocks(net, traffic, state, item, net.responses[k], step_ms):
                return False
    if letter == STOP and state.item_floats[item, ITEM_DISTANCE] <= VISIBILITY_M:
        state.ints[v, STOOD_FOR] = link
    return True


@compiled
def _blocks(net, traffic, state, item, foe_link, step_ms):  # type: ignore[no-untyped-def]
    """Return whether a vehicle that approaches ``foe_link`` keeps the one of ``item`` from passing."""
    foe = state.link_first[foe_link]
    link, v = state.item_ints[item, ITEM_LINK], state.item_ints[item, ITEM_VEHICLE]
    merging = net.link_ints[link, LINK_TO] == net.link_ints[foe_link, LINK_TO]
    # A vehicle left over inside the junction does not wait for stopped ones.
    left_over = net.link_ints[link, LINK_ENTRY] != link and entered_on_red(net, state, link)
    while foe >= 0:
        w = state.item_ints[foe, ITEM_VEHICLE]
        no_foe = w == v or (left_over and state.floats[w, SPEED] <= STANDING_MPS)
        if not no_foe and state.item_ints[foe, ITEM_REQUEST] and _meets(traffic, state, item, foe, merging, step_ms):
            return True
        foe = state.item_ints[foe, ITEM_NEXT]
    return False


@compiled
def _meets(traffic, state, item, foe, merging, step_ms):  # type: ignore[no-untyped-def]
    """Return whether the passages of two items are too close in time; ``merging`` if both lead to one lane."""
    own, other = state.item_ints[item], state.item_ints[foe]
    v, w = own[ITEM_VEHICLE], other[ITEM_VEHICLE]
    arrival, leave = own[ITEM_ARRIVAL_MS], own[ITEM_LEAVE_MS]
    if other[ITEM_LEAVE_MS] < arrival:
        return merging and (
            arrival - other[ITEM_LEAVE_MS] < MARGIN_MS
            or _unsafe_merge(
                state.item_floats[foe, ITEM_LEAVE_SPEED],
                traffic.floats[w, DECEL],
                state.item_floats[item, ITEM_ARRIVAL_SPEED],
                traffic.floats[v, DECEL],
            )
        )
    foe_arrival, foe_speed = float(other[ITEM_ARRIVAL_MS]), state.item_floats[foe, ITEM_BRAKED_SPEED]
    impatience = min(1.0, state.ints[v, WAITING_MS] / IMPATIENT_AFTER_MS)
    if impatience > 0.0 and foe_arrival > arrival:
        # The foe is assumed to approach at constant speed, and to brake when the vehicle arrives.
        now = state.clock[NOW_MS] - step_ms
        foe_speed = state.item_floats[foe, ITEM_DISTANCE] / (0.001 * (foe_arrival - now))
        way = 0.001 * (foe_arrival - arrival) * foe_speed
        steps = (arrival - now) // step_ms
        room = state.item_floats[foe, ITEM_DISTANCE] - 0.001 * steps * step_ms * foe_speed
        braking_s, foe_speed = _braked_arrival(way, room, foe_speed, impatience * traffic.floats[w, DECEL])
        braked = (arrival if braking_s < NEVER_LATER_S else foe_arrival) + 1000.0 * braking_s
        foe_arrival += impatience * (braked - foe_arrival)
    if foe_arrival > leave + MARGIN_MS:
        return merging and _unsafe_merge(
            state.item_floats[item, ITEM_LEAVE_SPEED],
            traffic.floats[v, DECEL],
            foe_speed,
            traffic.floats[w, DECEL],
        )
    return True


@compiled
def _braked_arrival(way, room, speed, decel):  # type: ignore[no-untyped-def]
    """Return the arrival time (s) and speed (m/s) of a vehicle that brakes for one that has waited for long.

    Args:
        way: distance (m). room: the same from the last whole step before it brakes, to check whether it could stop.
        speed: initial speed. decel: its deceleration.
    """
    if speed * speed <= 2.0 * decel * room:
        return NEVER_LATER_S, 0.0
    arrival_speed = math.sqrt(max(0.0, speed * speed - 2.0 * decel * way))
    return (speed - arrival_speed) / decel, arrival_speed


@compiled
def _unsafe_merge(leader_mps, leader_decel, follower_mps, follower_decel):  # type: ignore[no-untyped-def]
    """Return whether a follower at the same place would need more room to stop than its leader."""
    return leader_mps * leader_mps / leader_decel <= follower_mps * follower_mps / follower_decel
