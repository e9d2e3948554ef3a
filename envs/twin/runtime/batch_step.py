"""The steps of many environments in compiled code: what the policy orders, the twin's driving, and the MDP.

A step has two halves where CO2 comes in between, for the vehicles of all environments at once: :func:`drive_all` takes
the orders, drives, and says who is where; :func:`conclude_all` counts, pays, and writes the frames. With the compiled
surrogate :func:`play_all` does all of it, some environments after the other, as many steps as a decision lasts.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.config import KEEP_LANE
from izoo.envs.mdp.commands import LANE_CHANGE_BRAKING_MPS2
from izoo.envs.mdp.metric_sums import EPISODE_METRIC
from izoo.envs.mdp.slots import admit, release
from izoo.envs.mdp.state import DECISION_STEPS, EVERY_STEP, MEMBERS, WRONG_LANE_AGENTS
from izoo.envs.mdp.step import finish_step, translate_actions, update_vehicles
from izoo.envs.twin.driving.step import step
from izoo.envs.twin.lane_change.decision import DEFAULT_MODE, ROUTE_ONLY_MODE
from izoo.envs.twin.runtime.batched_emissions import GROUP, count_classes, emit_group
from izoo.envs.twin.runtime.handles import world_at
from izoo.envs.twin.runtime.layout import DRIVING, open_net, open_state
from izoo.envs.twin.runtime.prefetch import (
    GUESTS_AT,
    LINES,
    NET_AT,
    STATE_AT,
    TRAFFIC_AT,
    WORLD_AT,
    fetch_next,
    fetch_some,
    list_next,
)
from izoo.envs.twin.runtime.region_view import open_guests

_STEPS = EPISODE_METRIC["steps"]


@compiled(borrows=True, nogil=True)
def drive_all(addresses, step_ms, lane_change, like, by_class, ranges):  # type: ignore[no-untyped-def]
    """Play the first half of a step in some environments.

    Args:
        addresses: ``[n, 7]`` int64 (:data:`~izoo.envs.twin.runtime.prefetch.WORLD_AT` and those that follow it).
        step_ms: length of the step.
        lane_change: whether lane changes are commanded.
        like: any of the worlds; it gives the others' type.
        by_class: ``[C]`` int64 output: how many vehicles of each class emit something else than in the step before.
        ranges: working memory of :mod:`~izoo.envs.twin.runtime.prefetch`.
    """
    for c in range(by_class.shape[0]):
        by_class[c] = 0
    for k in range(addresses.shape[0]):
        list_next(addresses, k, like, True, ranges)
        world = world_at(addresses[k, WORLD_AT], like)
        _drive(world, addresses, k, step_ms, lane_change, ranges)
        fetch_some(ranges, ranges[LINES, 0])
        count_classes(world, by_class)


@compiled(borrows=True, nogil=True)
def conclude_all(addresses, like, ranges):  # type: ignore[no-untyped-def]
    """Play the second half of a step; CO2 is there."""
    for k in range(addresses.shape[0]):
        fetch_next(addresses, k, like, False, ranges)
        _conclude(world_at(addresses[k, WORLD_AT], like), addresses, k)


@compiled(borrows=True, nogil=True)
def play_all(addresses, steps, until_due, step_ms, lane_change, like, rows, ranges):  # type: ignore[no-untyped-def]
    """Play whole steps, with CO2 from the compiled surrogate: ``steps [n]`` in each environment.

    Args:
        steps: int64; where environments play ``until_due``, the most, and then how many were played.
        until_due: whether each plays on only until a decision ends.
        addresses, step_ms, lane_change, like, ranges: as for :func:`drive_all`.
        rows: a :class:`~izoo.envs.twin.runtime.batched_emissions.Rows` for the vehicles of any :data:`GROUP`
        environments.
    """
    count = addresses.shape[0]
    for first in range(0, count, GROUP):
        last = min(first + GROUP, count)
        most = 0
        for k in range(first, last):
            most = max(most, steps[k])
        for played in range(most):
            n = 0
            for k in range(first, last):
                if steps[k] > played:
                    _copy_row(addresses, k, rows.chosen, n)
                    n += 1
            # Behind them, for its memory, the one that is played next.
            if played + 1 < most:
                _copy_row(rows.chosen, 0, rows.chosen, n)
            else:
                _copy_row(addresses, last % count, rows.chosen, n)
            _play_group(rows.chosen[: n + 1], n, step_ms, lane_change, like, rows, ranges)
            if until_due:
                for k in range(first, last):
                    if (
                        steps[k] > played + 1
                        and world_at(addresses[k, WORLD_AT], like).tables.cursor[DECISION_STEPS] == 0
                    ):
                        steps[k] = played + 1


@compiled(borrows=True)
def _copy_row(source, i, target, j):  # type: ignore[no-untyped-def]
    """Copy a row. A slice assignment would compile the text of an error message that cannot occur."""
    for c in range(source.shape[1]):
        target[j, c] = source[i, c]


@compiled(borrows=True, inline="always")
def _play_group(addresses, count, step_ms, lane_change, like, rows, ranges):  # type: ignore[no-untyped-def]
    """Play a step of the first ``count`` environments."""
    rows.by_class[:] = 0
    for k in range(count):
        list_next(addresses, k, like, True, ranges)
        world = world_at(addresses[k, WORLD_AT], like)
        _drive(world, addresses, k, step_ms, lane_change, ranges)
        fetch_some(ranges, ranges[LINES, 0])
        count_classes(world, rows.by_class)
    emit_group(addresses[:count], like, rows)
    for k in range(count):
        _conclude(world_at(addresses[k, WORLD_AT], like), addresses, k)


@compiled(nogil=True)
def warm_up_all(addresses, steps, step_ms, ranges):  # type: ignore[no-untyped-def]
    """Drive the environments at ``addresses`` for some steps, uncommanded; ``ranges`` holds nothing."""
    for k in range(addresses.shape[0]):
        for _ in range(steps):
            step(addresses[k, NET_AT], addresses[k, TRAFFIC_AT], addresses[k, STATE_AT], step_ms, ranges)


@compiled(borrows=True, inline="always")
def _drive(world, addresses, k, step_ms, lane_change, ranges):  # type: ignore[no-untyped-def]
    net, state = open_net(addresses[k, NET_AT]), open_state(addresses[k, STATE_AT])
    guests = open_guests(addresses[k, GUESTS_AT])
    _pass_on_orders(world, state, lane_change)
    step(addresses[k, NET_AT], addresses[k, TRAFFIC_AT], addresses[k, STATE_AT], step_ms, ranges)
    _see_off(world, state, guests)
    _welcome(world, state, guests)
    _read(world.tables, net, state, guests)
    update_vehicles(world, (guests.lane, guests.position, guests.speed, guests.signals))


@compiled(borrows=True)
def _pass_on_orders(world, state, lane_change):  # type: ignore[no-untyped-def]
    commands, releases, caps = translate_actions(world)
    _command(world.tables, state, commands, releases)
    for j in range(caps):
        number = world.tables.vehicles[world.tables.capped[j]].vehicle_number
        state.vehicles[number].top_speed = world.tables.cap_mps[j]
    if lane_change:
        frame = world.frame
        _command_lanes(world.tables, state, frame.action, frame.defer, frame.lane_change)


@compiled(borrows=True)
def _command(tables, state, commands, releases):  # type: ignore[no-untyped-def]
    """Command speeds; a vehicle keeps a command until the next one."""
    for j in range(releases):
        state.vehicles[tables.vehicles[tables.release[j]].vehicle_number].command = np.nan
    for j in range(commands):
        state.vehicles[tables.vehicles[tables.command[j]].vehicle_number].command = tables.target_mps[j]


@compiled(borrows=True)
def _command_lanes(tables, state, action, defer, lane_change):  # type: ignore[no-untyped-def]
    """Command lane changes; a CV that asks to be left to its driver changes lanes as that one does."""
    for a in range(tables.agent_row.shape[0]):
        row = tables.agent_row[a]
        if row < 0:
            continue
        v = tables.vehicles[row].vehicle_number
        asks = defer[a] != 0 or np.isnan(action[a, 0]) or tables.acting[a] < 0
        state.vehicles[v].change_mode = DEFAULT_MODE if asks else ROUTE_ONLY_MODE
        if lane_change[a] != KEEP_LANE and not tables.vehicles[row].deferred:
            state.vehicles[v].change_command = lane_change[a] - KEEP_LANE


@compiled(borrows=True)
def _see_off(world, state, guests):  # type: ignore[no-untyped-def]
    """Take those who are no longer on the road out of the members."""
    j = _gone(world.tables, state, 0)
    while j >= 0:
        row = world.tables.members[j]
        guests.row_of[world.tables.vehicles[row].vehicle_number] = -1
        release(world, row)
        j = _gone(world.tables, state, j)


@compiled(borrows=True)
def _gone(tables, state, first):  # type: ignore[no-untyped-def]
    """Return the place of the first member from ``first`` on who is no longer on the road, -1 for none."""
    for j in range(first, tables.cursor[MEMBERS]):
        if state.vehicles[tables.vehicles[tables.members[j]].vehicle_number].status != DRIVING:
            return j
    return -1


@compiled(borrows=True)
def _welcome(world, state, guests):  # type: ignore[no-untyped-def]
    """Give everybody who has come to the region a row."""
    v = _newcomer(state, guests)
    while v >= 0:
        guests.row_of[v] = admit(world, v, state.vehicles[v].accel, True)
        v = _newcomer(state, guests)


@compiled(borrows=True)
def _newcomer(state, guests):  # type: ignore[no-untyped-def]
    """Return the first vehicle in the region without a row, -1 for none."""
    for k in range(guests.entry_lanes.shape[0]):
        v = state.lanes[guests.entry_lanes[k]].back
        while v >= 0:
            if guests.row_of[v] < 0:
                return v
            v = state.vehicles[v].ahead
    return -1


@compiled(borrows=True)
def _read(tables, net, state, guests):  # type: ignore[no-untyped-def]
    """Note where the members are: region lane, lane position, speed and signal bits."""
    for j in range(tables.cursor[MEMBERS]):
        v = tables.vehicles[tables.members[j]].vehicle_number
        guests.lane[j] = net.lanes[state.vehicles[v].lane].region
        guests.position[j] = state.vehicles[v].position
        guests.speed[j] = state.vehicles[v].speed
        guests.signals[j] = state.vehicles[v].signals


@compiled(borrows=True, inline="always")
def _conclude(world, addresses, k):  # type: ignore[no-untyped-def]
    guests = open_guests(addresses[k, GUESTS_AT])
    steps = world.tables.episode[_STEPS] + 1.0
    step_s = world.rules.step_s
    state = open_state(addresses[k, STATE_AT])
    playing_out = world.rules.scope != EVERY_STEP and steps > world.rules.control_steps
    finish_step(world, guests.begun_s[0] + steps * step_s, True, playing_out and everybody_left(state))
    _give_way(world.tables, state, step_s)


@compiled(borrows=True)
def everybody_left(state):  # type: ignore[no-untyped-def]
    """Whether no vehicle is on the road, waits to enter it, or is yet to depart."""
    here = state.clock.on_road > 0 or state.clock.next_departure < state.vehicles.shape[0]
    for lane in range(state.waiting_first.shape[0]):
        here = here or state.waiting_first[lane] >= 0
    return not here


@compiled(borrows=True)
def _give_way(tables, state, step_s):  # type: ignore[no-untyped-def]
    """Mark the agents that their drivers slow for a lane change; they are left to them in the next step."""
    for j in range(tables.cursor[MEMBERS]):
        tables.vehicles[tables.members[j]].yielding = 0
    for j in range(tables.cursor[WRONG_LANE_AGENTS]):
        row = tables.wrong_lane_agents[j]
        before = tables.vehicles[row].speed_mps - tables.vehicles[row].accel_mps2 * step_s
        wished = state.vehicles[tables.vehicles[row].vehicle_number].free_speed
        tables.vehicles[row].yielding = (before - wished) / step_s > LANE_CHANGE_BRAKING_MPS2
