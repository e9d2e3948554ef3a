"""The reward as a sum (``RewardConfig.sums``), in compiled code: which vehicles' terms an agent is paid for.

A vehicle counts until it has crossed the stop line, as in the metrics. The fleet's sum is over all of them; an agent's
own is over itself and those behind it up to the next CV, so that these shares do not overlap. Vehicles that should have
come to the region and have not are *held up outside*. They count in full, as if they stood there, or an agent could
gain by keeping others out.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.mdp.pay import NUM_TERMS, evaluate
from izoo.envs.mdp.state import (
    AGENT,
    APPROACH,
    DELAY,
    EMISSION,
    LEADER,
    LOCATION,
    PATH_POSITION,
    SPEED,
    TTC,
)
from izoo.envs.mdp.world import DUE
from izoo.networks.road import APPROACHING, LEAVING

AWAITED, HERE, OUTSIDE = 0, 1, 2
"""What has become of a vehicle of the demand: not yet due, or due before control began; come; due, and not come."""


@compiled(borrows=True)
def count_outside(world, time_s, measured):  # type: ignore[no-untyped-def]
    """Book those who are due by now and have not come; before control begins nobody is held up yet."""
    demand, tables = world.demand, world.tables
    while tables.cursor[DUE] < demand.due_s.shape[0] and demand.due_s[tables.cursor[DUE]] <= time_s:
        number = demand.due_number[tables.cursor[DUE]]
        tables.cursor[DUE] += 1
        if measured and demand.fate[number] == AWAITED:
            demand.fate[number] = OUTSIDE
            demand.outside[demand.approach[number]] += 1


@compiled(borrows=True)
def share_out(world, rows, terms, own, fleet):  # type: ignore[no-untyped-def]
    """Write what each agent is paid for, and the fleet's sum, both in units of human driving.

    Args:
        world: the :class:`~izoo.envs.mdp.world.World`, with everyone's terms.
        rows: ``[n]`` the members.
        terms: ``[C, T]`` their terms.
        own: ``[A, T]`` output, by slot.
        fleet: ``[T]`` output.
    """
    tables, rules, outside = world.tables, world.rules, world.demand.outside
    floats, ints = tables.floats, tables.ints
    own[:, :] = 0.0
    fleet[:] = 0.0
    rearmost, standing = world.work.rearmost, world.work.standing
    for p in range(outside.shape[0]):
        rearmost[p] = -1
    for r in rows:
        if not _counts(r, floats, ints, rules.step_s):
            continue
        p = ints[r, APPROACH]
        if rearmost[p] < 0 or floats[r, PATH_POSITION] < floats[rearmost[p], PATH_POSITION]:
            rearmost[p] = r
        slot = owner(r, ints, rows.shape[0])
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
            if slot >= 0:
                own[slot, c] += terms[r, c] / rules.unit_g[p]
    for p in range(outside.shape[0]):
        if outside[p] == 0:
            continue
        _stand(rules, p, world.work.standing_row, standing)
        slot = owner(rearmost[p], ints, rows.shape[0]) if rearmost[p] >= 0 else -1
        for c in range(NUM_TERMS):
            fleet[c] += outside[p] * standing[c]
            if slot >= 0:
                own[slot, c] += outside[p] * standing[c] / rules.unit_g[p]
    for c in range(NUM_TERMS):
        fleet[c] /= rules.fleet_g_per_step


@compiled(borrows=True)
def _counts(r, floats, ints, step_s):  # type: ignore[no-untyped-def]
    """Whether a vehicle had not crossed the stop line when the step began."""
    return ints[r, LOCATION] == APPROACHING or floats[r, PATH_POSITION] < floats[r, SPEED] * step_s


@compiled(borrows=True)
def owner(r, ints, most):  # type: ignore[no-untyped-def]
    """Return the slot of the nearest CV at or ahead of row ``r``, -1 if there is none before the junction's end."""
    for _ in range(most):
        if r < 0 or ints[r, LOCATION] == LEAVING:
            return -1
        if ints[r, AGENT] >= 0:
            return ints[r, AGENT]
        r = ints[r, LEADER]
    return -1


@compiled(borrows=True)
def _stand(rules, p, floats, out):  # type: ignore[no-untyped-def]
    """Write the terms of a vehicle that stands for one step where approach ``p`` begins; ``floats [1, *]``: its row."""
    floats[0, EMISSION] = rules.idle_gps[p] * rules.step_s
    floats[0, DELAY] = rules.step_s
    floats[0, TTC] = np.inf
    evaluate(0, floats, rules.reward, out)
