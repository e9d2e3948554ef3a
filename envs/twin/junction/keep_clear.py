"""Keep clear: a vehicle requests a link only if there is room beyond the junction."""

from __future__ import annotations

import math

from izoo.envs.twin.driving.car_following import brake_gap
from izoo.envs.twin.driving.lane_queues import last_vehicle
from izoo.envs.twin.driving.tolerances import POSITION_EPS, STANDING_MPS
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    AHEAD,
    DECEL,
    FIRST_ITEM,
    HAS_TO_WAIT,
    ITEM_DISTANCE,
    ITEM_LINK,
    ITEM_PASS,
    ITEM_REQUEST,
    ITEM_SPACE,
    ITEM_WAIT,
    ITEMS,
    LANE,
    LANE_BACK,
    LANE_INSIDE,
    LANE_LENGTH,
    LENGTH,
    LINK_FOES,
    LINK_FROM,
    LINK_TO,
    LINK_VIA,
    MIN_GAP,
    POSITION,
    SPEED,
    TAU,
)


@compiled
def keep_clear(net, traffic, state, v, in_front_m, step_s):  # type: ignore[no-untyped-def]
    """Withdraw the requests of vehicle ``v`` for links beyond which it would have to stop inside the junction.

    Args:
        in_front_m: room needed by the vehicles ahead of it on its lane.
    """
    first, count = state.ints[v, FIRST_ITEM], state.ints[v, ITEMS]
    stands = _measure_space(net, traffic, state, v, in_front_m, step_s)
    for item in range(first + count - 1, first, -1):
        if not _leaves(net, state, item):
            state.item_floats[item - 1, ITEM_SPACE] = min(state.item_floats[item - 1, ITEM_SPACE], 0.0)
        elif not stands:
            state.item_floats[item - 1, ITEM_SPACE] = math.inf
        else:
            state.item_floats[item - 1, ITEM_SPACE] = state.item_floats[item, ITEM_SPACE]
    if not stands:
        state.item_floats[first + count - 1, ITEM_SPACE] = math.inf
    need = traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
    blocked = -1
    for item in range(first, first + count):
        link = state.item_ints[item, ITEM_LINK]
        if link < 0 or state.item_floats[item, ITEM_SPACE] >= need:
            continue
        # Where no link crosses, a vehicle may stop inside, if it requests to leave.
        if net.link_ints[link, LINK_FOES] > 0 or (item + 1 < first + count and not _leaves(net, state, item + 1)):
            blocked = item
            break
    if blocked < 0 or (blocked == first and net.lane_ints[state.ints[v, LANE], LANE_INSIDE] == 1):
        return
    braking = brake_gap(state.floats[v, SPEED], traffic.floats[v, DECEL], 0.0, step_s) + POSITION_EPS
    for item in range(blocked, first + count):
        values, link = state.item_floats[item], state.item_ints[item, ITEM_LINK]
        if link < 0:
            break
        values[ITEM_PASS] = values[ITEM_WAIT]
        leaves = net.lane_ints[net.link_ints[link, LINK_FROM], LANE_INSIDE] == 1 and net.link_ints[link, LINK_VIA] < 0
        entered = item > first and state.item_ints[item - 1, ITEM_REQUEST] == 1
        if values[ITEM_DISTANCE] >= braking and not (leaves and entered):
            state.item_ints[item, ITEM_REQUEST] = 0


@compiled
def _leaves(net, state, item):  # type: ignore[no-untyped-def]
    """Whether a vehicle past the link of the item before would request to leave the junction by that of ``item``."""
    link, onward = state.item_ints[item - 1, ITEM_LINK], state.item_ints[item, ITEM_LINK]
    return net.link_ints[link, LINK_VIA] < 0 or onward < 0 or state.item_ints[item, ITEM_REQUEST] == 1


@compiled
def _measure_space(net, traffic, state, v, in_front_m, step_s):  # type: ignore[no-untyped-def]
    """Write the room (m) up to the first stopped vehicle beyond each link; return whether there is one."""
    first, count = state.ints[v, FIRST_ITEM], state.ints[v, ITEMS]
    space = -in_front_m
    stopped = False
    for item in range(first, first + count):
        link = state.item_ints[item, ITEM_LINK]
        if link < 0 or stopped:
            state.item_floats[item, ITEM_SPACE] = space
            continue
        inside, lane = net.link_ints[link, LINK_VIA], net.link_ints[link, LINK_TO]
        waiting_point = inside >= 0 and net.lane_ints[net.link_ints[link, LINK_FROM], LANE_INSIDE] == 1
        if inside >= 0 and (waiting_point or net.link_ints[link, LINK_FOES] > 0):
            u = state.lanes[inside, LANE_BACK]
            while u >= 0:
                space -= traffic.floats[u, LENGTH] + traffic.floats[u, MIN_GAP]
                u = state.ints[u, AHEAD]
            if inside == state.ints[v, LANE]:
                space += traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
        elif inside >= 0:
            room, found = _free_space(net, traffic, state, inside, v, step_s)
            space += room
            stopped = stopped or found
        else:
            last = last_vehicle(net, traffic, state, lane, -1)
            if last < 0 or last == v:
                if net.lane_floats[lane, LANE_LENGTH] > traffic.floats[v, LENGTH] or net.link_ints[link, LINK_FOES] > 0:
                    space += net.lane_floats[lane, LANE_LENGTH]
            else:
                room, found = _free_space(net, traffic, state, lane, v, step_s)
                space += room
                stopped = found or state.ints[last, HAS_TO_WAIT] == 1
        state.item_floats[item, ITEM_SPACE] = space
    return stopped


@compiled
def _free_space(net, traffic, state, lane, v, step_s):  # type: ignore[no-untyped-def]
    """Return the room (m) on ``lane`` up to the first stopped vehicle, less that of moving ones; if there is one."""
    taken = 0.0
    u = state.lanes[lane, LANE_BACK]
    while u >= 0:
        driver = traffic.floats[u]
        speed = state.floats[u, SPEED]
        if speed < STANDING_MPS and u != v:
            braking = brake_gap(speed, driver[DECEL], driver[TAU], step_s)
            return state.floats[u, POSITION] - driver[LENGTH] + braking - taken, True
        taken += driver[LENGTH] + driver[MIN_GAP]
        u = state.ints[u, AHEAD]
    return net.lane_floats[lane, LANE_LENGTH] - taken, False
