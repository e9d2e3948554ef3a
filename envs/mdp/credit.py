"""The reward as a sum (``RewardConfig.sums``), in compiled code: which vehicles' terms an agent is paid for.

A vehicle counts over its whole way in the region. The fleet's sum is over all of them; an agent's own is over itself
and those behind it up to the next CV, so that these shares do not overlap. Vehicles that could have come to the region
and have not are *blocked*. They count in full, as if they stood there, or an agent could gain by blocking others.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.columns import (
    AGENT,
    APPROACH,
    DELAY,
    EMISSION,
    LEADER,
    LOCATION,
    PATH_POSITION,
    TTC,
)
from izoo.envs.mdp.reward_kernel import NUM_TERMS, evaluate
from izoo.envs.mdp.state import DUE, IDLE_GPS, VEHICLES
from izoo.networks.road import LEAVING

AWAITED, HERE, BLOCKED = 0, 1, 2
"""What has become of a vehicle of the demand: it could not have come yet; it came; it could have come, and has not."""


@compiled(borrows=True)
def count_blocked(world, time_s):  # type: ignore[no-untyped-def]
    """Write to the working memory which vehicles were blocked in the step that ended at ``time_s``.

    One that could have come within the step counts from then on.
    """
    demand, tables, blocked = world.demand, world.tables, world.work.blocked
    for p in range(demand.blocked.shape[0]):
        blocked[p, VEHICLES] = demand.blocked[p, VEHICLES]
        blocked[p, IDLE_GPS] = demand.blocked[p, IDLE_GPS]
    while tables.cursor[DUE] < demand.next_number.shape[0]:
        number = demand.next_number[tables.cursor[DUE]]
        if demand.reach_s[number] > time_s:
            break
        tables.cursor[DUE] += 1
        if demand.fate[number] == AWAITED:
            demand.fate[number] = BLOCKED
            p, idle_gps = demand.approach[number], demand.idle_gps[number]
            share = (time_s - demand.reach_s[number]) / world.rules.step_s
            blocked[p, VEHICLES] += share
            blocked[p, IDLE_GPS] += share * idle_gps
            demand.blocked[p, VEHICLES] += 1.0
            demand.blocked[p, IDLE_GPS] += idle_gps


@compiled(borrows=True)
def share_out(world, rows, terms, own, fleet):  # type: ignore[no-untyped-def]
    """Write what each agent is paid for, and the fleet's sum, both in units of human driving.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`, with everyone's terms.
        rows: ``[n]`` the members.
        terms: ``[C, T]`` their terms.
        own: ``[A, T]`` output, by slot.
        fleet: ``[T]`` output.
    """
    tables, rules, work = world.tables, world.rules, world.work
    floats, ints = tables.floats, tables.ints
    own[:, :] = 0.0
    fleet[:] = 0.0
    rearmost, standing, blocked = work.rearmost, work.standing, work.blocked
    approaches = world.demand.blocked.shape[0]
    for p in range(approaches):
        rearmost[p] = -1
    for r in rows:
        p = ints[r, APPROACH]
        is_last = rearmost[p] < 0 or floats[r, PATH_POSITION] < floats[rearmost[p], PATH_POSITION]
        if is_last and ints[r, LOCATION] != LEAVING:
            rearmost[p] = r
        slot = owner(r, ints, rows.shape[0])
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
            if slot >= 0:
                own[slot, c] += terms[r, c] / rules.unit_g[p]
    for p in range(approaches):
        count = blocked[p, VEHICLES]
        if count <= 0.0:
            continue
        _stand(blocked[p, IDLE_GPS] / count, rules, work.standing_row, standing)
        slot = owner(rearmost[p], ints, rows.shape[0])
        for c in range(NUM_TERMS):
            fleet[c] += count * standing[c]
            if slot >= 0:
                own[slot, c] += count * standing[c] / rules.unit_g[p]
    for c in range(NUM_TERMS):
        fleet[c] /= rules.fleet_g_per_step


@compiled(borrows=True)
def owner(r, ints, most):  # type: ignore[no-untyped-def]
    """Return the slot of the nearest CV at or ahead of row ``r``, -1 if there is none.

    Of a vehicle that is leaving it is one that is leaving, and of all others none of those.
    """
    if r < 0:
        return -1
    leaves = ints[r, LOCATION] == LEAVING
    for _ in range(most):
        if r < 0 or (ints[r, LOCATION] == LEAVING) != leaves:
            return -1
        if ints[r, AGENT] >= 0:
            return ints[r, AGENT]
        r = ints[r, LEADER]
    return -1


@compiled(borrows=True)
def _stand(idle_gps, rules, floats, out):  # type: ignore[no-untyped-def]
    """Write the terms of a vehicle that stands for one step; ``floats [1, *]``: its row."""
    floats[0, EMISSION] = idle_gps * rules.step_s
    floats[0, DELAY] = rules.step_s
    floats[0, TTC] = np.inf
    evaluate(0, floats, rules.reward, out)
