"""Signals: the letter that every link shows."""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.runtime.layout import TwinNet, TwinState

RED, YELLOW, OFF_YELLOW = ord("r"), ord("y"), ord("Y")
GREEN, PRIORITY_GREEN = ord("g"), ord("G")
MINOR, EQUAL, STOP, ALLWAY_STOP = ord("m"), ord("="), ord("s"), ord("w")
"""Letters of links: shown by their signal, or their own where there is none."""
UPPER_CASE, LOWER_CASE = ord("A"), ord("a")


@compiled
def update_signals(net, state, step_ms):  # type: ignore[no-untyped-def]
    """Set the letters of all signals for the coming step; as in SUMO, all switches within it come at its begin."""
    now_ms = state.clock.now_ms + step_ms - 1
    for program in range(net.programs.shape[0]):
        if now_ms < state.program_switch_ms[program]:
            continue
        first = net.programs[program].first_phase
        cycle_ms = net.programs[program].cycle_ms
        time_ms = (now_ms - net.programs[program].offset_ms) % cycle_ms
        phase, end_ms = first, cycle_ms
        for k in range(first + 1, first + net.programs[program].phases):
            if net.phases[k].begin_ms > time_ms:
                end_ms = net.phases[k].begin_ms
                break
            phase = k
        state.program_switch_ms[program] = now_ms + end_ms - time_ms
        letters = net.phases[phase].state
        for k in range(net.program_first_link[program], net.program_first_link[program + 1]):
            link = net.program_links[k]
            state.link_letter[link] = net.phase_letters[letters + net.links[link].signal]


def reset_signals(net: TwinNet, state: TwinState) -> None:
    """Begin an episode: links without a signal show their own state permanently."""
    own = net.links["program"] < 0
    state.link_letter[own] = net.links["state"][own]
    state.program_switch_ms[:] = -1


@compiled
def is_red_or_yellow(letter):  # type: ignore[no-untyped-def]
    """Whether a link that shows ``letter`` is red or yellow."""
    return letter in (RED, YELLOW, OFF_YELLOW)


@compiled
def is_green(letter):  # type: ignore[no-untyped-def]
    """Whether a signal shows green, with priority or without."""
    return letter in (GREEN, PRIORITY_GREEN)


@compiled
def is_major(letter):  # type: ignore[no-untyped-def]
    """Whether a link that shows ``letter`` has priority."""
    return UPPER_CASE <= letter < LOWER_CASE
