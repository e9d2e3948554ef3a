"""One step of the MDP in compiled code: commands before the simulator moves, and the next frame after it has.

:func:`make_frame` joins the three parts for a simulator of one environment, which saves two calls per step. A simulator
of many environments calls :func:`update_vehicles` and :func:`finish_step` for each of them, and computes the CO2 of all
of them in between.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled, field_writer
from izoo.emissions.kernel import emission_rate
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.commands import plan_caps, plan_commands
from izoo.envs.mdp.credit import assign_credit, count_blocked
from izoo.envs.mdp.displacement import update_motion
from izoo.envs.mdp.metric_sums import (
    EPISODE_METRIC,
    accumulate_cohort,
    accumulate_episode,
    accumulate_step,
    count_queues,
)
from izoo.envs.mdp.neighbours import find_leaders, sort_lanes
from izoo.envs.mdp.observation_kernel import write_observations
from izoo.envs.mdp.reward_kernel import NUM_TERMS, compute_rewards, evaluate_terms, team_step_reward
from izoo.envs.mdp.signals import phase_of_step, read_clock
from izoo.envs.mdp.slots import free_slots
from izoo.envs.mdp.state import (
    DECISION_STEPS,
    EVERY_STEP,
    FREE,
    MEMBERS,
    ONCE_AND_BEHIND,
    WRONG_LANE_AGENTS,
    sums_to_horizon,
)
from izoo.networks.road import APPROACHING

_STEPS = EPISODE_METRIC["steps"]


@compiled(borrows=True)
def translate_actions(world):  # type: ignore[no-untyped-def]
    """Turn the frame's actions into commands for the coming step; return the numbers of commands, releases and caps.

    The actions are those of the present decision and apply to the agents that were there when it began. Where agents do
    not decide in every step, they apply to the agents that had to decide; for the others the last decision holds.
    """
    tables, frame = world.tables, world.frame
    begins = tables.cursor[DECISION_STEPS] == 0
    for a in range(tables.agent_row.shape[0]):
        if begins:
            tables.agent_row[a] = max(tables.agent_row[a], FREE)
            tables.acting[a] = tables.agent_row[a]
        elif tables.agent_row[a] < 0:
            tables.acting[a] = -1
    action, defer = frame.action, frame.defer
    if world.rules.scope != EVERY_STEP:
        if begins:
            _store_decisions(tables, frame)
        action, defer = tables.decision, tables.deferred
    sums = sums_to_horizon(world)
    if world.rules.speeds:
        return plan_caps(tables, world.rules, world.road, action, defer, sums)
    commands, releases = plan_commands(tables, world.rules, action, defer, sums)
    return commands, releases, 0


@compiled(borrows=True)
def _store_decisions(tables, frame):  # type: ignore[no-untyped-def]
    """Store the decisions of the agents that had to decide."""
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r >= 0 and frame.decides[a]:
            for d in range(frame.action.shape[1]):
                tables.decision[a, d] = frame.action[a, d]
            tables.deferred[a] = frame.defer[a]
            tables.stage[a] = 1 if tables.vehicles[r].location == APPROACHING else 2


@compiled(borrows=True)
def _must_decide(tables, rules, a):  # type: ignore[no-untyped-def]
    """Whether the agent in a slot must decide before the coming step, where agents do not decide in every step."""
    r = tables.agent_row[a]
    if r < 0 or tables.stage[a] == 0:
        return r >= 0
    return rules.scope == ONCE_AND_BEHIND and tables.stage[a] == 1 and tables.vehicles[r].location != APPROACHING


@compiled(borrows=True)
def _any_due(tables, rules):  # type: ignore[no-untyped-def]
    due = False
    for a in range(tables.agent_row.shape[0]):
        due = due or _must_decide(tables, rules, a)
    return due


@compiled
def translate_frame_actions(world):  # type: ignore[no-untyped-def]
    """Call :func:`translate_actions` from Python."""
    return translate_actions(world)


@compiled(borrows=True)
def update_vehicles(world, reading):  # type: ignore[no-untyped-def]
    """Write the vehicles' positions into the tables, sort them by lane, and find their leaders.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        reading: ``[n]`` arrays in the order of the members: region lane, lane position (m), speed (m/s), signal bits.
    """
    tables, road = world.tables, world.road
    rows = tables.members[: tables.cursor[MEMBERS]]
    update_motion(rows, reading, tables.vehicles, road, world.rules.step_s)
    sort_lanes(rows, tables, world.work.lane_fill)
    find_leaders(rows, tables, road)


@compiled(borrows=True)
def compute_emissions(world):  # type: ignore[no-untyped-def]
    """Write each vehicle's CO2 of the step in g, unless it is that of the step before; electric CVs emit nothing."""
    tables, rules = world.tables, world.rules
    for j in range(tables.cursor[MEMBERS]):
        vehicle = tables.vehicles[tables.members[j]]
        if vehicle.steady:
            continue
        vehicle.emission_g = 0.0
        if not vehicle.electric:
            rate = emission_rate(
                np.float32(vehicle.speed_mps),
                np.float32(vehicle.accel_mps2),
                np.float32(vehicle.grade_pct),
                vehicle.moves_class,
                np.float32(rules.temperature_c),
                np.float32(rules.humidity_pct),
                world.surrogate,
            )
            vehicle.emission_g = rate * rules.step_s


