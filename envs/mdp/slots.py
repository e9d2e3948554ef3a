"""Rows for vehicles and slots for agents, in compiled code.

A vehicle keeps its row, and a CV its agent slot, from entering the controlled region until it leaves. A freed row is
reused from the next step on, and a freed agent slot from the next decision on, so that ``next`` never shows another
vehicle in a leaver's place; the lowest free number is used first.
"""

from __future__ import annotations

from izoo.compiling import compiled
from izoo.envs.mdp.credit import BLOCKED, ENTERED
from izoo.envs.mdp.metric_sums import EPISODE_METRIC, METRIC, record_entry
from izoo.envs.mdp.state import FREE, FREED, IDLE_GPS, LEAVERS, MEMBERS, VEHICLES, sums_to_horizon

_STEPS = EPISODE_METRIC["steps"]
_UNSLOTTED = EPISODE_METRIC["unslotted"]
_COHORT_LEFT = METRIC["cohort_left"]


@compiled(borrows=True)
def admit(world, number, accel_mps2, counted):  # type: ignore[no-untyped-def]
    """Give a vehicle that has entered the region a row, and a CV an agent slot; return the row, -1 if all are taken.

    A CV for which no slot is free, or whose row is not emitted, is left to its own driver and counted.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`.
        number: of the vehicle in the episode's demand.
        accel_mps2: its acceleration in the last step.
        counted: whether it entered after the warm-up.
    """
    tables, demand = world.tables, world.demand
    vehicles = tables.vehicles
    row, capacity = 0, vehicles.shape[0]
    while row < capacity and vehicles[row].present:
        row += 1
    if row == capacity:
        return -1
    vehicle = vehicles[row]
    is_cv, approach = demand.is_cv[number], demand.approach[number]
    vehicle.present, vehicle.fresh = 1, 1
    vehicle.is_cv, vehicle.counted, vehicle.cohort = is_cv, counted, demand.cohort[number]
    vehicle.electric = is_cv and world.rules.electric
    vehicle.length_m, vehicle.accel_mps2 = demand.length_m[number], accel_mps2
    vehicle.entry_m = -world.road.lane_length_m[approach]
    vehicle.vehicle_number, vehicle.moves_class = number, demand.moves_class[number]
    vehicle.approach, vehicle.exit = approach, demand.exit[number]
    vehicle.agent = vehicle.leader = -1
    vehicle.deferred = vehicle.crossed = vehicle.commanded = vehicle.yielding = 0
    vehicle.target_mps = vehicle.cap_mps = 0.0
    if demand.status[number] == BLOCKED:
        demand.blocked[approach, VEHICLES] -= 1.0
        demand.blocked[approach, IDLE_GPS] -= demand.idle_gps[number]
    demand.status[number] = ENTERED
    demand.arrival_step[number] = int(tables.episode[_STEPS])
    tables.members[tables.cursor[MEMBERS]] = row
    tables.cursor[MEMBERS] += 1
    record_entry(vehicle, sums_to_horizon(world))
    if is_cv:
        _assign_slot(row, tables, world.rules.num_vehicles)
    return row


@compiled(borrows=True)
def _assign_slot(row, tables, num_vehicles):  # type: ignore[no-untyped-def]
    if row < num_vehicles:
        for slot in range(tables.agent_row.shape[0]):
            if tables.agent_row[slot] == FREE:
                tables.agent_row[slot], tables.vehicles[row].agent = row, slot
                tables.stage[slot] = 0
                return
    tables.episode[_UNSLOTTED] += 1


@compiled(borrows=True)
def release(world, row):  # type: ignore[no-untyped-def]
    """Remove the vehicle of a row from the members; its row and slot stay taken until the step is finished."""
    tables = world.tables
    kept = 0
    for j in range(tables.cursor[MEMBERS]):
        member = tables.members[j]
        if member != row:
            tables.members[kept] = member
            kept += 1
    tables.cursor[MEMBERS] = kept
    tables.leavers[tables.cursor[LEAVERS]] = row
    tables.cursor[LEAVERS] += 1
    tables.sums[tables.vehicles[row].approach, _COHORT_LEFT] += tables.vehicles[row].cohort


@compiled
def admit_vehicle(world, number, accel_mps2, counted):  # type: ignore[no-untyped-def]
    """Call :func:`admit` from Python."""
    return admit(world, number, accel_mps2, counted)


@compiled
def release_vehicle(world, row):  # type: ignore[no-untyped-def]
    """Call :func:`release` from Python."""
    release(world, row)


@compiled(borrows=True)
def free_slots(tables, terminated, done, begins):  # type: ignore[no-untyped-def]
    """Free the rows and slots of the vehicles that left in this step; mark the slots ``[A]`` as terminated and done.

    Marks of earlier steps stay unless this one ``begins`` a decision.
    """
    if begins:
        for slot in range(terminated.shape[0]):
            terminated[slot] = 0
            done[slot] = 0
    for j in range(tables.cursor[LEAVERS]):
        row = tables.leavers[j]
        slot = tables.vehicles[row].agent
        tables.vehicles[row].present = 0
        if slot >= 0:
            tables.agent_row[slot] = FREED
            terminated[slot] = 1
            done[slot] = 1
    tables.cursor[LEAVERS] = 0
