"""Signal programs of the ghost intersections that feed an approach."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import IntersectionSpec, SignalPlan
from izoo.errors import IzooError


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
