"""One step of the MDP in compiled code: commands before the simulator moves, and the next frame after it has.

:func:`make_frame` joins the three parts for a simulator of one environment, which saves two calls per step. A simulator
of many environments calls :func:`update_vehicles` and :func:`finish_step` for each of them, and computes the CO2 of all
of them in between.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import field_writer
from izoo.emissions.kernel import emission_rate
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.commands import plan_caps, plan_commands
from izoo.envs.mdp.credit import assign_credit, count_blocked
from izoo.envs.mdp.displacement import update_motion
from izoo.envs.mdp.metric_sums import (
    APPROACH_METRICS,
    EpisodeSums,
    accumulate_cohort,
    accumulate_episode,
    accumulate_step,
    count_queues,
    record_unfinished,
)
from izoo.envs.mdp.neighbours import find_leaders, sort_lanes
from izoo.envs.mdp.observation_kernel import write_observations
from izoo.envs.mdp.reward_kernel import NUM_TERMS, compute_rewards, evaluate_terms, team_step_reward
from izoo.envs.mdp.signals import phase_of_step, read_clock
from izoo.envs.mdp.slots import first_sums, free_slots
from izoo.envs.mdp.state import EVERY_STEP, FREE, ONCE_AND_BEHIND, open_world
from izoo.envs.tables import compiled
from izoo.networks.road import APPROACHING

_write_floats, _write_ints, _write_flags = map(field_writer, (VEHICLE_FLOATS, VEHICLE_INTS, VEHICLE_FLAGS))
_write_sums, _write_episode = field_writer(APPROACH_METRICS), field_writer(EpisodeSums.names or ())


@compiled
def translate_actions(world):  # type: ignore[no-untyped-def]
    """Turn the frame's actions into commands for the coming step; return the numbers of commands, releases and caps.

    The actions are those of the present decision and apply to the agents that were there when it began. Where agents do
    not decide in every step, they apply to the agents that had to decide; for the others the last decision holds.
    """
    tables = world.tables
    begins = tables.cursor.decision_steps == 0
    for a in range(tables.agent_row.shape[0]):
        if begins:
            tables.agent_row[a] = max(tables.agent_row[a], FREE)
            tables.acting[a] = tables.agent_row[a]
        elif tables.agent_row[a] < 0:
            tables.acting[a] = -1
    if begins:
        _store_decisions(world)
    if world.rules.speeds:
        return plan_caps(world, first_sums(world))
    return plan_commands(world, first_sums(world))


@compiled
def _store_decisions(world):  # type: ignore[no-untyped-def]
    """Store the decisions of the agents that had to decide."""
    tables, frame = world.tables, world.frame
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r >= 0 and (world.rules.scope == EVERY_STEP or frame.decides[a]):
            for d in range(frame.action.shape[1]):
                tables.decision[a, d] = frame.action[a, d]
            tables.deferred[a] = frame.defer[a]
            tables.stage[a] = 1 if tables.vehicles[r].location == APPROACHING else 2


@compiled
def _must_decide(tables, rules, a):  # type: ignore[no-untyped-def]
    """Whether the agent in a slot must decide before the coming step, where agents do not decide in every step."""
    r = tables.agent_row[a]
    if r < 0 or tables.stage[a] == 0:
        return r >= 0
    return rules.scope == ONCE_AND_BEHIND and tables.stage[a] == 1 and tables.vehicles[r].location != APPROACHING


@compiled
def _any_due(tables, rules):  # type: ignore[no-untyped-def]
    due = False
    for a in range(tables.agent_row.shape[0]):
        due = due or _must_decide(tables, rules, a)
    return due


@compiled
def translate_frame_actions(world_at):  # type: ignore[no-untyped-def]
    """Call :func:`translate_actions` from Python."""
    return translate_actions(open_world(world_at))


@compiled
def update_vehicles(world):  # type: ignore[no-untyped-def]
    """Update the members' records from the simulator's report, sort them by lane, and find their leaders."""
    update_motion(world.tables, world.road, world.rules.step_s)
    sort_lanes(world.tables, world.work.lane_fill)
    find_leaders(world.tables, world.road)


@compiled
def compute_emissions(world, surrogate):  # type: ignore[no-untyped-def]
    """Write each vehicle's CO2 of the step in g, unless it is that of the step before; electric CVs emit nothing."""
    tables, rules = world.tables, world.rules
    for j in range(tables.cursor.members):
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
                surrogate,
            )
            vehicle.emission_g = rate * rules.step_s


