"""The reward in compiled code: the weighted sum of the terms of :mod:`izoo.envs.mdp.reward` for every agent."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from izoo.compiling import line_writer
from izoo.envs.mdp.reward import INDIVIDUAL, SHARED, RewardTerm
from izoo.envs.tables import compiled

NUM_TERMS, NUM_SHARED = len(INDIVIDUAL), len(SHARED)
_UPPER = np.array([term.upper for term in SHARED.values()], np.float64)


def _evaluator(terms: Iterable[RewardTerm]) -> Any:
    values = [term.value for term in terms]
    return line_writer(values, [1.0] * len(values), "vehicle, rules")


evaluate, _evaluate_shared = _evaluator(INDIVIDUAL.values()), _evaluator(SHARED.values())
"""``evaluate(vehicle, rules, out, 0)`` writes the individual terms of a vehicle."""


@compiled
def evaluate_terms(world):  # type: ignore[no-untyped-def]
    """Evaluate all terms for the members, their means ``fleet``, and the smallest value ``shared`` of each shared term.

    In an empty region the fleet means are 0, and shared terms have their upper bounds.
    """
    tables, fleet, shared, own_shared = world.tables, world.work.fleet, world.work.shared, world.work.own_shared
    for c in range(NUM_TERMS):
        fleet[c] = 0.0
    for s in range(NUM_SHARED):
        shared[s] = _UPPER[s]
    n = tables.cursor.members
    for j in range(n):
        r = tables.members[j]
        evaluate(tables.vehicles[r], world.rules, tables.terms[r], 0)
        _evaluate_shared(tables.vehicles[r], world.rules, own_shared, 0)
        for c in range(NUM_TERMS):
            fleet[c] += tables.terms[r, c]
        for s in range(NUM_SHARED):
            shared[s] = min(shared[s], own_shared[s])
    if n > 0:
        for c in range(NUM_TERMS):
            fleet[c] /= n


@compiled
def compute_rewards(world, begins):  # type: ignore[no-untyped-def]
    """Compute each agent's reward of the step, and add it to the reward, and the terms to the vector, of the decision.

    Slots that did not act (row -1) get 0, and in an empty region all rewards are 0.

    Args:
        world: the :class:`~izoo.envs.mdp.state.World`; ``work.own`` holds individual terms by slot, a leaver's
            last ones.
        begins: whether this is the first step of a decision, so that reward and vector start from 0.
    """
    work, rules, reward, vector = world.work, world.rules, world.frame.reward, world.frame.reward_vector
    own, fleet, shared, acting = work.own, work.fleet, work.shared, world.tables.acting
    for a in range(acting.shape[0]):
        work.step_reward[a] = 0.0
        if begins:
            reward[a] = 0.0
            if rules.emit_vector:
                for c in range(vector.shape[1]):
                    vector[a, c] = 0.0
        if acting[a] < 0 or world.tables.cursor.members == 0:
            continue
        total = 0.0
        for s in range(NUM_SHARED):
            total += world.shared_weights[s] * shared[s]
        for c in range(NUM_TERMS):
            total += world.weights[c] * (rules.eta * fleet[c] + (1.0 - rules.eta) * own[a, c])
        if rules.emit_vector:
            for s in range(NUM_SHARED):
                vector[a, 2 * NUM_TERMS + s] += shared[s]
            for c in range(NUM_TERMS):
                vector[a, c] += own[a, c]
                vector[a, NUM_TERMS + c] += fleet[c]
        work.step_reward[a] = total / rules.scale
        reward[a] += work.step_reward[a]


@compiled
def team_step_reward(world):  # type: ignore[no-untyped-def]
    """Return the fleet's part of the reward in a step, whether or not there are agents.

    In an empty region shared terms count as 0; of sums, the vehicles blocked outside still count.
    """
    total = 0.0
    for s in range(NUM_SHARED):
        if world.tables.cursor.members > 0:
            total += world.shared_weights[s] * world.work.shared[s]
    for c in range(NUM_TERMS):
        total += world.weights[c] * world.work.fleet[c]
    return total / world.rules.scale
