"""Fixed-time signal plans where none is given: exhaustive search on a grid for the least delay."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from izoo.contexts.cities.plans import yellow_time_s
from izoo.contexts.movements import conflict, deflection_deg
from izoo.contexts.spec import IntersectionSpec, SignalPhase, SignalPlan
from izoo.networks.signals.delay import DelayModel, Movement, peak_movements

GREENS_S = np.arange(15.0, 46.0, 5.0)
"""Greens that the search tries in every phase."""
OPPOSITE_WITHIN_DEG, ASKEW_WITHIN_DEG = 45.0, 75.0
"""Approaches whose directions of travel differ from head-on by no more than this share a phase, or may share one."""
MAX_PLANS = 60_000
"""Further pairings of approaches are tried up to this number of plans."""
_RANK = {"s": 0, "r": 1, "l": 2}
_States = tuple[tuple[str, str, str], ...]
_Pairing = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _Axis:
    """Approaches that are served together, and what they see in each of their greens."""

    legs: tuple[str, ...]
    greens: tuple[_States, ...]


@functools.lru_cache(maxsize=256)
def search_plan(spec: IntersectionSpec) -> SignalPlan:
    """Return the fixed-time plan with the least total delay at peak demand.

    Opposite approaches share a through phase; where one of them has lanes for lefts alone, these get a protected phase
    after it, and other lefts are permissive. An approach without an opposite one gets a phase to itself; where it is
    not plain which are opposite, the best pairing is taken. Every green of 15 to 45 s in steps of 5 s is tried in every
    phase; yellow is 3 s, or 4 s where a limit exceeds 17 m/s. Between plans of equal delay the one with the shorter
    first greens is taken. Where the spec allows right turns on red, they show ``s``.

    Raises:
        IzooError: a lane may take a turn that leads to no exit.
    """
    movements = peak_movements(spec)
    yellow_s = yellow_time_s([leg.approach.speed_limit_mps for leg in spec.legs if leg.approach is not None])
    found: list[tuple[float, np.ndarray, list[_Axis]]] = []
    plans_left = MAX_PLANS
    for pairing in _pairings(spec, movements):
        axes = _axes(spec, movements, pairing)
        plans_left -= len(GREENS_S) ** sum(len(axis.greens) for axis in axes)
        if found and plans_left < 0:
            break
        found.append((*_best_greens(spec, axes, yellow_s), axes))
    _, greens_s, axes = min(found, key=lambda entry: entry[0])
    return _compose(spec, movements, axes, greens_s, yellow_s)


def planned(spec: IntersectionSpec) -> tuple[IntersectionSpec, SignalPlan]:
    """Return the intersection with its plan, or else with that of :func:`search_plan`, and the plan."""
    plan = spec.signal_plan or search_plan(spec)
    return dataclasses.replace(spec, signal_plan=plan), plan


def _compose(
    spec: IntersectionSpec, movements: Sequence[Movement], axes: Sequence[_Axis], greens_s: np.ndarray, yellow_s: float
) -> SignalPlan:
    """Turn axes and the greens of their phases into a plan."""
    phases: list[SignalPhase] = []
    rest_s = iter(greens_s)
    for axis in axes:
        for number, states in enumerate(axis.greens):
            onward = axis.greens[number + 1] if number + 1 < len(axis.greens) else ()
            phases.append(SignalPhase(float(next(rest_s)), _with_red_turns(spec, movements, states)))
            phases.append(SignalPhase(yellow_s, _with_red_turns(spec, movements, _yellow(states, onward))))
    return SignalPlan(tuple(phases))


def _best_greens(spec: IntersectionSpec, axes: Sequence[_Axis], yellow_s: float) -> tuple[float, np.ndarray]:
    """Return the least total delay in vehicle-seconds per hour, and the greens of all phases that give it, in order.

    The delay of an axis depends on its own greens and on the cycle alone, so it is tabulated over these; the sum of the
    tables over the whole grid is then the total delay of every plan.
    """
    steps, phase_count = len(GREENS_S), sum(len(axis.greens) for axis in axes)
    index = np.indices((steps,) * phase_count).reshape(phase_count, -1)
    # Greens are equally spaced, so the sum of the indices tells the cycle.
    sums = index.sum(axis=0)
    cycles_s = phase_count * (GREENS_S[0] + yellow_s) + (GREENS_S[1] - GREENS_S[0]) * np.arange(sums.max() + 1)
    total = np.zeros(index.shape[1])
    first = 0
    for axis in axes:
        count = len(axis.greens)
        own = np.indices((steps,) * count).reshape(count, -1).T
        model = DelayModel(spec, axis.greens)
        durations_s = np.repeat(GREENS_S[own], len(cycles_s), axis=0)
        table = model.total(durations_s, np.tile(cycles_s, len(own)), axis.legs)
        row = np.ravel_multi_index(tuple(index[first : first + count]), (steps,) * count)
        total += table[row * len(cycles_s) + sums]
        first += count
    best = int(np.argmin(total))
    return float(total[best]), GREENS_S[index[:, best]]


def _pairings(spec: IntersectionSpec, movements: Sequence[Movement]) -> list[_Pairing]:
    """Return the ways to pair opposite approaches, the most opposite first; none leaves two plainly opposite."""
    names = sorted({movement.start for movement in movements})
    askew = {
        (one, two): round(abs(deflection_deg(spec.leg(one).bearing_deg, spec.leg(two).bearing_deg)), 6)
        for one, two in itertools.combinations(names, 2)
    }
    ways = {name: [m.way for m in movements if m.start == name and m.turn != "l"] for name in names}
    pairs = [
        (one, two)
        for one, two in askew
        if askew[one, two] <= ASKEW_WITHIN_DEG and not any(conflict(a, b) for a in ways[one] for b in ways[two])
    ]
    found: list[_Pairing] = []
    for size in range(len(names) // 2, -1, -1):
        for pairing in itertools.combinations(pairs, size):
            taken = {name for pair in pairing for name in pair}
            more = any(not taken & set(pair) for pair in pairs if askew[pair] <= OPPOSITE_WITHIN_DEG)
            if len(taken) == 2 * size and not more:
                found.append(pairing)
    return sorted(found, key=lambda pairing: (-len(pairing), sum(askew[pair] for pair in pairing)))


def _axes(spec: IntersectionSpec, movements: Sequence[Movement], pairing: _Pairing) -> list[_Axis]:
    partner = dict(pairing)
    firsts = sorted({movement.start for movement in movements} - set(partner.values()))
    groups = [(name, partner[name]) if name in partner else (name,) for name in firsts]
    return [_Axis(legs, _axis_greens(spec, [m for m in movements if m.start in legs])) for legs in groups]


def _axis_greens(spec: IntersectionSpec, own: Sequence[Movement]) -> tuple[_States, ...]:
    """Return what is green in an axis's phases: everything but protected lefts, then these."""
    held = [movement for movement in own if _needs_protection(spec, own, movement)]
    through = [movement for movement in own if movement not in held]
    starts = {movement.start for movement in held}
    if len(starts) == 1:
        # Nothing comes from the other side while these lefts go, so the rest of their approach goes too.
        held = [movement for movement in own if movement.start in starts]
    return tuple(_shown(group) for group in (through, held) if group)


