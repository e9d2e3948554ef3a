"""The reward in compiled code: the weighted sum of the terms of :mod:`izoo.envs.mdp.reward` for every agent."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np

from izoo.compiling import compiled, line_writer
from izoo.envs.mdp.reward import INDIVIDUAL, SHARED, TERMS, RewardConfig, RewardTerm

NUM_TERMS, NUM_SHARED = len(INDIVIDUAL), len(SHARED)
_UPPER = np.array([term.upper for term in SHARED.values()], np.float64)
_NUMBERS = tuple(field.name for field in fields(RewardConfig) if field.name not in TERMS)
Numbers: Any = namedtuple("Numbers", _NUMBERS)  # type: ignore[misc]
"""Fields of :class:`~izoo.envs.mdp.reward.RewardConfig` other than weights, on which terms may depend."""


def reward_arrays(config: RewardConfig) -> tuple[Numbers, np.ndarray, np.ndarray]:
    """Return the numbers of a configuration, and the weights of its individual and of its shared terms."""
    numbers = Numbers(**{name: getattr(config, name) for name in _NUMBERS})
    individual, shared = ([getattr(config, option) for option in terms] for terms in (INDIVIDUAL, SHARED))
    return numbers, np.array(individual, np.float64), np.array(shared, np.float64)


def _evaluator(terms: Iterable[RewardTerm]) -> Any:
    values = [term.value for term in terms]
    return line_writer(values, [1.0] * len(values), "vehicle, numbers")


evaluate, _evaluate_shared = _evaluator(INDIVIDUAL.values()), _evaluator(SHARED.values())
"""``evaluate(vehicle, numbers, out)`` writes the individual terms of a vehicle."""


@compiled(borrows=True)
def evaluate_terms(rows, vehicles, numbers, terms, fleet, shared, own_shared):  # type: ignore[no-untyped-def]
    """Evaluate all terms for the vehicles of ``rows``.

    In an empty region the fleet means are 0, and shared terms have their upper bounds.

    Args:
        terms: ``[C, NUM_TERMS]`` individual terms, written for ``rows``.
        fleet: ``[NUM_TERMS]`` output, their means over ``rows``.
        shared: ``[NUM_SHARED]`` output, the smallest value of each shared term.
        own_shared: ``[NUM_SHARED]`` working memory.
    """
    fleet[:] = 0.0
    for s in range(NUM_SHARED):
        shared[s] = _UPPER[s]
    n = rows.shape[0]
    for j in range(n):
        r = rows[j]
        evaluate(vehicles[r], numbers, terms[r])
        _evaluate_shared(vehicles[r], numbers, own_shared)
        for c in range(NUM_TERMS):
            fleet[c] += terms[r, c]
        for s in range(NUM_SHARED):
            shared[s] = min(shared[s], own_shared[s])
    if n > 0:
        for c in range(NUM_TERMS):
            fleet[c] /= n


@compiled(borrows=True)
def compute_rewards(acting, work, rules, frame, empty, begins):  # type: ignore[no-untyped-def]
    """Compute each agent's reward of the step, and add it to the reward of the decision.

    Slots that did not act (row -1) get 0, and in an empty region all rewards are 0.

    Args:
        acting: ``[A]`` rows of the agents that acted.
        work: reads ``own [A, T]`` individual terms by slot (of a leaver its last ones), ``fleet`` and ``shared``;
            writes ``step_reward [A]``.
        rules: ``reward``, ``weights``, ``shared_weights``; ``emit_vector``: whether the vector is written.
        frame: ``reward [A]`` and ``reward_vector [A, R]``, to which the step's reward and terms are added.
        empty: whether the region is empty.
        begins: whether this is the first step of a decision, so that ``reward`` and ``reward_vector`` start from 0.
    """
    own, fleet, shared, numbers, vector = work.own, work.fleet, work.shared, rules.reward, frame.reward_vector
    for a in range(acting.shape[0]):
        work.step_reward[a] = 0.0
        if begins:
            frame.reward[a] = 0.0
            if rules.emit_vector:
                vector[a, :] = 0.0
        if acting[a] < 0 or empty:
            continue
        total = 0.0
        for s in range(NUM_SHARED):
            total += rules.shared_weights[s] * shared[s]
        for c in range(NUM_TERMS):
            total += rules.weights[c] * (numbers.eta * fleet[c] + (1.0 - numbers.eta) * own[a, c])
        if rules.emit_vector:
            for s in range(NUM_SHARED):
                vector[a, 2 * NUM_TERMS + s] += shared[s]
            for c in range(NUM_TERMS):
                vector[a, c] += own[a, c]
                vector[a, NUM_TERMS + c] += fleet[c]
        work.step_reward[a] = total / numbers.scale
        frame.reward[a] += work.step_reward[a]


@compiled(borrows=True)
def team_step_reward(work, rules, empty):  # type: ignore[no-untyped-def]
    """Return the fleet's part of the reward in a step, whether or not there are agents.

    In an empty region shared terms count as 0; of sums, the vehicles blocked outside still count.
    """
    total = 0.0
    for s in range(NUM_SHARED):
        if not empty:
            total += rules.shared_weights[s] * work.shared[s]
    for c in range(NUM_TERMS):
        total += rules.weights[c] * work.fleet[c]
    return total / rules.reward.scale