@compiled(borrows=True)
def finish_step(world, time_s, measured, empty):  # type: ignore[no-untyped-def]
    """Update metrics, compute rewards, and write the next frame.

    Within a decision, rewards add up, and agents that left stay marked as terminated. The observation for the next
    decision is written when the present one ends.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`, with the vehicles updated and their CO2 computed.
        time_s: simulated time after the step.
        measured: whether the step counts (the first frame of an episode does not).
        empty: whether no vehicle is in the network or will be; this ends a decision that lasts until an agent must
            decide.
    """
    tables, work, clock, rules, out = world.tables, world.work, world.clock, world.rules, world.frame
    rows = tables.members[: tables.cursor[MEMBERS]]
    vehicles = tables.vehicles
    sums = sums_to_horizon(world)
    if measured:
        phase = phase_of_step(time_s, clock)
        colour, legal = clock.colour[:, :, phase], clock.legal_on_red[:, :, phase]
        accumulate_step(rows, vehicles, colour, legal, rules.step_s, sums)
        accumulate_cohort(rows, vehicles, tables.sums)
        count_queues(rows, vehicles, sums)
    read_clock(time_s, clock)
    begins = tables.cursor[DECISION_STEPS] == 0
    fleet, shared, own = work.fleet, work.shared, work.own
    evaluate_terms(rows, vehicles, rules.reward, tables.terms, fleet, shared, work.own_shared)
    if rules.reward.sums:
        count_blocked(world, time_s)
        assign_credit(world, rows, tables.terms, own, fleet)
    else:
        for a in range(tables.acting.shape[0]):
            if tables.acting[a] >= 0:
                for c in range(NUM_TERMS):
                    own[a, c] = tables.terms[tables.acting[a], c]
    compute_rewards(tables.acting, work, rules, out, rows.shape[0] == 0, begins)
    if begins:
        out.team_reward[0] = 0.0
    if measured:
        out.team_reward[0] += team_step_reward(work, rules, rows.shape[0] == 0)
    free_slots(tables, out.agent_terminated, out.agent_done, begins)
    if measured:
        accumulate_episode(rows, tables, work.step_reward, rules.step_s, sums)
        tables.cursor[DECISION_STEPS] = (tables.cursor[DECISION_STEPS] + 1) % rules.hold_steps
        if rules.scope != EVERY_STEP and (empty or _any_due(tables, rules)):
            tables.cursor[DECISION_STEPS] = 0
        # The horizon and the end of an episode end a decision, however short.
        if tables.episode[_STEPS] == rules.control_steps or tables.episode[_STEPS] == rules.total_steps:
            tables.cursor[DECISION_STEPS] = 0
    if tables.cursor[DECISION_STEPS] == 0:
        write_observations(
            tables.agent_row,
            work.written,
            tables,
            world.road,
            clock,
            rules,
            out.observation,
        )
        _emit(world)
    _list_wrong_lane_agents(rows, tables)


@compiled
def make_frame(world, reading, time_s, measured, empty):  # type: ignore[no-untyped-def]
    """Turn a simulator's report into the next frame."""
    update_vehicles(world, reading)
    compute_emissions(world)
    finish_step(world, time_s, measured, empty)


@compiled(borrows=True)
def _list_wrong_lane_agents(rows, tables):  # type: ignore[no-untyped-def]
    """List the agents on a lane that does not lead to their exit: the simulator may slow them for a lane change."""
    count = 0
    for r in rows:
        if tables.vehicles[r].wrong_lane and tables.vehicles[r].agent >= 0:
            tables.wrong_lane_agents[count] = r
            count += 1
    tables.cursor[WRONG_LANE_AGENTS] = count


@compiled(borrows=True)
def _emit(world):  # type: ignore[no-untyped-def]
    """Copy the emitted groups to the frame."""
    tables, clock, rules, out = world.tables, world.clock, world.rules, world.frame
    for a in range(tables.agent_row.shape[0]):
        out.mask[a] = tables.agent_row[a] >= 0
        out.agent_vehicle[a] = max(tables.agent_row[a], 0)
    if rules.emit_number:
        for a in range(tables.agent_row.shape[0]):
            row = tables.agent_row[a]
            out.number[a] = tables.vehicles[row].vehicle_number if row >= 0 else -1
    if rules.scope != EVERY_STEP:
        for a in range(tables.agent_row.shape[0]):
            out.decides[a] = _must_decide(tables, rules, a)
    if rules.emit_vehicles:
        _emit_vehicles(tables.vehicles, out)
    if rules.emit_signal:
        _copy_into(out.signal_colour, clock.now)
        _copy_into(out.signal_time_left_s, clock.time_left_s)
    for k in range(tables.episode.shape[0]):
        out.episode_metrics[k] = tables.episode[k]
    if rules.emit_metrics:
        _copy_into(out.approach_metrics, tables.sums)


_write_floats, _write_ints, _write_flags = map(field_writer, (VEHICLE_FLOATS, VEHICLE_INTS, VEHICLE_FLAGS))


@compiled(borrows=True)
def _emit_vehicles(vehicles, out):  # type: ignore[no-untyped-def]
    """Copy the emitted fields of the first ``V`` rows; rows without a vehicle are zero."""
    for v in range(out.vehicle_floats.shape[0]):
        floats, ints, flags = out.vehicle_floats[v], out.vehicle_ints[v], out.vehicle_flags[v]
        if v < vehicles.shape[0] and vehicles[v].present:
            _write_floats(vehicles[v], floats)
            _write_ints(vehicles[v], ints)
            _write_flags(vehicles[v], flags)
        else:
            floats[:] = 0.0
            ints[:] = 0
            flags[:] = 0


@compiled(borrows=True)
def _copy_into(target, source):  # type: ignore[no-untyped-def]
    """Copy a table to the upper left corner of one that is no smaller.

    A slice assignment would compile the text of an error message that cannot occur: 2 s each.
    """
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]
