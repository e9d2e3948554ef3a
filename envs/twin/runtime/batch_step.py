"""The steps of many environments in compiled code: what the policy orders, the twin's driving, and the MDP.

A step has two halves where CO2 comes in between, for the vehicles of all environments at once: :func:`drive_all` takes
the orders, drives, and says which vehicle is where; :func:`conclude_all` counts, pays, and writes the frames. With the
compiled surrogate :func:`play_all` does all of it, some environments after the other, for as many steps as a decision
lasts.
"""

from __future__ import annotations

import numpy as np

from izoo.envs.config import KEEP_LANE
from izoo.envs.mdp.commands import LANE_CHANGE_BRAKING_MPS2
from izoo.envs.mdp.slots import admit, release
from izoo.envs.mdp.state import EVERY_STEP, open_world
from izoo.envs.mdp.step import finish_step, translate_actions, update_vehicles
from izoo.envs.tables import compiled
from izoo.envs.twin.driving.step import step
from izoo.envs.twin.lane_change.decision import DEFAULT_MODE, ROUTE_ONLY_MODE
from izoo.envs.twin.runtime.batched_emissions import GROUP, count_classes, emit_group
from izoo.envs.twin.runtime.layout import DRIVING, open_net, open_state
from izoo.envs.twin.runtime.prefetch import LINES, NET_AT, STATE_AT, TRAFFIC_AT, WORLD_AT, fetch_some, list_next


@compiled
def drive_all(addresses, step_ms, lane_change, by_class, ranges):  # type: ignore[no-untyped-def]
    """Play the first half of a step in some environments.

    Args:
        addresses: ``[n, 4]`` int64 (:data:`~izoo.envs.twin.runtime.prefetch.WORLD_AT` and those that follow it).
        step_ms: length of the step.
        lane_change: whether lane changes are commanded.
        by_class: ``[C]`` int64 output: how many vehicles of each class emit something else than in the step before.
        ranges: working memory of :mod:`~izoo.envs.twin.runtime.prefetch`.
    """
    for c in range(by_class.shape[0]):
        by_class[c] = 0
    for k in range(addresses.shape[0]):
        list_next(addresses, k, True, ranges)
        world = open_world(addresses[k, WORLD_AT])
        _drive(world, addresses, k, step_ms, lane_change, ranges)
        fetch_some(ranges, ranges[LINES, 0])
        count_classes(world, by_class)


@compiled
def conclude_all(addresses, ranges):  # type: ignore[no-untyped-def]
    """Play the second half of a step; CO2 is there."""
    for k in range(addresses.shape[0]):
        list_next(addresses, k, False, ranges)
        fetch_some(ranges, ranges[LINES, 0])
        _conclude(open_world(addresses[k, WORLD_AT]), addresses, k)


