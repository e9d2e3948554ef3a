"""One step of one environment, in SUMO's order."""

from __future__ import annotations

import numpy as np

from izoo.envs.mdp.commands import TOP_SPEED_MPS
from izoo.envs.tables import compiled
from izoo.envs.twin.driving.active_lanes import activate_occupied, deactivate_empty
from izoo.envs.twin.driving.insertion import insert_vehicles
from izoo.envs.twin.driving.lane_queues import insert_into_lane
from izoo.envs.twin.driving.link_planning import plan, register_approaches
from izoo.envs.twin.driving.movement import drive
from izoo.envs.twin.driving.traffic_lights import reset_signals, update_signals
from izoo.envs.twin.junction.keep_clear import keep_clear
from izoo.envs.twin.lane_change.cooperation import clear_advice
from izoo.envs.twin.lane_change.execution import change_lanes, read_lane_command
from izoo.envs.twin.runtime.layout import (
    MAX_ADVICES,
    MAX_ITEMS_PER_VEHICLE,
    MAX_LANES_SEEN,
    MAX_TAIL_LANES,
    NEVER_MS,
    NOT_ACTIVE,
    STATE,
    TwinNet,
    TwinState,
    TwinTraffic,
    open_net,
    open_state,
    open_traffic,
)
from izoo.envs.twin.runtime.prefetch import fetch_some, lines_for_each
from izoo.envs.twin.runtime.scratch import Desk, Shapes, zeros


def state_shapes(net: TwinNet, traffic: TwinTraffic) -> tuple[Shapes, Shapes]:
    """Return the shapes of a state's lasting arrays, in the order of their memory, and of its working memory."""
    lanes, links, count = len(net.lanes), len(net.links), len(traffic.drivers)
    items = MAX_ITEMS_PER_VEHICLE * (count + 1)
    seen = net.edges["lanes"][net.edges["inside"] != 0]
    lasting: Shapes = {
        "clock": (),
        "lanes": lanes,
        "tails": (lanes, MAX_TAIL_LANES),
        "waiting_first": lanes,
        "waiting_last": lanes,
        "link_letter": links,
        "program_switch_ms": len(net.programs),
        "active": lanes,
        # From here on rows are vehicles.
        "vehicles": count,
        "tail_lane": (count, MAX_TAIL_LANES),
        "waiting_next": count,
        "advice": (count, MAX_ADVICES),
        "room_seen": (count, min(int(seen.max(initial=1)), MAX_LANES_SEEN)),
    }
    working: Shapes = {
        "link_first": links,
        "items": items,
        "changer": lanes,
        "changer_density": lanes,
        "changer_queue": 32,
        "changer_way": 32,
        "lane_room": lanes,
        "lane_room_before": lanes,
        "moved": count,
    }
    return lasting, working


def new_state(net: TwinNet, traffic: TwinTraffic, desk: Desk) -> TwinState:
    """Return the state at the beginning of an episode, without vehicles on the road.

    Args:
        net, traffic: of the episode.
        desk: working memory.
    """
    lasting, working = state_shapes(net, traffic)
    state = TwinState(**zeros(STATE, lasting), **desk.spread(STATE, working))
    for name in ("tail_lane", "tails", "waiting_first", "waiting_last", "waiting_next"):
        getattr(state, name)[:] = -1
    state.vehicles["command"], state.vehicles["top_speed"] = np.nan, TOP_SPEED_MPS
    for name in ("lane", "ahead", "behind", "variant", "change_until_ms", "stood_for"):
        state.vehicles[name] = -1
    for name in ("entered_ms", "junction_ms", "conflict_ms"):
        state.vehicles[name] = NEVER_MS
    state.lanes["front"] = state.lanes["back"] = -1
    state.active["next"], state.active["previous"], state.active["served"] = NOT_ACTIVE, -1, -1
    state.clock["first_active"] = state.clock["last_active"] = -1
    reset_signals(net, state)
    return state


@compiled
def step(net_at, traffic_at, state_at, step_ms, ranges):  # type: ignore[no-untyped-def]
    """Advance an environment by ``step_ms``; commands are read from its state.

    Args:
        net_at, traffic_at, state_at: addresses of the directories, see :mod:`izoo.envs.tables`.
        ranges: memory to prefetch (:mod:`izoo.envs.twin.runtime.prefetch`).
    """
    net, traffic, state = open_net(net_at), open_traffic(traffic_at), open_state(state_at)
    update_signals(net, state, step_ms)
    state.clock.items = 0
    activate_occupied(net, state)
    deactivate_empty(state)
    lines = lines_for_each(ranges, state.clock.on_road)
    for lane in range(state.lane_room_before.shape[0]):
        state.lane_room_before[lane] = 0.0
    lane = state.clock.first_active
    while lane >= 0:
        v = state.lanes[lane].front
        in_front_m = 0.0
        while v >= 0:
            fetch_some(ranges, lines)
            read_lane_command(net, state, v, step_ms)
            plan(net, traffic, state, v, step_ms)
            keep_clear(net, traffic, state, v, in_front_m, step_ms / 1000.0)
            in_front_m += traffic.drivers[v].length + traffic.drivers[v].min_gap
            v = state.vehicles[v].behind
        state.lane_room_before[lane] = in_front_m
        lane = state.active[lane].next
    register_approaches(state)
    count = 0
    for lane in range(state.lanes.shape[0]):
        v = state.lanes[lane].front
        while v >= 0:
            behind = state.vehicles[v].behind
            count = drive(net, traffic, state, v, state.moved, count, step_ms)
            v = behind
    deactivate_empty(state)
    for k in range(count):
        v = state.moved[k]
        insert_into_lane(state, v, state.vehicles[v].lane)
    activate_occupied(net, state)
    lane = state.clock.first_active
    while lane >= 0:
        v = state.lanes[lane].front
        while v >= 0:
            clear_advice(state, v)
            v = state.vehicles[v].behind
        lane = state.active[lane].next
    change_lanes(net, traffic, state, step_ms)
    insert_vehicles(net, traffic, state, step_ms)
    state.clock.now_ms += step_ms
    state.clock.steps += 1