@compiled
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
    tables, work, rules, out = world.tables, world.work, world.rules, world.frame
    base = first_sums(world)
    if measured:
        accumulate_step(world, phase_of_step(time_s, world.clock), base)
        accumulate_cohort(tables)
        count_queues(tables, base)
    read_clock(time_s, world.clock, tables.signal)
    begins = tables.cursor.decision_steps == 0
    evaluate_terms(world)
    if rules.sums:
        count_blocked(world, time_s)
        assign_credit(world)
    else:
        for a in range(tables.acting.shape[0]):
            if tables.acting[a] >= 0:
                for c in range(NUM_TERMS):
                    work.own[a, c] = tables.terms[tables.acting[a], c]
    compute_rewards(world, begins)
    if begins:
        out.team_reward[0] = 0.0
    if measured:
        out.team_reward[0] += team_step_reward(world)
    free_slots(tables, out.agent_terminated, out.agent_done, begins)
    if measured:
        accumulate_episode(tables, work.step_reward, rules.step_s, base)
        tables.cursor.decision_steps = (tables.cursor.decision_steps + 1) % rules.hold_steps
        if rules.scope != EVERY_STEP and (empty or _any_due(tables, rules)):
            tables.cursor.decision_steps = 0
        # The horizon and the end of an episode end a decision, however short.
        if tables.episode.steps == rules.control_steps or tables.episode.steps == rules.total_steps:
            tables.cursor.decision_steps = 0
    if tables.cursor.decision_steps == 0:
        write_observations(world)
        _emit(world)
    _list_wrong_lane_agents(tables)


@compiled
def make_frame(world_at, reading, surrogate, time_s, measured, empty):  # type: ignore[no-untyped-def]
    """Turn a simulator's report into the next frame; ``reading`` is an :data:`~izoo.envs.mdp.episode.Reading`."""
    world = open_world(world_at)
    lane, position, speed, signals = reading
    for j in range(world.tables.cursor.members):
        vehicle = world.tables.vehicles[world.tables.members[j]]
        vehicle.region_lane, vehicle.lane_position_m = lane[j], position[j]
        vehicle.reported_speed_mps, vehicle.signals = speed[j], signals[j]
    update_vehicles(world)
    compute_emissions(world, surrogate)
    finish_step(world, time_s, measured, empty)


@compiled
def count_unfinished(world_at):  # type: ignore[no-untyped-def]
    """Call :func:`~izoo.envs.mdp.metric_sums.record_unfinished` from Python."""
    record_unfinished(open_world(world_at).tables)


@compiled
def _list_wrong_lane_agents(tables):  # type: ignore[no-untyped-def]
    """List the agents on a lane that does not lead to their exit: the simulator may slow them for a lane change."""
    count = 0
    for j in range(tables.cursor.members):
        r = tables.members[j]
        if tables.vehicles[r].wrong_lane and tables.vehicles[r].agent >= 0:
            tables.wrong_lane_agents[count] = r
            count += 1
    tables.cursor.wrong_lane_agents = count


@compiled
def _emit(world):  # type: ignore[no-untyped-def]
    """Copy the emitted groups to the frame."""
    tables, rules, out = world.tables, world.rules, world.frame
    for a in range(tables.agent_row.shape[0]):
        row = tables.agent_row[a]
        out.mask[a] = row >= 0
        out.agent_vehicle[a] = max(row, 0)
        if rules.emit_number:
            out.number[a] = tables.vehicles[row].vehicle_number if row >= 0 else -1
        if rules.scope != EVERY_STEP:
            out.decides[a] = _must_decide(tables, rules, a)
    if rules.emit_vehicles:
        _emit_vehicles(tables.vehicles, out)
    if rules.emit_signal:
        for p in range(tables.signal.shape[0]):
            for q in range(tables.signal.shape[1]):
                out.signal_colour[p, q] = tables.signal[p, q].colour
                out.signal_time_left_s[p, q] = tables.signal[p, q].change_s
    _write_episode(tables.episode, out.episode_metrics, 0)
    if rules.emit_metrics:
        for p in range(out.approach_metrics.shape[0]):
            _write_sums(tables.sums[p], out.approach_metrics[p], 0)


@compiled
def _emit_vehicles(vehicles, out):  # type: ignore[no-untyped-def]
    """Copy the emitted fields of the first ``V`` rows; rows without a vehicle are zero."""
    for v in range(out.vehicle_floats.shape[0]):
        floats, ints, flags = out.vehicle_floats[v], out.vehicle_ints[v], out.vehicle_flags[v]
        if v < vehicles.shape[0] and vehicles[v].present:
            _write_floats(vehicles[v], floats, 0)
            _write_ints(vehicles[v], ints, 0)
            _write_flags(vehicles[v], flags, 0)
        else:
            for c in range(floats.shape[0]):
                floats[c] = 0.0
            for c in range(ints.shape[0]):
                ints[c] = 0
            for c in range(flags.shape[0]):
                flags[c] = 0
