"""The signal clock in compiled code."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from izoo.compiling import compiled
from izoo.networks.clock import NEVER_S, SignalClock

_TICK_S = 0.001
"""Simulators keep time in milliseconds."""


class ClockArrays(NamedTuple):
    """Tables of :class:`~izoo.networks.clock.SignalClock`, and the clock's present state ``[P, Q]``."""

    cycle_s: float
    offset_s: float
    phase_begin_s: np.ndarray
    colour: np.ndarray
    legal_on_red: np.ndarray
    change_s: np.ndarray
    second_green_s: np.ndarray
    third_green_s: np.ndarray
    now: np.ndarray
    time_left_s: np.ndarray
    until_second_s: np.ndarray
    until_third_s: np.ndarray


def clock_arrays(clock: SignalClock) -> ClockArrays:
    """Return the arrays of a clock, with the state not yet read."""
    shape = clock.colour.shape[:2]
    tables: dict[str, Any] = {name: getattr(clock, name) for name in ClockArrays._fields[:8]}
    state: dict[str, Any] = {name: np.zeros(shape) for name in ClockArrays._fields[9:]}
    return ClockArrays(**tables, now=np.zeros(shape, np.int64), **state)


@compiled(borrows=True)
def phase_of_step(time_s, clock):  # type: ignore[no-untyped-def]
    """Return the phase that was in force during the step that ended at ``time_s``.

    Simulators make every switch that falls in a step at its begin, so this is the phase of its last millisecond.
    """
    return _phase_at(time_s - _TICK_S, clock)[0]


@compiled(borrows=True)
def _phase_at(time_s, clock):  # type: ignore[no-untyped-def]
    """Return the phase that is in force from ``time_s`` on, and the time since it began."""
    in_cycle = (time_s - clock.offset_s) % clock.cycle_s
    if clock.cycle_s - in_cycle < 1e-6:  # the end of a cycle is the beginning of the next
        in_cycle = 0.0
    phase = 0
    while phase + 1 < clock.phase_begin_s.shape[0] and clock.phase_begin_s[phase + 1] <= in_cycle + 1e-6:
        phase += 1
    return phase, in_cycle - clock.phase_begin_s[phase]


@compiled(borrows=True)
def read_clock(time_s, clock):  # type: ignore[no-untyped-def]
    """Evaluate a :class:`ClockArrays` at ``time_s`` for all movements ``[P, Q]``.

    ``now`` gets the colour (0 green, 1 yellow, 2 red) in force from ``time_s`` on, the others seconds from ``time_s``,
    at most ``NEVER_S``.
    """
    phase, elapsed = _phase_at(time_s, clock)
    for p in range(clock.now.shape[0]):
        for q in range(clock.now.shape[1]):
            clock.now[p, q] = clock.colour[p, q, phase]
            clock.time_left_s[p, q] = min(max(clock.change_s[p, q, phase] - elapsed, 0.0), NEVER_S)
            clock.until_second_s[p, q] = min(max(clock.second_green_s[p, q, phase] - elapsed, 0.0), NEVER_S)
            clock.until_third_s[p, q] = min(max(clock.third_green_s[p, q, phase] - elapsed, 0.0), NEVER_S)
