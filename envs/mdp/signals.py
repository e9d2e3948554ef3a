"""The signal clock in compiled code."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from izoo.envs.tables import Float1, compiled, tables_type
from izoo.networks.clock import NEVER_S, SignalClock

_TICK_S = 0.001
"""Simulators keep time in milliseconds."""
Timing = np.dtype([("cycle_s", "f8"), ("offset_s", "f8")])
Shown = np.dtype(
    [
        *((name, "f8") for name in ("change_s", "second_green_s", "third_green_s")),
        ("colour", "i4"),
        ("legal_on_red", "i4"),
    ]
)
"""What a movement is shown, with the names of :class:`~izoo.networks.clock.SignalClock`; its times count from the
beginning of a phase, or, in the present state, from now."""


class Clock(NamedTuple):
    """Tables of :class:`~izoo.networks.clock.SignalClock`.

    Attributes:
        timing: a record, :data:`Timing`.
        phase_begin_s: ``[K]``.
        green_s: ``[P * Q]`` green per cycle.
        shown: ``[P * Q, K]``, records of :data:`Shown`.
    """

    timing: Annotated[np.ndarray, Timing, 0]
    phase_begin_s: Float1
    green_s: Float1
    shown: Annotated[np.ndarray, Shown, 2]


CLOCK = tables_type(Clock, constant=True)


def clock_tables(clock: SignalClock) -> Clock:
    """Return the tables of a clock."""
    shown = np.zeros(clock.colour.shape, Shown)
    for name in Shown.names:  # type: ignore[union-attr]
        shown[name] = getattr(clock, name)
    timing = np.array((clock.cycle_s, clock.offset_s), Timing)
    begins, green_s = (np.ascontiguousarray(values, float) for values in (clock.phase_begin_s, clock.green_s.ravel()))
    return Clock(timing, begins, green_s, shown.reshape(-1, clock.colour.shape[-1]))


@compiled
def phase_of_step(time_s, clock):  # type: ignore[no-untyped-def]
    """Return the phase that was in force during the step that ended at ``time_s``.

    Simulators make every switch that falls in a step at its begin, so this is the phase of its last millisecond.
    """
    return _phase_at(time_s - _TICK_S, clock)[0]


@compiled
def _phase_at(time_s, clock):  # type: ignore[no-untyped-def]
    """Return the phase that is in force from ``time_s`` on, and the time since it began."""
    cycle_s = clock.timing.cycle_s
    in_cycle = (time_s - clock.timing.offset_s) % cycle_s
    if cycle_s - in_cycle < 1e-6:  # the end of a cycle is the beginning of the next
        in_cycle = 0.0
    phase = 0
    while phase + 1 < clock.phase_begin_s.shape[0] and clock.phase_begin_s[phase + 1] <= in_cycle + 1e-6:
        phase += 1
    return phase, in_cycle - clock.phase_begin_s[phase]


@compiled
def read_clock(time_s, clock, signal):  # type: ignore[no-untyped-def]
    """Write what is in force from ``time_s`` on to the records ``signal [P, Q]``.

    That is the colour (0 green, 1 yellow, 2 red), whether a turn on red is legal, and the seconds until changes, at
    most ``NEVER_S``.
    """
    phase, elapsed = _phase_at(time_s, clock)
    for p in range(signal.shape[0]):
        for q in range(signal.shape[1]):
            shown, now = clock.shown[p * signal.shape[1] + q, phase], signal[p, q]
            now.colour, now.legal_on_red = shown.colour, shown.legal_on_red
            now.change_s = min(max(shown.change_s - elapsed, 0.0), NEVER_S)
            now.second_green_s = min(max(shown.second_green_s - elapsed, 0.0), NEVER_S)
            now.third_green_s = min(max(shown.third_green_s - elapsed, 0.0), NEVER_S)
