"""Signal programs: of the main signal by link, such that no two links wait for each other for ever, and of ghosts."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass

from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import IntersectionSpec, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.connections import Link

_REQUEST = re.compile(r'<request index="(\d+)"\s+response="([01]+)"')
_JUNCTION = re.compile(r'<junction id="TL" .*?</junction>', re.DOTALL)
_PROGRAM = re.compile(r'<tlLogic id="TL" .*?</tlLogic>', re.DOTALL)
_PLACE = re.compile(r'via=":TL_(\d+)_(\d+)" tl="TL" linkIndex="(\d+)"')
_STATE = re.compile(r'state="(\w+)"')


def main_phases(name: str, plan: SignalPlan, links: tuple[Link, ...]) -> tuple[tuple[float, str], ...]:
    """Spell the plan out by link, as ``(duration in s, state)``; movements that a phase does not name are red.

    Raises:
        IzooError: the plan has no phases, a phase without a duration, an unknown colour or movement, or a movement
            that is never green.
    """
    movements = {(link.from_leg, link.to_leg) for link in links}
    phases = []
    for number, phase in enumerate(plan.phases):
        if not 0.0 < phase.duration_s < math.inf:
            raise IzooError(
                f"intersection {name}: phase {number} of its plan lasts {phase.duration_s!r} s; give more than 0."
            )
        shown = {(start, end): colour for start, end, colour in phase.states}
        bad = [colour for colour in shown.values() if colour not in set("Ggysr")]
        if bad:
            raise IzooError(f"intersection {name}: phase {number} shows {bad[0]!r}; choose one of: G, g, y, s, r.")
        astray = sorted(set(shown) - movements)
        if astray:
            start, end = astray[0]
            raise IzooError(
                f"intersection {name}: phase {number} of its plan names the movement {start} to {end}, which no lane "
                "serves; remove it from the plan or give a lane that turn."
            )
        colours = [shown.get((link.from_leg, link.to_leg), "r") for link in links]
        phases.append((phase.duration_s, _yield_in_merges(links, colours)))
    if not phases:
        raise IzooError(f"intersection {name}: its signal plan has no phases; give at least one, or None to search.")
    for index, link in enumerate(links):
        if not any(state[index] in "Ggs" for _, state in phases):
            raise IzooError(
                f"intersection {name}: the movement {link.from_leg} to {link.to_leg} is never green in its plan; add "
                "it to a phase or take the turn from the lanes."
            )
    return tuple(phases)


def _yield_in_merges(links: tuple[Link, ...], colours: list[str]) -> str:
    """Return the state of a phase: of the lanes of an approach that merge into one, all but the leftmost yield."""
    state = list(colours)
    for number, link in enumerate(links):
        merging = any(
            (other.from_leg, other.to_leg, other.to_lane) == (link.from_leg, link.to_leg, link.to_lane)
            for other in links[number + 1 :]
        )
        if merging and state[number] == "G":
            state[number] = "g"
    return "".join(state)


def stop_mutual_waits(text: str) -> str:
    """Return the net ``text`` without turns on red where these and another link would each yield to the other.

    ``netconvert`` says which links yield to which. Two that yield to each other, both permissive in one phase, can
    stand face to face until the phase ends; the turn on red then stays red in that phase.
    """
    junction, program = _JUNCTION.search(text), _PROGRAM.search(text)
    if junction is None or program is None or "s" not in program.group(0):
        return text
    # An inside edge is named after the first of its links in the junction's own order.
    order = {int(first) + int(lane): int(index) for first, lane, index in _PLACE.findall(text)}
    yields: dict[int, set[int]] = {}
    for request, response in _REQUEST.findall(junction.group(0)):
        foes = {order[bit] for bit, flag in enumerate(reversed(response)) if flag == "1" and bit in order}
        if int(request) in order:
            yields[order[int(request)]] = foes
    mutual = [(one, two) for one in yields for two in yields[one] if one < two and one in yields.get(two, set())]

    def settle(match: re.Match[str]) -> str:
        state = list(match.group(1))
        for one, two in mutual:
            if {state[one], state[two]} <= {"g", "s"} and "s" in (state[one], state[two]):
                state[one if state[one] == "s" else two] = "r"
        return f'state="{"".join(state)}"'

    return text[: program.start()] + _STATE.sub(settle, program.group(0)) + text[program.end() :]


@dataclass(frozen=True)
class GhostProgram:
    """A ghost's program: phases of ``(duration in s, colour of the straight source, of the turning source)``."""

    offset_s: float
    phases: tuple[tuple[float, str, str], ...]


