"""One step of the MDP in compiled code: orders before the simulator moves, and the next frame after it has.

:func:`make_frame` joins the three parts for a simulator of one environment, which saves two calls per step; one of many
environments calls :func:`settle` and :func:`conclude` for each of them, and computes CO2 for all of them in between.
"""

from __future__ import annotations

from izoo.compiling import compiled
from izoo.emissions.kernel import emission_rate
from izoo.envs.mdp.columns import (
    ACCEL,
    AGENT,
    ELECTRIC,
    EMISSION,
    GRADE,
    LOCATION,
    MOVES_CLASS,
    NUMBER,
    PRESENT,
    SPEED,
    STEADY,
    WRONG_LANE,
)
from izoo.envs.mdp.commands import plan_caps, plan_commands
from izoo.envs.mdp.credit import count_blocked, share_out
from izoo.envs.mdp.displacement import place
from izoo.envs.mdp.metric_sums import EPISODE_METRIC, account, account_cohort, count_queues, sum_episode
from izoo.envs.mdp.neighbours import find_leaders, sort_lanes
from izoo.envs.mdp.observation_kernel import observe
from izoo.envs.mdp.reward_kernel import NUM_TERMS, pay, reward_terms, team_pay
from izoo.envs.mdp.signals import phase_driven, read_clock
from izoo.envs.mdp.slots import release
from izoo.envs.mdp.state import (
    EVERY_STEP,
    FREE,
    HELD,
    MEMBERS,
    ONCE_AND_BEHIND,
    SUSPECTS,
    sums_to_horizon,
)
from izoo.networks.road import APPROACHING

_STEPS = EPISODE_METRIC["steps"]


@compiled(borrows=True)
def take_orders(world):  # type: ignore[no-untyped-def]
    """Turn the frame's actions into orders for the coming step; return how many commands, releases and caps there are.

    The actions are those of the present decision: they are for those who were there when it began, and of them, where
    not everybody decides in every step, for those who were to; what the others decided last stays in force.
    """
    tables, frame = world.tables, world.frame
    begins = tables.cursor[HELD] == 0
    for a in range(tables.agent_row.shape[0]):
        if begins:
            tables.agent_row[a] = max(tables.agent_row[a], FREE)
            tables.acting[a] = tables.agent_row[a]
        elif tables.agent_row[a] < 0:
            tables.acting[a] = -1
    action, defer = frame.action, frame.defer
    if world.rules.scope != EVERY_STEP:
        if begins:
            _keep_decisions(tables, frame)
        action, defer = tables.decision, tables.left
    if world.rules.speeds:
        return plan_caps(
            tables.agent_row,
            tables.acting,
            action,
            defer,
            world.rules.step_s,
            world.road,
            world.rules.exit_limit_mps,
            tables.floats,
            tables.ints,
            tables.flags,
            sums_to_horizon(world),
            tables.command,
            tables.release,
            tables.target_mps,
            tables.capped,
            tables.cap_mps,
        )
    commands, releases = plan_commands(
        tables.agent_row,
        tables.acting,
        action,
        defer,
        world.rules.step_s,
        tables.floats,
        tables.ints,
        tables.flags,
        sums_to_horizon(world),
        tables.command,
        tables.release,
        tables.target_mps,
    )
    return commands, releases, 0


@compiled(borrows=True)
def _keep_decisions(tables, frame):  # type: ignore[no-untyped-def]
    """Keep what those have decided who were to."""
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r >= 0 and frame.decides[a]:
            for d in range(frame.action.shape[1]):
                tables.decision[a, d] = frame.action[a, d]
            tables.left[a] = frame.defer[a]
            tables.stage[a] = 1 if tables.ints[r, LOCATION] == APPROACHING else 2


@compiled(borrows=True)
def _is_due(tables, rules, a):  # type: ignore[no-untyped-def]
    """Whether the agent in a slot is to decide before the coming step, where not everybody does."""
    r = tables.agent_row[a]
    if r < 0 or tables.stage[a] == 0:
        return r >= 0
    return rules.scope == ONCE_AND_BEHIND and tables.stage[a] == 1 and tables.ints[r, LOCATION] != APPROACHING