@compiled
def play_all(addresses, steps, until_due, step_ms, lane_change, rows, ranges):  # type: ignore[no-untyped-def]
    """Play whole steps, with CO2 from the compiled surrogate: ``steps [n]`` in each environment.

    Args:
        steps: int64; where environments play ``until_due``, the most, and then how many were played.
        until_due: whether each plays on only until a decision ends.
        addresses, step_ms, lane_change, ranges: as for :func:`drive_all`.
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
            _play_group(rows.chosen[: n + 1], n, step_ms, lane_change, rows, ranges)
            if until_due:
                for k in range(first, last):
                    world = open_world(addresses[k, WORLD_AT])
                    if steps[k] > played + 1 and world.tables.cursor.decision_steps == 0:
                        steps[k] = played + 1


@compiled
def _copy_row(source, i, target, j):  # type: ignore[no-untyped-def]
    """Copy a row. A slice assignment would compile the text of an error message that cannot occur."""
    for c in range(source.shape[1]):
        target[j, c] = source[i, c]


@compiled(inline="always")
def _play_group(addresses, count, step_ms, lane_change, rows, ranges):  # type: ignore[no-untyped-def]
    """Play a step of the first ``count`` environments."""
    rows.by_class[:] = 0
    for k in range(count):
        list_next(addresses, k, True, ranges)
        world = open_world(addresses[k, WORLD_AT])
        _drive(world, addresses, k, step_ms, lane_change, ranges)
        fetch_some(ranges, ranges[LINES, 0])
        count_classes(world, rows.by_class)
    emit_group(addresses[:count], rows)
    for k in range(count):
        _conclude(open_world(addresses[k, WORLD_AT]), addresses, k)


@compiled
def warm_up_all(addresses, steps, step_ms, ranges):  # type: ignore[no-untyped-def]
    """Drive the environments at ``addresses`` for some steps, uncommanded; ``ranges`` holds nothing."""
    for k in range(addresses.shape[0]):
        for _ in range(steps):
            step(addresses[k, NET_AT], addresses[k, TRAFFIC_AT], addresses[k, STATE_AT], step_ms, ranges)


@compiled(inline="always")
def _drive(world, addresses, k, step_ms, lane_change, ranges):  # type: ignore[no-untyped-def]
    net, state = open_net(addresses[k, NET_AT]), open_state(addresses[k, STATE_AT])
    _pass_on_orders(world, state, lane_change)
    step(addresses[k, NET_AT], addresses[k, TRAFFIC_AT], addresses[k, STATE_AT], step_ms, ranges)
    _release_gone(world, state)
    _admit_newcomers(world, state)
    _report(world.tables, net, state)
    update_vehicles(world)


@compiled
def _pass_on_orders(world, state, lane_change):  # type: ignore[no-untyped-def]
    commands, releases, caps = translate_actions(world)
    _command(world, state, commands, releases)
    for j in range(caps):
        number = world.tables.vehicles[world.work.capped[j]].vehicle_number
        state.vehicles[number].top_speed = world.work.cap_mps[j]
    if lane_change:
        frame = world.frame
        _command_lanes(world.tables, state, frame.action, frame.defer, frame.lane_change)


@compiled
def _command(world, state, commands, releases):  # type: ignore[no-untyped-def]
    """Command speeds; a vehicle keeps a command until the next one."""
    vehicles, work = world.tables.vehicles, world.work
    for j in range(releases):
        state.vehicles[vehicles[work.release[j]].vehicle_number].command = np.nan
    for j in range(commands):
        state.vehicles[vehicles[work.command[j]].vehicle_number].command = work.target_mps[j]


@compiled
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


@compiled
def _release_gone(world, state):  # type: ignore[no-untyped-def]
    """Release the members that are no longer on the road."""
    j = _gone(world.tables, state, 0)
    while j >= 0:
        release(world, world.tables.members[j])
        j = _gone(world.tables, state, j)


@compiled
def _gone(tables, state, first):  # type: ignore[no-untyped-def]
    """Return the place of the first member from ``first`` on that is no longer on the road, -1 for none."""
    for j in range(first, tables.cursor.members):
        if state.vehicles[tables.vehicles[tables.members[j]].vehicle_number].status != DRIVING:
            return j
    return -1


@compiled
def _admit_newcomers(world, state):  # type: ignore[no-untyped-def]
    """Give every vehicle that has come to the region a row."""
    v = _newcomer(world, state)
    while v >= 0:
        admit(world, v, state.vehicles[v].accel, True)
        v = _newcomer(world, state)


@compiled
def _newcomer(world, state):  # type: ignore[no-untyped-def]
    """Return the first vehicle in the region without a row, -1 for none."""
    for k in range(world.entry_lanes.shape[0]):
        v = state.lanes[world.entry_lanes[k]].back
        while v >= 0:
            if world.tables.demand[v].row < 0:
                return v
            v = state.vehicles[v].ahead
    return -1


@compiled
def _report(tables, net, state):  # type: ignore[no-untyped-def]
    """Report where the members are."""
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        driven = state.vehicles[vehicle.vehicle_number]
        vehicle.region_lane = net.lanes[driven.lane].region
        vehicle.lane_position_m = driven.position
        vehicle.reported_speed_mps = driven.speed
        vehicle.signals = driven.signals


@compiled(inline="always")
def _conclude(world, addresses, k):  # type: ignore[no-untyped-def]
    steps = world.tables.episode.steps + 1.0
    step_s = world.rules.step_s
    state = open_state(addresses[k, STATE_AT])
    playing_out = world.rules.scope != EVERY_STEP and steps > world.rules.control_steps
    finish_step(world, world.tables.cursor.started_s + steps * step_s, True, playing_out and everybody_left(state))
    _give_way(world.tables, state, step_s)


@compiled
def everybody_left(state):  # type: ignore[no-untyped-def]
    """Whether no vehicle is on the road, waits to enter it, or is yet to depart."""
    here = state.clock.on_road > 0 or state.clock.next_departure < state.vehicles.shape[0]
    for lane in range(state.waiting_first.shape[0]):
        here = here or state.waiting_first[lane] >= 0
    return not here


@compiled
def _give_way(tables, state, step_s):  # type: ignore[no-untyped-def]
    """Mark the agents that their drivers slow for a lane change; they are left to them in the next step."""
    for j in range(tables.cursor.members):
        tables.vehicles[tables.members[j]].yielding = 0
    for j in range(tables.cursor.wrong_lane_agents):
        vehicle = tables.vehicles[tables.wrong_lane_agents[j]]
        before = vehicle.speed_mps - vehicle.accel_mps2 * step_s
        wished = state.vehicles[vehicle.vehicle_number].free_speed
        vehicle.yielding = (before - wished) / step_s > LANE_CHANGE_BRAKING_MPS2
