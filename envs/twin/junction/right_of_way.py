"""Right of way: gap acceptance at links, red lights, and stops.

The rules were found by probing SUMO with two and three vehicles that meet (see the tests); ``sumo --link-output`` and
``getJunctionFoes`` print their inputs.
"""

from __future__ import annotations

import math

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.tolerances import STANDING_MPS, VISIBILITY_M
from izoo.envs.twin.driving.traffic_lights import RED, STOP, YELLOW, is_major
from izoo.envs.twin.runtime.layout import NEVER_MS

MARGIN_MS = 1000
"""Least time between the passages of two vehicles in conflict."""
IMPATIENT_AFTER_MS = 180_000.0
NEVER_LATER_S = 30.0
"""Delay of a vehicle that would stop instead of passing."""


@compiled
def entered_on_red(net, state, link):  # type: ignore[no-untyped-def]
    """Whether vehicles on the way before ``link`` entered the junction by a signal that is red now."""
    return state.link_letter[net.links[link].entry] == RED


@compiled
def is_protected(net, state, link):  # type: ignore[no-untyped-def]
    """Whether ``link`` is a waiting point behind a signal that gives priority now, so that vehicles need not wait."""
    entry = net.links[link].entry
    return entry != link and net.links[entry].program >= 0 and is_major(state.link_letter[entry])


@compiled
def slows_before(net, state, link):  # type: ignore[no-untyped-def]
    """Whether a vehicle slows down before ``link`` until it sees all foes: not behind a yellow signal."""
    if is_major(state.link_letter[link]) or is_protected(net, state, link):
        return False
    entry = net.links[link].entry
    return entry == link or state.link_letter[entry] != YELLOW


@compiled
def pass_link(net, state, v, link):  # type: ignore[no-untyped-def]
    """Record that the front of vehicle ``v`` passed ``link`` in this step."""
    vehicles = state.vehicles
    inside_before = net.lanes[net.links[link].from_lane].inside == 1
    inside_after = net.lanes[net.links[link].next_lane].inside == 1
    now_ms = state.clock.now_ms
    if not inside_before and inside_after:
        vehicles[v].entered_ms = vehicles[v].junction_ms = now_ms
    if inside_after and (inside_before or not net.links[link].cont):
        vehicles[v].conflict_ms = now_ms
        # A vehicle that had lost its right of way has it again.
        vehicles[v].junction_ms = min(vehicles[v].junction_ms, now_ms)
    if not inside_after:
        vehicles[v].entered_ms = vehicles[v].junction_ms = vehicles[v].conflict_ms = NEVER_MS


@compiled
def lose_right_of_way(net, state, v, link):  # type: ignore[no-untyped-def]
    """Take the right of way from ``v``, which does not request ``link``, if both are inside the same junction."""
    lane, before = state.vehicles[v].lane, net.links[link].from_lane
    inside = net.lanes[lane].inside == 1 and net.lanes[before].inside == 1
    if inside and net.lanes[lane].junction == net.lanes[before].junction:
        state.vehicles[v].junction_ms = state.vehicles[v].conflict_ms = NEVER_MS


@compiled
def note_request(net, state, v):  # type: ignore[no-untyped-def]
    """Record whether vehicle ``v``, if inside a junction, requested to pass the link at the end of its lane."""
    lane = state.vehicles[v].lane
    if net.lanes[lane].inside == 0:
        return
    state.vehicles[v].will_pass = 0
    first = state.vehicles[v].first_item
    for item in range(first, first + state.vehicles[v].items):
        link = state.items[item].link
        if link >= 0 and net.links[link].from_lane == lane:
            state.vehicles[v].will_pass = state.items[item].request


@compiled
def may_pass(net, traffic, state, item, step_ms):  # type: ignore[no-untyped-def]
    """Return whether the vehicle of ``item`` may pass its link in this step, foes considered."""
    planned = state.items[item]
    link, v = planned.link, planned.vehicle
    letter = state.link_letter[link]
    if letter == RED:
        return False
    if is_major(letter) or net.links[link].cont or is_protected(net, state, link):
        return True
    if letter == STOP and state.vehicles[v].stood_for != link and state.vehicles[v].waiting_ms == 0:
        return False
    # A vehicle that stopped and was not allowed to pass must stop again.
    state.vehicles[v].stood_for = -1
    if net.links[link].waits > 0:
        first = net.links[link].first_wait
        for k in range(first, first + net.links[link].waits):
            if _blocks(net, traffic, state, item, net.wait_foes[k], step_ms):
                return False
    else:
        first = net.links[link].first_response
        for k in range(first, first + net.links[link].responses):
            if _blocks(net, traffic, state, item, net.responses[k], step_ms):
                return False
    if letter == STOP and planned.distance <= VISIBILITY_M:
        state.vehicles[v].stood_for = link
    return True


@compiled
def _blocks(net, traffic, state, item, foe_link, step_ms):  # type: ignore[no-untyped-def]
    """Return whether a vehicle that approaches ``foe_link`` keeps the one of ``item`` from passing."""
    foe = state.link_first[foe_link]
    link, v = state.items[item].link, state.items[item].vehicle
    merging = net.links[link].to_lane == net.links[foe_link].to_lane
    # A vehicle left over inside the junction does not wait for stopped ones.
    left_over = net.links[link].entry != link and entered_on_red(net, state, link)
    while foe >= 0:
        w = state.items[foe].vehicle
        no_foe = w == v or (left_over and state.vehicles[w].speed <= STANDING_MPS)
        if not no_foe and state.items[foe].request and _meets(traffic, state, item, foe, merging, step_ms):
            return True
        foe = state.items[foe].next
    return False


@compiled
def _meets(traffic, state, item, foe, merging, step_ms):  # type: ignore[no-untyped-def]
    """Return whether the passages of two items are too close in time; ``merging`` if both lead to one lane."""
    own, other = state.items[item], state.items[foe]
    v, w = own.vehicle, other.vehicle
    arrival, leave = own.arrival_ms, own.leave_ms
    if other.leave_ms < arrival:
        return merging and (
            arrival - other.leave_ms < MARGIN_MS
            or _unsafe_merge(other.leave_speed, traffic.drivers[w].decel, own.arrival_speed, traffic.drivers[v].decel)
        )
    foe_arrival, foe_speed = float(other.arrival_ms), other.braked_speed
    impatience = min(1.0, state.vehicles[v].waiting_ms / IMPATIENT_AFTER_MS)
    if impatience > 0.0 and foe_arrival > arrival:
        # The foe is assumed to approach at constant speed, and to brake when the vehicle arrives.
        now = state.clock.now_ms - step_ms
        foe_speed = other.distance / (0.001 * (foe_arrival - now))
        way = 0.001 * (foe_arrival - arrival) * foe_speed
        steps = (arrival - now) // step_ms
        room = other.distance - 0.001 * steps * step_ms * foe_speed
        braking_s, foe_speed = _braked_arrival(way, room, foe_speed, impatience * traffic.drivers[w].decel)
        braked = (arrival if braking_s < NEVER_LATER_S else foe_arrival) + 1000.0 * braking_s
        foe_arrival += impatience * (braked - foe_arrival)
    if foe_arrival > leave + MARGIN_MS:
        return merging and _unsafe_merge(own.leave_speed, traffic.drivers[v].decel, foe_speed, traffic.drivers[w].decel)
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