@compiled(borrows=True)
def _anybody_due(tables, rules):  # type: ignore[no-untyped-def]
    due = False
    for a in range(tables.agent_row.shape[0]):
        due = due or _is_due(tables, rules, a)
    return due


@compiled
def give_orders(world):  # type: ignore[no-untyped-def]
    """Do what :func:`take_orders` does, for Python."""
    return take_orders(world)


@compiled(borrows=True)
def settle(world, reading):  # type: ignore[no-untyped-def]
    """Write where the members are into the tables, sort them, and find their leaders.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        reading: tuple of ``[n]`` arrays, in the order of the members: region lane, lane position in m, speed in m/s,
            signal bits.
    """
    tables, road = world.tables, world.road
    rows = tables.members[: tables.cursor[MEMBERS]]
    floats, ints, flags = tables.floats, tables.ints, tables.flags
    lane, position, speed, signals = reading
    place(rows, lane, position, speed, signals, floats, ints, flags, road, world.rules.step_s)
    sort_lanes(rows, floats, ints, world.work.lane_fill, tables.order, tables.lane_start)
    find_leaders(rows, floats, ints, flags, tables.order, tables.lane_start, road)


@compiled(borrows=True)
def emit_co2(world):  # type: ignore[no-untyped-def]
    """Write each member's CO2 of the step in g; electric CVs emit nothing."""
    for j in range(world.tables.cursor[MEMBERS]):
        emit_one(world, world.tables.members[j])


@compiled(borrows=True, forceinline=True)
def emit_one(world, r):  # type: ignore[no-untyped-def]
    """Write the CO2 of the vehicle in row ``r``, unless it is that of the step before."""
    tables, rules = world.tables, world.rules
    floats = tables.floats
    if tables.flags[r, STEADY]:
        return
    floats[r, EMISSION] = 0.0
    if not tables.flags[r, ELECTRIC]:
        rate = emission_rate(
            floats[r, SPEED],
            floats[r, ACCEL],
            floats[r, GRADE],
            tables.ints[r, MOVES_CLASS],
            rules.temperature_c,
            rules.humidity_pct,
            world.surrogate,
        )
        floats[r, EMISSION] = rate * rules.step_s


@compiled(borrows=True)
def conclude(world, time_s, measured, empty):  # type: ignore[no-untyped-def]
    """Count the step, pay the agents, and write the next frame.

    Within a decision, rewards add up, and who has left stays marked as terminated; what the next decision is made from
    is written at its end.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`, settled, with the members' CO2.
        time_s: simulated time after the step.
        measured: whether the step counts (the first frame of an episode does not).
        empty: whether no vehicle is in the network or will be; then a decision that lasts until somebody is to decide
            ends.
    """
    tables, work, clock, rules, out = world.tables, world.work, world.clock, world.rules, world.frame
    rows = tables.members[: tables.cursor[MEMBERS]]
    floats, ints, flags = tables.floats, tables.ints, tables.flags
    sums = sums_to_horizon(world)
    if measured:
        phase = phase_driven(time_s, clock)
        colour, legal = clock.colour[:, :, phase], clock.legal_on_red[:, :, phase]
        account(rows, floats, ints, flags, colour, legal, rules.step_s, sums)
        account_cohort(rows, floats, ints, flags, tables.sums)
        count_queues(rows, floats, ints, sums)
    read_clock(time_s, clock)
    begins = tables.cursor[HELD] == 0
    fleet, shared, paid, own = work.fleet, work.shared, work.paid, work.own
    reward_terms(rows, floats, rules.reward, tables.terms, fleet, shared, work.least)
    if rules.reward.sums:
        count_blocked(world, time_s)
        share_out(world, rows, tables.terms, own, fleet)
    else:
        for a in range(tables.acting.shape[0]):
            if tables.acting[a] >= 0:
                for c in range(NUM_TERMS):
                    own[a, c] = tables.terms[tables.acting[a], c]
    pay(
        tables.acting,
        own,
        fleet,
        shared,
        rules.reward,
        rules.weights,
        rules.shared_weights,
        paid,
        out.reward,
        out.reward_vector,
        rules.emit_vector,
        rows.shape[0] == 0,
        begins,
    )
    if begins:
        out.team_reward[0] = 0.0
    if measured:
        nobody = rows.shape[0] == 0
        out.team_reward[0] += team_pay(fleet, shared, rules.reward, rules.weights, rules.shared_weights, nobody)
    release(tables, out.agent_terminated, out.agent_done, begins)
    if measured:
        sum_episode(rows, tables.acting, floats, ints, flags, paid, rules.step_s, sums, tables.episode)
        tables.cursor[HELD] = (tables.cursor[HELD] + 1) % rules.hold_steps
        if rules.scope != EVERY_STEP and (empty or _anybody_due(tables, rules)):
            tables.cursor[HELD] = 0
        # The horizon and the end of an episode end a decision, however short.
        if tables.episode[_STEPS] == rules.control_steps or tables.episode[_STEPS] == rules.total_steps:
            tables.cursor[HELD] = 0
    if tables.cursor[HELD] == 0:
        observe(
            tables.agent_row,
            work.shown,
            tables,
            world.road,
            clock,
            rules.features,
            rules.columns,
            rules.sensor_range_m,
            out.observation,
        )
        _emit(world)
    _find_suspects(rows, tables)


