"""Rows for vehicles and slots for agents, in compiled code.

A vehicle keeps its row, and a CV its agent slot, from entering the controlled region until it leaves. A freed row is
reused from the next step on, and a freed agent slot from the next decision on, so that ``next`` never shows another
vehicle in a leaver's place; the lowest free number is used first.
"""

from __future__ import annotations

from izoo.envs.mdp.metric_sums import record_entry
from izoo.envs.mdp.state import BLOCKED, ENTERED, FREE, FREED, open_world
from izoo.envs.tables import compiled


@compiled
def first_sums(world):  # type: ignore[no-untyped-def]
    """Return the first row of ``tables.sums`` for the coming step: after the horizon, of those that are discarded."""
    before_horizon = world.tables.episode.steps < world.rules.control_steps
    return 0 if before_horizon else world.tables.sums.shape[0] // 2


@compiled
def admit(world, number, accel_mps2, counted):  # type: ignore[no-untyped-def]
    """Give a vehicle that has entered the region a row, and a CV an agent slot; return the row.

    A CV for which no slot is free, or whose row is not emitted, is left to its own driver and counted.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        number: of the vehicle in the episode's demand.
        accel_mps2: its acceleration in the last step.
        counted: whether it entered after the warm-up.
    """
    tables = world.tables
    row = 0
    while tables.vehicles[row].present:  # there is a row for every vehicle of the demand
        row += 1
    vehicle, demand = tables.vehicles[row], tables.demand[number]
    blocked = tables.blocked[demand.approach]
    vehicle.present = vehicle.fresh = 1
    vehicle.is_cv, vehicle.counted, vehicle.cohort = demand.is_cv, counted, demand.cohort
    vehicle.electric = demand.is_cv and world.rules.electric
    vehicle.length_m, vehicle.accel_mps2 = demand.length_m, accel_mps2
    vehicle.entry_m = -world.road.lane_length_m[demand.approach]
    vehicle.vehicle_number, vehicle.moves_class = number, demand.moves_class
    vehicle.approach, vehicle.exit = demand.approach, demand.exit
    vehicle.agent = vehicle.leader = -1
    vehicle.deferred = vehicle.crossed = vehicle.commanded = vehicle.yielding = 0
    vehicle.emission_g = vehicle.target_mps = vehicle.cap_mps = 0.0
    if demand.status == BLOCKED:
        blocked.vehicles -= 1.0
        blocked.idle_gps -= demand.idle_gps
    demand.status, demand.row = ENTERED, row
    demand.arrival_step = int(tables.episode.steps)
    tables.members[tables.cursor.members] = row
    tables.cursor.members += 1
    record_entry(vehicle, tables.sums[first_sums(world) + demand.approach])
    if demand.is_cv:
        _assign_slot(row, tables, world.rules.num_vehicles)
    return row


@compiled
def _assign_slot(row, tables, num_vehicles):  # type: ignore[no-untyped-def]
    if row < num_vehicles:
        for slot in range(tables.agent_row.shape[0]):
            if tables.agent_row[slot] == FREE:
                tables.agent_row[slot], tables.vehicles[row].agent = row, slot
                tables.stage[slot] = 0
                return
    tables.episode.unslotted += 1


@compiled
def release(world, row):  # type: ignore[no-untyped-def]
    """Remove the vehicle of a row from the members; its row and slot stay taken until the step is finished."""
    tables = world.tables
    vehicle = tables.vehicles[row]
    kept = 0
    for j in range(tables.cursor.members):
        member = tables.members[j]
        if member != row:
            tables.members[kept] = member
            kept += 1
    tables.cursor.members = kept
    tables.leavers[tables.cursor.leavers] = row
    tables.cursor.leavers += 1
    tables.demand[vehicle.vehicle_number].row = -1
    tables.sums[vehicle.approach].cohort_left += vehicle.cohort


@compiled
def admit_vehicle(world_at, number, accel_mps2, counted):  # type: ignore[no-untyped-def]
    """Call :func:`admit` from Python."""
    return admit(open_world(world_at), number, accel_mps2, counted)


@compiled
def release_vehicle(world_at, row):  # type: ignore[no-untyped-def]
    """Call :func:`release` from Python."""
    release(open_world(world_at), row)


@compiled
def free_slots(tables, terminated, done, begins):  # type: ignore[no-untyped-def]
    """Free the rows and slots of the vehicles that left in this step; mark the slots ``[A]`` as terminated and done.

    Marks of earlier steps stay unless this one ``begins`` a decision.
    """
    if begins:
        for slot in range(terminated.shape[0]):
            terminated[slot] = done[slot] = 0
    for j in range(tables.cursor.leavers):
        vehicle = tables.vehicles[tables.leavers[j]]
        vehicle.present = 0
        if vehicle.agent >= 0:
            tables.agent_row[vehicle.agent] = FREED
            terminated[vehicle.agent] = done[vehicle.agent] = 1
    tables.cursor.leavers = 0
