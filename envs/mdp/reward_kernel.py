"""The reward in compiled code: the terms of :mod:`izoo.envs.mdp.reward`, summed for every agent that acted."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np

from izoo.compiling import compiled, line_writer
from izoo.envs.mdp.reward import INDIVIDUAL, SHARED, TERMS, RewardConfig, RewardTerm

NUM_TERMS, NUM_SHARED = len(INDIVIDUAL), len(SHARED)
_MOST = np.array([term.most for term in SHARED.values()], np.float64)
_NUMBERS = tuple(field.name for field in fields(RewardConfig) if field.name not in TERMS)
Numbers: Any = namedtuple("Numbers", _NUMBERS)  # type: ignore[misc]
"""What terms may depend on: the numbers of :class:`~izoo.envs.mdp.reward.RewardConfig` that are no weights."""


def reward_arrays(config: RewardConfig) -> tuple[Numbers, np.ndarray, np.ndarray]:
    """Return the numbers of a configuration, and the weights of its individual and of its shared terms."""
    numbers = Numbers(**{name: getattr(config, name) for name in _NUMBERS})
    individual, shared = ([getattr(config, option) for option in terms] for terms in (INDIVIDUAL, SHARED))
    return numbers, np.array(individual, np.float64), np.array(shared, np.float64)


def _evaluator(terms: Iterable[RewardTerm]) -> Any:
    values = [term.value for term in terms]
    return line_writer(values, [1.0] * len(values), "r, floats, numbers")


evaluate, _evaluate_shared = _evaluator(INDIVIDUAL.values()), _evaluator(SHARED.values())
"""``evaluate(r, floats, numbers, out)`` writes the individual terms of the vehicle in row ``r``."""


@compiled(borrows=True)
def reward_terms(rows, floats, numbers, terms, fleet, shared, mine):  # type: ignore[no-untyped-def]
    """Evaluate all terms for the vehicles of ``rows``.

    The fleet means of an empty region are 0, and what is shared there is what it is at most.

    Args:
        terms: ``[C, NUM_TERMS]`` individual terms, written for ``rows``.
        fleet: ``[NUM_TERMS]`` output, their means over ``rows``.
        shared: ``[NUM_SHARED]`` output, the smallest value of each shared term.
        mine: ``[NUM_SHARED]`` working memory.
    """
    fleet[:] = 0.0
    for s in range(NUM_SHARED):
        shared[s] = _MOST[s]
    n = rows.shape[0]
    for j in range(n):
        r = rows[j]
        evaluate(r, floats, numbers, terms[r])
        _evaluate_shared(r, floats, numbers, mine)
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
        for s in range(NUM_SHARED):
            shared[s] = min(shared[s], mine[s])
    if n > 0:
        for c in range(NUM_TERMS):
            fleet[c] /= n


@compiled(borrows=True)
def pay(acting_row, own, fleet, shared, numbers, weights, shared_weights, paid, reward, vector, full, empty, begins):  # type: ignore[no-untyped-def]
    """Write what each slot gets for the step, and add it to its decision's; slots that did not act (row -1) get 0.

    In an empty region everybody's reward is 0.

    Args:
        own: ``[A, T]`` individual terms by slot; a leaver's are its last.
        paid: ``[A]`` output: the step's reward.
        reward, vector: ``[A]`` and ``[A, R]``, to which the step's reward and terms are added.
        full: whether anybody reads the vector; it is left alone otherwise.
        empty: nobody is in the region.
        begins: it is the first step of a decision, so ``reward`` and ``vector`` start from 0.
    """
    for a in range(acting_row.shape[0]):
        r = acting_row[a]
        paid[a] = 0.0
        if begins:
            reward[a] = 0.0
            if full:
                vector[a, :] = 0.0
        if r < 0 or empty:
            continue
        total = 0.0
        for s in range(NUM_SHARED):
            total += shared_weights[s] * shared[s]
        for c in range(NUM_TERMS):
            total += weights[c] * (numbers.eta * fleet[c] + (1.0 - numbers.eta) * own[a, c])
        if full:
            for s in range(NUM_SHARED):
                vector[a, 2 * NUM_TERMS + s] += shared[s]
            for c in range(NUM_TERMS):
                vector[a, c] += own[a, c]
                vector[a, NUM_TERMS + c] += fleet[c]
        paid[a] = total / numbers.scale
        reward[a] += paid[a]


@compiled(borrows=True)
def team_pay(fleet, shared, numbers, weights, shared_weights, empty):  # type: ignore[no-untyped-def]
    """Return what the fleet's part of the reward was in a step, whether or not there were agents to be paid.

    In an empty region nothing is shared; of sums, those who are held up outside remain.
    """
    total = 0.0
    for s in range(NUM_SHARED):
        if not empty:
            total += shared_weights[s] * shared[s]
    for c in range(NUM_TERMS):
        total += weights[c] * fleet[c]
    return total / numbers.scale
