"""Keep clear: a vehicle requests a link only if there is room beyond the junction."""

from __future__ import annotations

import math

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import brake_gap
from izoo.envs.twin.driving.lane_queues import last_vehicle
from izoo.envs.twin.driving.tolerances import POSITION_EPS, STANDING_MPS


@compiled
def keep_clear(net, traffic, state, v, in_front_m, step_s):  # type: ignore[no-untyped-def]
    """Withdraw the requests of vehicle ``v`` for links beyond which it would have to stop inside the junction.

    Args:
        in_front_m: room needed by the vehicles ahead of it on its lane.
    """
    first, count = state.vehicles[v].first_item, state.vehicles[v].items
    stands = _measure_space(net, traffic, state, v, in_front_m, step_s)
    for item in range(first + count - 1, first, -1):
        if not _leaves(net, state, item):
            state.items[item - 1].space = min(state.items[item - 1].space, 0.0)
        elif not stands:
            state.items[item - 1].space = math.inf
        else:
            state.items[item - 1].space = state.items[item].space
    if not stands:
        state.items[first + count - 1].space = math.inf
    need = traffic.drivers[v].length + traffic.drivers[v].min_gap
    blocked = -1
    for item in range(first, first + count):
        link = state.items[item].link
        if link < 0 or state.items[item].space >= need:
            continue
        # Where no link crosses, a vehicle may stop inside, if it requests to leave.
        if net.links[link].foes > 0 or (item + 1 < first + count and not _leaves(net, state, item + 1)):
            blocked = item
            break
    if blocked < 0 or (blocked == first and net.lanes[state.vehicles[v].lane].inside == 1):
        return
    braking = brake_gap(state.vehicles[v].speed, traffic.drivers[v].decel, 0.0, step_s) + POSITION_EPS
    for item in range(blocked, first + count):
        planned = state.items[item]
        link = planned.link
        if link < 0:
            break
        planned.pass_speed = planned.wait_speed
        leaves = net.lanes[net.links[link].from_lane].inside == 1 and net.links[link].via_lane < 0
        entered = item > first and state.items[item - 1].request == 1
        if planned.distance >= braking and not (leaves and entered):
            planned.request = 0


@compiled
def _leaves(net, state, item):  # type: ignore[no-untyped-def]
    """Whether a vehicle past the link of the item before would request to leave the junction by that of ``item``."""
    link, onward = state.items[item - 1].link, state.items[item].link
    return net.links[link].via_lane < 0 or onward < 0 or state.items[item].request == 1


@compiled
def _measure_space(net, traffic, state, v, in_front_m, step_s):  # type: ignore[no-untyped-def]
    """Write the room (m) up to the first stopped vehicle beyond each link; return whether there is one."""
    first, count = state.vehicles[v].first_item, state.vehicles[v].items
    space = -in_front_m
    stopped = False
    for item in range(first, first + count):
        link = state.items[item].link
        if link < 0 or stopped:
            state.items[item].space = space
            continue
        inside, lane = net.links[link].via_lane, net.links[link].to_lane
        waiting_point = inside >= 0 and net.lanes[net.links[link].from_lane].inside == 1
        if inside >= 0 and (waiting_point or net.links[link].foes > 0):
            u = state.lanes[inside].back
            while u >= 0:
                space -= traffic.drivers[u].length + traffic.drivers[u].min_gap
                u = state.vehicles[u].ahead
            if inside == state.vehicles[v].lane:
                space += traffic.drivers[v].length + traffic.drivers[v].min_gap
        elif inside >= 0:
            room, found = _free_space(net, traffic, state, inside, v, step_s)
            space += room
            stopped = stopped or found
        else:
            last = last_vehicle(net, traffic, state, lane, -1)
            if last < 0 or last == v:
                if net.lanes[lane].length > traffic.drivers[v].length or net.links[link].foes > 0:
                    space += net.lanes[lane].length
            else:
                room, found = _free_space(net, traffic, state, lane, v, step_s)
                space += room
                stopped = found or state.vehicles[last].has_to_wait == 1
        state.items[item].space = space
    return stopped


@compiled
def _free_space(net, traffic, state, lane, v, step_s):  # type: ignore[no-untyped-def]
    """Return the room (m) on ``lane`` up to the first stopped vehicle, less that of moving ones; if there is one."""
    taken = 0.0
    u = state.lanes[lane].back
    while u >= 0:
        driver = traffic.drivers[u]
        speed = state.vehicles[u].speed
        if speed < STANDING_MPS and u != v:
            braking = brake_gap(speed, driver.decel, driver.tau, step_s)
            return state.vehicles[u].position - driver.length + braking - taken, True
        taken += driver.length + driver.min_gap
        u = state.vehicles[u].ahead
    return net.lanes[lane].length - taken, False
