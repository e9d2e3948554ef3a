"""The fixed-time plan of the main signal, seen from a movement.

All tables are indexed by movement ``[P, Q]`` and phase ``[K]``; times count from the beginning of the phase, so the
clock at time ``t`` is a table entry minus the time already spent in the phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from izoo.errors import IzooError
from izoo.networks.representable import main_program, offset_s

GREEN, YELLOW, RED = 0, 1, 2
NEVER_S = 300.0
"""The longest time reported: for a change or a green that never comes (a movement without green, or always green)."""
_COLOUR = {"G": GREEN, "g": GREEN, "y": YELLOW, "Y": YELLOW}


def to_ms(time_s: float) -> int:
    """Return SUMO's integer time: whole milliseconds, halves rounded up."""
    return math.floor(time_s * 1000.0 + 0.5)


@dataclass(frozen=True)
class SignalClock:
    """Tables of one plan.

    Attributes:
        cycle_s, offset_s: length of the cycle; when its first phase begins.
        phase_begin_s: ``[K]`` beginning of each phase within the cycle.
        colour: ``[P, Q, K]`` int8: 0 green (``G`` or ``g``), 1 yellow, 2 red.
        permissive: ``[P, Q, K]`` bool: green, but yielding to others on every link (``g``).
        legal_on_red: ``[P, Q, K]`` bool: crossing on red after a stop is legal (``s``).
        change_s: ``[P, Q, K]`` from the phase's beginning until the colour changes; infinite if it never does.
        second_green_s, third_green_s: ``[P, Q, K]`` until the second and third green interval begin; a current green
            counts as the first.
        green_s, red_s: ``[P, Q]`` green per cycle, and the rest of the cycle.
    """

    cycle_s: float
    offset_s: float
    phase_begin_s: np.ndarray
    colour: np.ndarray
    permissive: np.ndarray
    legal_on_red: np.ndarray
    change_s: np.ndarray
    second_green_s: np.ndarray
    third_green_s: np.ndarray
    green_s: np.ndarray
    red_s: np.ndarray


def read_clock(root: Any, links: dict[tuple[int, int], list[int]], path: str) -> SignalClock:
    """Build the tables from the net's ``<tlLogic id="TL">``; of several programs the last, which SUMO plays.

    Times are those of SUMO, in whole milliseconds: a finer duration would let the clock drift, cycle by cycle.

    Args:
        root: the ``<net>`` element.
        links: link indices of each movement ``(p, q)`` at the signal.
        path: name of the file, for messages.

    Raises:
        IzooError: the program cannot be represented (:mod:`izoo.networks.representable`) or is not complete.
    """
    program = main_program(root, path)
    phases = program.findall("phase")
    given = [float(phase.get("duration")) for phase in phases]
    if not all(0.0 < duration_s < math.inf and to_ms(duration_s) for duration_s in given):
        raise IzooError(f"{path}: the signal program TL has a phase without a positive duration; repair the net.")
    duration = np.array([to_ms(duration_s) / 1000.0 for duration_s in given])
    states = [phase.get("state") for phase in phases]
    width = min(len(state) for state in states)
    if any(link >= width for indices in links.values() for link in indices):
        raise IzooError(f"{path}: the signal program TL has fewer states than the junction has links; repair the net.")
    shape = (1 + max(p for p, _ in links), 1 + max(q for _, q in links)) if links else (0, 0)
    colour = np.full((*shape, len(phases)), RED, np.int8)
    permissive, legal = np.zeros(colour.shape, bool), np.zeros(colour.shape, bool)
    for (p, q), indices in links.items():
        for k, state in enumerate(states):
            colour[p, q, k] = min(_COLOUR.get(state[link], RED) for link in indices)
            permissive[p, q, k] = {state[link] for link in indices} & {"g", "G"} == {"g"}
            legal[p, q, k] = any(state[link] == "s" for link in indices)
    return make_clock(duration, colour, permissive, legal, to_ms(offset_s(program)) / 1000.0)


def make_clock(
    duration_s: np.ndarray, colour: np.ndarray, permissive: np.ndarray, legal_on_red: np.ndarray, offset_s: float
) -> SignalClock:
    """Derive all tables from phase durations ``[K]`` and colours ``[P, Q, K]``."""
    begin = np.concatenate([[0.0], np.cumsum(duration_s)[:-1]])
    durations = duration_s.tolist()
    rows = [_look_ahead(row, durations) for row in colour.reshape(-1, colour.shape[-1]).tolist()]
    change, second, third = np.array(rows, float).reshape(*colour.shape, 3).transpose(3, 0, 1, 2)
    green_s = ((colour == GREEN) * duration_s).sum(axis=-1)
    cycle_s = float(duration_s.sum())
    shown, times = (colour, permissive, legal_on_red), (change, second, third)
    return SignalClock(cycle_s, offset_s, begin, *shown, *times, green_s, cycle_s - green_s)


def _look_ahead(colour: list[int], duration_s: list[float]) -> list[tuple[float, float, float]]:
    """Return, of each phase, the time from its beginning to the next colour change, and to the second and third green
    interval."""
    count = len(duration_s)
    if len(set(colour)) == 1:
        return [(np.inf, np.inf, np.inf)] * count
    found = []
    for k in range(count):
        change, elapsed_s = np.inf, 0.0
        greens = [0.0] if colour[k] == GREEN else []
        for step in range(3 * count):
            elapsed_s += duration_s[(k + step) % count]
            before, now = colour[(k + step) % count], colour[(k + step + 1) % count]
            if now != before:
                change = min(change, elapsed_s)
                greens += [elapsed_s] if now == GREEN else []
                if len(greens) == 3:
                    break
        second, third, *_ = [*greens, np.inf, np.inf, np.inf][1:]
        found.append((change, second, third))
    return found