@compiled
def make_frame(world, reading, time_s, measured, empty):  # type: ignore[no-untyped-def]
    """Turn what a simulator reported into the next frame: :func:`settle`, :func:`emit_co2`, :func:`conclude`."""
    settle(world, reading)
    emit_co2(world)
    conclude(world, time_s, measured, empty)


@compiled(borrows=True)
def _find_suspects(rows, tables):  # type: ignore[no-untyped-def]
    """List the agents on a lane that does not lead to their exit: the simulator may slow them for a lane change."""
    count = 0
    for r in rows:
        if tables.flags[r, WRONG_LANE] and tables.ints[r, AGENT] >= 0:
            tables.suspects[count] = r
            count += 1
    tables.cursor[SUSPECTS] = count


@compiled(borrows=True)
def _emit(world):  # type: ignore[no-untyped-def]
    """Copy to the frame what its groups hold."""
    tables, clock, rules, out = world.tables, world.clock, world.rules, world.frame
    for a in range(tables.agent_row.shape[0]):
        out.mask[a] = tables.agent_row[a] >= 0
        out.agent_vehicle[a] = max(tables.agent_row[a], 0)
    if rules.emit_number:
        for a in range(tables.agent_row.shape[0]):
            row = tables.agent_row[a]
            out.number[a] = tables.ints[row, NUMBER] if row >= 0 else -1
    if rules.scope != EVERY_STEP:
        for a in range(tables.agent_row.shape[0]):
            out.decides[a] = _is_due(tables, rules, a)
    if rules.emit_vehicles:
        emit_vehicles(tables.floats, tables.ints, tables.flags, out.vehicle_floats, out.vehicle_ints, out.vehicle_flags)
    if rules.emit_signal:
        _copy_into(out.signal_colour, clock.now)
        _copy_into(out.signal_time_left_s, clock.time_left_s)
    for k in range(tables.episode.shape[0]):
        out.episode_metrics[k] = tables.episode[k]
    if rules.emit_metrics:
        _copy_into(out.approach_metrics, tables.sums)


@compiled(borrows=True)
def emit_vehicles(floats, ints, flags, floats_out, ints_out, flags_out):  # type: ignore[no-untyped-def]
    """Copy the emitted columns of the first ``V`` rows; rows without a vehicle are zero."""
    for v in range(floats_out.shape[0]):
        if v < flags.shape[0] and flags[v, PRESENT]:
            for c in range(floats_out.shape[1]):
                floats_out[v, c] = floats[v, c]
            for c in range(ints_out.shape[1]):
                ints_out[v, c] = ints[v, c]
            for c in range(flags_out.shape[1]):
                flags_out[v, c] = flags[v, c]
        else:
            floats_out[v, :] = 0.0
            ints_out[v, :] = 0
            flags_out[v, :] = 0


@compiled(borrows=True)
def _copy_into(target, source):  # type: ignore[no-untyped-def]
    """Copy a table to the upper left corner of one that is no smaller.

    A slice assignment would compile the text of an error message that never comes: 2 s each.
    """
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]
