"""The reward as a sum (``RewardConfig.sums``), in compiled code: which vehicles' terms an agent is credited with.

A vehicle counts over its whole way through the region. The fleet's sum is over all vehicles; an agent's own sum is over
itself and the vehicles behind it up to the next CV, so that the agents' shares do not overlap. A vehicle is *blocked*
if at free-flow speed it would have reached the region, and it has not. Blocked vehicles count in full, as if they stood
on the approach, or an agent could gain by blocking others.
"""

from __future__ import annotations

import numpy as np

from izoo.envs.mdp.reward_kernel import NUM_TERMS, evaluate
from izoo.envs.mdp.state import BLOCKED, NOT_DUE
from izoo.envs.tables import compiled
from izoo.networks.road import LEAVING


@compiled
def count_blocked(world, time_s):  # type: ignore[no-untyped-def]
    """Write to the records of the approaches which vehicles were blocked in the step that ended at ``time_s``.

    A vehicle whose earliest arrival falls within the step counts from then on.
    """
    tables, due = world.tables, world.by_earliest
    for p in range(tables.blocked.shape[0]):
        blocked = tables.blocked[p]
        blocked.step_vehicles, blocked.step_idle_gps = blocked.vehicles, blocked.idle_gps
    while tables.cursor.due < due.shape[0]:
        vehicle = tables.demand[due[tables.cursor.due]]
        if vehicle.earliest_s > time_s:
            break
        tables.cursor.due += 1
        if vehicle.status == NOT_DUE:
            vehicle.status = BLOCKED
            blocked = tables.blocked[vehicle.approach]
            share = (time_s - vehicle.earliest_s) / world.rules.step_s
            blocked.step_vehicles += share
            blocked.step_idle_gps += share * vehicle.idle_gps
            blocked.vehicles += 1.0
            blocked.idle_gps += vehicle.idle_gps


@compiled
def assign_credit(world):  # type: ignore[no-untyped-def]
    """Write each agent's own sum and the fleet's sum, both in units of human driving, from the members' terms."""
    tables, rules, terms, unit_g = world.tables, world.rules, world.tables.terms, world.unit_g
    own, fleet, idling, rearmost = world.work.own, world.work.fleet, world.work.idling, world.work.rearmost
    vehicles, count = tables.vehicles, tables.cursor.members
    for c in range(NUM_TERMS):
        fleet[c] = 0.0
        for a in range(own.shape[0]):
            own[a, c] = 0.0
    for p in range(rearmost.shape[0]):
        rearmost[p] = -1
    for j in range(count):
        r = tables.members[j]
        p = vehicles[r].approach
        is_last = rearmost[p] < 0 or vehicles[r].path_position_m < vehicles[rearmost[p]].path_position_m
        if is_last and vehicles[r].location != LEAVING:
            rearmost[p] = r
        slot = credited_slot(r, vehicles, count)
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
            if slot >= 0:
                own[slot, c] += terms[r, c] / unit_g[p]
    for p in range(rearmost.shape[0]):
        blocked = tables.blocked[p].step_vehicles
        if blocked <= 0.0:
            continue
        _idling_terms(tables.blocked[p].step_idle_gps / blocked, rules, vehicles[vehicles.shape[0] - 1], idling)
        slot = credited_slot(rearmost[p], vehicles, count)
        for c in range(NUM_TERMS):
            fleet[c] += blocked * idling[c]
            if slot >= 0:
                own[slot, c] += blocked * idling[c] / unit_g[p]
    for c in range(NUM_TERMS):
        fleet[c] /= rules.fleet_g_per_step


@compiled
def credited_slot(r, vehicles, most):  # type: ignore[no-untyped-def]
    """Return the slot of the nearest CV at or ahead of row ``r``, -1 if there is none.

    Vehicles behind the stop line are credited only to CVs behind it, and the others only to CVs before it.
    """
    if r < 0:
        return -1
    leaves = vehicles[r].location == LEAVING
    for _ in range(most):
        if r < 0 or (vehicles[r].location == LEAVING) != leaves:
            return -1
        if vehicles[r].agent >= 0:
            return vehicles[r].agent
        r = vehicles[r].leader
    return -1


@compiled
def _idling_terms(idle_gps, rules, vehicle, out):  # type: ignore[no-untyped-def]
    """Write the terms of a vehicle that idles for one step; ``vehicle`` is working memory."""
    vehicle.emission_g = idle_gps * rules.step_s
    vehicle.delay_s = rules.step_s
    vehicle.ttc_s = np.inf
    evaluate(vehicle, rules, out, 0)
