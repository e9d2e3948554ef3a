"""One step of one environment, in SUMO's order."""

from __future__ import annotations

import numpy as np

from izoo.envs.twin.active import activate_busy, forget_empty
from izoo.envs.twin.arrays import (
    ACTIVE_FIRST,
    ACTIVE_LAST,
    ACTIVE_NEXT,
    AHEAD,
    BEHIND,
    CHANGE_UNTIL_MS,
    COMMAND,
    CONFLICT_MS,
    ITEM_TOTAL,
    JUNCTION_MS,
    LANE,
    LANE_BACK,
    LANE_FRONT,
    LENGTH,
    MAX_ADVICES,
    MAX_ITEMS_PER_VEHICLE,
    MAX_TAIL_LANES,
    MIN_GAP,
    NEVER_MS,
    NOT_ACTIVE,
    NOW_MS,
    STEP_COUNT,
    STOOD_FOR,
    VEHICLE_FLOATS,
    VEHICLE_INTS,
    TwinNet,
    TwinState,
    TwinTraffic,
    open_net,
    open_state,
    open_traffic,
)
from izoo.envs.twin.changing import change_lanes, prepare_change, take_commands
from izoo.envs.twin.clearance import keep_clear
from izoo.envs.twin.compiled import compiled
from izoo.envs.twin.inserting import insert_vehicles
from izoo.envs.twin.lights import begin_signals, show_signals
from izoo.envs.twin.moving import drive
from izoo.envs.twin.order import place
from izoo.envs.twin.planning import plan, register_approaches


def new_state(net: TwinNet, traffic: TwinTraffic) -> TwinState:
    """Return the state at the beginning of an episode, with nobody on the road."""
    lanes, links, programs, count = len(net.lane_ints), len(net.link_ints), len(net.program_ints), len(traffic.ints)
    items = MAX_ITEMS_PER_VEHICLE * (count + 1)
    state = TwinState(
        clock=np.zeros(8, np.int64),
        floats=np.zeros((count, VEHICLE_FLOATS)),
        ints=np.zeros((count, VEHICLE_INTS), np.int32),
        tail_lane=np.full((count, MAX_TAIL_LANES), -1, np.int32),
        lanes=np.zeros((lanes, 4), np.int32),
        tails=np.full((lanes, MAX_TAIL_LANES), -1, np.int32),
        waiting_first=np.full(lanes, -1, np.int32),
        waiting_last=np.full(lanes, -1, np.int32),
        waiting_next=np.full(count, -1, np.int32),
        link_letter=np.zeros(links, np.uint8),
        program_phase=np.full(programs, -1, np.int64),
        program_switch_ms=np.full(programs, -1, np.int64),
        link_first=np.full(links, -1, np.int32),
        item_floats=np.zeros((items, 8)),
        item_ints=np.zeros((items, 8), np.int64),
        advice=np.zeros((count, MAX_ADVICES)),
        changer=np.zeros((lanes, 8), np.int32),
        changer_density=np.zeros(lanes),
        changer_queue=np.zeros(32, np.int32),
        changer_way=np.zeros(32),
        lane_room=np.zeros(lanes),
        moved=np.zeros(count, np.int32),
        active=np.full((lanes, 4), -1, np.int32),
    )
    state.floats[:, COMMAND] = np.nan
    state.ints[:, [LANE, AHEAD, BEHIND, CHANGE_UNTIL_MS, STOOD_FOR]] = -1
    state.ints[:, [JUNCTION_MS, CONFLICT_MS]] = NEVER_MS
    state.lanes[:, [LANE_FRONT, LANE_BACK]] = -1
    state.active[:, ACTIVE_NEXT] = NOT_ACTIVE
    state.clock[[ACTIVE_FIRST, ACTIVE_LAST]] = -1
    begin_signals(net, state)
    return state


@compiled
def step(net_at, traffic_at, state_at, step_ms):  # type: ignore[no-untyped-def]
    """Advance an environment by ``step_ms``; commands are read from its state.

    Args:
        net_at, traffic_at, state_at: addresses of the directories, see :mod:`izoo.envs.twin.compiled`.
    """
    net, traffic, state = open_net(net_at), open_traffic(traffic_at), open_state(state_at)
    show_signals(net, state, step_ms)
    state.clock[ITEM_TOTAL] = 0
    activate_busy(net, state)
    forget_empty(state)
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        v = state.lanes[lane, LANE_FRONT]
        in_front_m = 0.0
        while v >= 0:
            take_commands(net, state, v, step_ms)
            plan(net, traffic, state, v, step_ms)
            keep_clear(net, traffic, state, v, in_front_m, step_ms / 1000.0)
            in_front_m += traffic.floats[v, LENGTH] + traffic.floats[v, MIN_GAP]
            v = state.ints[v, BEHIND]
        lane = state.active[lane, ACTIVE_NEXT]
    register_approaches(state)
    count = 0
    for lane in range(state.lanes.shape[0]):
        v = state.lanes[lane, LANE_FRONT]
        while v >= 0:
            behind = state.ints[v, BEHIND]
            count = drive(net, traffic, state, v, state.moved, count, step_ms)
            v = behind
    forget_empty(state)
    for k in range(count):
        v = state.moved[k]
        place(state, v, state.ints[v, LANE])
    activate_busy(net, state)
    lane = state.clock[ACTIVE_FIRST]
    while lane >= 0:
        v = state.lanes[lane, LANE_FRONT]
        while v >= 0:
            prepare_change(state, v)
            v = state.ints[v, BEHIND]
        lane = state.active[lane, ACTIVE_NEXT]
    change_lanes(net, traffic, state, step_ms)
    insert_vehicles(net, traffic, state, step_ms)
    state.clock[NOW_MS] += step_ms
    state.clock[STEP_COUNT] += 1
