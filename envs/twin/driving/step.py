"""One step of one environment, in SUMO's order."""

from __future__ import annotations

import numpy as np

from izoo.envs.mdp.commands import TOP_SPEED_MPS
from izoo.envs.twin.driving.active_lanes import activate_occupied, deactivate_empty
from izoo.envs.twin.driving.insertion import insert_vehicles
from izoo.envs.twin.driving.lane_queues import insert_into_lane
from izoo.envs.twin.driving.link_planning import plan, register_approaches
from izoo.envs.twin.driving.movement import drive
from izoo.envs.twin.driving.traffic_lights import reset_signals, update_signals
from izoo.envs.twin.junction.keep_clear import keep_clear
from izoo.envs.twin.lane_change.cooperation import clear_advice
from izoo.envs.twin.lane_change.execution import change_lanes, read_lane_command
from izoo.envs.twin.runtime.compiled import compiled
from izoo.envs.twin.runtime.layout import (
    ACTIVE_FIRST,
    ACTIVE_LAST,
    ACTIVE_NEXT,
    AHEAD,
    BEHIND,
    CHANGE_UNTIL_MS,
    COMMAND,
    CONFLICT_MS,
    ENTERED_MS,
    ITEM_TOTAL,
    JUNCTION_MS,
    LANE,
    LANE_BACK,
    LANE_FRONT,
    LENGTH,
    MAX_ADVICES,
    MAX_ITEMS_PER_VEHICLE,
    MAX_LANES_SEEN,
    MAX_TAIL_LANES,
    MIN_GAP,
    NEVER_MS,
    NOT_ACTIVE,
    NOW_MS,
    ON_ROAD,
    STATE,
    STEP_COUNT,
    STOOD_FOR,
    TOP_SPEED,
    VARIANT,
    VEHICLE_FLOATS,
    VEHICLE_INTS,
    TwinNet,
    TwinState,
    TwinTraffic,
    open_net,
    open_state,
    open_traffic,
)
from izoo.envs.twin.runtime.prefetch import fetch_some, lines_for_each
from izoo.envs.twin.runtime.scratch import Desk, Shapes, zeros


def new_state(net: TwinNet, traffic: TwinTraffic, desk: Desk | None = None) -> TwinState:
    """Return the state at the beginning of an episode, without vehicles on the road.

    Args:
        net, traffic: of the episode.
        desk: working memory; by default its own.
    """
    lanes, links, programs, count = len(net.lane_ints), len(net.link_ints), len(net.program_ints), len(traffic.ints)
    items = MAX_ITEMS_PER_VEHICLE * (count + 1)
    lengths: Shapes = {
        "clock": 8,
        "lanes": (lanes, 4),
        "tails": (lanes, MAX_TAIL_LANES),
        "waiting_first": lanes,
        "waiting_last": lanes,
        "link_letter": links,
        "program_switch_ms": programs,
        "active": (lanes, 4),
        # From here on rows are vehicles.
        "floats": (count, VEHICLE_FLOATS),
        "ints": (count, VEHICLE_INTS),
        "tail_lane": (count, MAX_TAIL_LANES),
        "waiting_next": count,
        "advice": (count, MAX_ADVICES),
        "room_seen": (count, MAX_LANES_SEEN),
    }
    working: Shapes = {
        "link_first": links,
        "item_floats": (items, 8),
        "item_ints": (items, 8),
        "changer": (lanes, 8),
        "changer_density": lanes,
        "changer_queue": 32,
        "changer_way": 32,
        "lane_room": lanes,
        "lane_room_before": lanes,
        "moved": count,
    }
    state = TwinState(**zeros(STATE, lengths), **(desk or Desk()).spread(STATE, working))
    for name in ("tail_lane", "tails", "waiting_first", "waiting_last", "waiting_next", "active"):
        getattr(state, name)[:] = -1
    state.program_switch_ms[:] = -1
    state.floats[:, COMMAND] = np.nan
    state.floats[:, TOP_SPEED] = TOP_SPEED_MPS
    state.ints[:, [LANE, AHEAD, BEHIND, VARIANT, CHANGE_UNTIL_MS, STOOD_FOR]] = -1
    state.ints[:, [ENTERED_MS, JUNCTION_MS, CONFLICT_MS]] = NEVER_MS
    state.lanes[:, [LANE_FRONT, LANE_BACK]] = -1
    state.active[:, ACTIVE_NEXT] = NOT_ACTIVE
    state.clock[[ACTIVE_FIRST, ACTIVE_LAST]] = -1
    reset_signals(net, state)
    return state


@compiled
def step(net_at, traffic_at, state_at, step_ms, ranges):  # type: ignore[no-untyped-def]
    """Advance an environment by ``step_ms``; commands are read from its state.

    Args:
        net_at, traffic_at, state_at: addresses of the directories, see :mod:`izoo.envs.twin.runtime.compiled`.
        ranges: memory to prefetch (:mod:`izoo.envs.twin.runtime.prefetch`).
    """
    net, traffic, state = open_net(net_at), open_traffic(traffic_at), open_state(state_at)
    update_signals(net, state, step_ms)
    state.clock[ITEM_TOTAL] = 0
    activate_occupied(net, state)
    deactivate_empty(state)
    lines = lines_for_each(ranges, state.clock[ON_ROAD])
    for lane in range(state.lane_room_before.shape[0]):
        state.lane_room_before[lane] = 0.0
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        v = state.lanes[lane, LANE_FRONT]
        in_front_m = 0.0
        while v >= 0:
            fetch_some(ranges, lines)
            read_lane_command(net, state, v, step_ms)
            plan(net, traffic, state, v, step_ms)
            keep_clear(net, traffic, state, v, in_front_m, step_ms / 1000.0)
            in_front_m += traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
            v = state.ints[v, BEHIND]
        state.lane_room_before[lane] = in_front_m
        lane = state.active[lane, ACTIVE_NEXT]
    register_approaches(state)
    count = 0
    for lane in range(state.lanes.shape[0]):
        v = state.lanes[lane, LANE_FRONT]
        while v >= 0:
            behind = state.ints[v, BEHIND]
            count = drive(net, traffic, state, v, state.moved, count, step_ms)
            v = behind
    deactivate_empty(state)
    for k in range(count):
        v = state.moved[k]
        insert_into_lane(state, v, state.ints[v, LANE])
    activate_occupied(net, state)
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        v = state.lanes[lane, LANE_FRONT]
        while v >= 0:
            clear_advice(state, v)
            v = state.ints[v, BEHIND]
        lane = state.active[lane, ACTIVE_NEXT]
    change_lanes(net, traffic, state, step_ms)
    insert_vehicles(net, traffic, state, step_ms)
    state.clock[NOW_MS] += step_ms
    state.clock[STEP_COUNT] += 1