def _needs_protection(spec: IntersectionSpec, own: Sequence[Movement], movement: Movement) -> bool:
    """Whether a left gets a phase of its own: it has its lanes, traffic against it, and others beside it."""
    approach = spec.leg(movement.start).approach
    others = [other for other in own if other.turn != "l"]
    return (
        movement.turn == "l"
        and any(conflict(movement.way, other.way) for other in others)
        and any(other.start == movement.start for other in others)
        and approach is not None
        and all(approach.lanes[lane] == "l" for lane in movement.lanes)
    )


def _shown(group: Sequence[Movement]) -> _States:
    """Green for a group of movements: permissive for those that must yield to another of them."""

    def rank(movement: Movement) -> tuple[int, str, str]:
        return _RANK[movement.turn], movement.start, movement.end

    def yields(movement: Movement) -> bool:
        return any(rank(other) < rank(movement) and conflict(movement.way, other.way) for other in group)

    return tuple((movement.start, movement.end, "g" if yields(movement) else "G") for movement in group)


def _yellow(states: _States, onward: _States) -> _States:
    """What is shown after a green; movements that stay green in the next one do so."""
    staying = {(start, end): colour for start, end, colour in onward}
    return tuple((start, end, staying.get((start, end), "y")) for start, end, _ in states)


def _with_red_turns(spec: IntersectionSpec, movements: Sequence[Movement], states: _States) -> _States:
    shown = {(start, end) for start, end, _ in states}
    turns = [(m.start, m.end, "s") for m in movements if m.turn == "r" and (m.start, m.end) not in shown]
    return (*states, *turns) if spec.right_on_red else states
