"""The reward as a sum (``RewardConfig.sums``), in compiled code: which vehicles' terms an agent is credited with.

A vehicle counts over its whole way through the region. The fleet's sum is over all vehicles; an agent's own sum is over
itself and the vehicles behind it up to the next CV, so that the agents' shares do not overlap. A vehicle is *blocked*
if at free-flow speed it would have reached the region, and it has not. Blocked vehicles count in full, as if they stood
on the approach, or an agent could gain by blocking others.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.reward_kernel import NUM_TERMS, evaluate
from izoo.envs.mdp.state import DUE, IDLE_GPS, VEHICLES
from izoo.networks.road import LEAVING

NOT_DUE, ENTERED, BLOCKED = 0, 1, 2
"""Status of a vehicle of the demand: could not have reached the region yet; has entered it; is blocked outside."""


@compiled(borrows=True)
def count_blocked(world, time_s):  # type: ignore[no-untyped-def]
    """Write to the working memory which vehicles were blocked in the step that ended at ``time_s``.

    A vehicle whose earliest arrival falls within the step counts from then on.
    """
    demand, tables, blocked = world.demand, world.tables, world.work.blocked
    for p in range(demand.blocked.shape[0]):
        blocked[p, VEHICLES] = demand.blocked[p, VEHICLES]
        blocked[p, IDLE_GPS] = demand.blocked[p, IDLE_GPS]
    while tables.cursor[DUE] < demand.by_earliest.shape[0]:
        number = demand.by_earliest[tables.cursor[DUE]]
        if demand.earliest_s[number] > time_s:
            break
        tables.cursor[DUE] += 1
        if demand.status[number] == NOT_DUE:
            demand.status[number] = BLOCKED
            p, idle_gps = demand.approach[number], demand.idle_gps[number]
            share = (time_s - demand.earliest_s[number]) / world.rules.step_s
            blocked[p, VEHICLES] += share
            blocked[p, IDLE_GPS] += share * idle_gps
            demand.blocked[p, VEHICLES] += 1.0
            demand.blocked[p, IDLE_GPS] += idle_gps


@compiled(borrows=True)
def assign_credit(world, rows, terms, own, fleet):  # type: ignore[no-untyped-def]
    """Write each agent's own sum and the fleet's sum, both in units of human driving.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`, with all terms evaluated.
        rows: ``[n]`` the members.
        terms: ``[C, T]`` their terms.
        own: ``[A, T]`` output, by slot.
        fleet: ``[T]`` output.
    """
    tables, rules, work = world.tables, world.rules, world.work
    vehicles = tables.vehicles
    own[:, :] = 0.0
    fleet[:] = 0.0
    rearmost, idling, blocked = work.rearmost, work.idling, work.blocked
    approaches = world.demand.blocked.shape[0]
    for p in range(approaches):
        rearmost[p] = -1
    for r in rows:
        p = vehicles[r].approach
        is_last = rearmost[p] < 0 or vehicles[r].path_position_m < vehicles[rearmost[p]].path_position_m
        if is_last and vehicles[r].location != LEAVING:
            rearmost[p] = r
        slot = credited_slot(r, vehicles, rows.shape[0])
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
            if slot >= 0:
                own[slot, c] += terms[r, c] / rules.unit_g[p]
    for p in range(approaches):
        count = blocked[p, VEHICLES]
        if count <= 0.0:
            continue
        _idling_terms(blocked[p, IDLE_GPS] / count, rules, work.idling_vehicle[0], idling)
        slot = credited_slot(rearmost[p], vehicles, rows.shape[0])
        for c in range(NUM_TERMS):
            fleet[c] += count * idling[c]
            if slot >= 0:
                own[slot, c] += count * idling[c] / rules.unit_g[p]
    for c in range(NUM_TERMS):
        fleet[c] /= rules.fleet_g_per_step


@compiled(borrows=True)
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


@compiled(borrows=True)
def _idling_terms(idle_gps, rules, vehicle, out):  # type: ignore[no-untyped-def]
    """Write the terms of a vehicle that idles for one step; ``vehicle`` is working memory."""
    vehicle.emission_g = idle_gps * rules.step_s
    vehicle.delay_s = rules.step_s
    vehicle.ttc_s = np.inf
    evaluate(vehicle, rules.reward, out)