def ghost_program(spec: IntersectionSpec, plan: SignalPlan, leg: str) -> GhostProgram:
    """Return the program of the ghost at the far end of ``leg``.

    Raises:
        IzooError: a duration is not above 0, or the main signal that it repeats leaves one of the sources no green.
    """
    ghosts = spec.ghosts
    durations = [ghosts.yellow_s] + ([] if ghosts.repeats_main else [ghosts.through_green_s, ghosts.cross_green_s])
    if min(durations) <= 0.0:
        raise IzooError(f"intersection {spec.name}: the greens and the yellow of a ghost signal must exceed 0 s.")
    if ghosts.repeats_main:
        return _repeated(spec, plan, leg)
    phases = (
        (ghosts.through_green_s, "G", "r"),
        (ghosts.yellow_s, "y", "r"),
        (ghosts.cross_green_s, "r", "G"),
        (ghosts.yellow_s, "r", "y"),
    )
    return GhostProgram(ghosts.offset_s, phases)


def _repeated(spec: IntersectionSpec, plan: SignalPlan, leg: str) -> GhostProgram:
    """The straight source shows what the leg's straight movement does, later by the offset; red gives the rest."""
    runs = _straight_runs(spec, plan, leg)
    begins = [k for k, (_, colour) in enumerate(runs) if colour == "G" and runs[k - 1][1] != "G"]
    if not begins or not any(colour == "r" for _, colour in runs):
        raise IzooError(
            f"intersection {spec.name}: the ghost of leg {leg} repeats the main signal, but its straight movement is "
            f"{'always' if any(colour == 'G' for _, colour in runs) else 'never'} green; give the ghosts greens."
        )
    yellow_s = spec.ghosts.yellow_s
    phases: list[tuple[float, str, str]] = []
    for duration_s, colour in _merged(runs[begins[0] :] + runs[: begins[0]]):
        if colour != "r":
            phases.append((duration_s, colour, "r"))
        elif duration_s > yellow_s:
            phases += [(duration_s - yellow_s, "r", "G"), (yellow_s, "r", "y")]
        else:
            raise IzooError(
                f"intersection {spec.name}: the straight movement of leg {leg} is red for {duration_s:g} s, which "
                f"leaves the turning source of its ghost no green next to {yellow_s:g} s of yellow."
            )
    start_s = sum(duration_s for duration_s, _ in runs[: begins[0]])
    return GhostProgram(plan.offset_s + spec.ghosts.offset_s + start_s, tuple(phases))


def _straight_runs(spec: IntersectionSpec, plan: SignalPlan, leg: str) -> list[tuple[float, str]]:
    """Colour of the leg's straight movement over the plan."""
    exits = exits_by_turn(spec.legs, leg).get("s", ())
    runs = []
    for phase in plan.phases:
        shown = {colour for start, end, colour in phase.states if start == leg and end in exits}
        runs.append((phase.duration_s, "G" if shown & {"G", "g"} else "y" if "y" in shown else "r"))
    return runs


def _merged(runs: list[tuple[float, str]]) -> list[tuple[float, str]]:
    groups = itertools.groupby(runs, key=lambda run: run[1])
    return [(sum(duration_s for duration_s, _ in group), colour) for colour, group in groups]
