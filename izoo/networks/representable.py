"""What a finished net may have: a net with anything else would be played by SUMO and seen otherwise by izoo.

One list, for the import, for what is observed, and so for both simulators. What SUMO plays and the twin alone does not
know stands in :mod:`izoo.envs.twin.net.supported`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

from izoo.errors import IzooError

MAIN = "TL"
LETTERS = "GgYyrus"
"""What the main signal may show: green (yielding: ``g``), yellow, red, red and yellow, a turn on red after a stop."""
CAR = "passenger"
"""The class of every vehicle of izoo's traffic."""
_ALL = "all"
_OFF_PROGRAM = "off"
_NO = ("0", "false", "f", "no", "off", "-")
"""Words that SUMO reads as false."""


def check_representable(root: Any, path: str) -> None:
    """Refuse a net that would be seen otherwise than it is played.

    Raises:
        IzooError: it has a feature that cannot be represented; the message names the first, and the remedy.
    """
    for feature, remedy in itertools.chain(_sides(root), _programs(root), _uncontrolled(root)):
        raise IzooError(f"{path}: {feature}; {remedy}.")


def main_program(root: Any, path: str) -> Any:
    """Return the program of the main signal, with its phases: of several the last, which SUMO plays.

    Raises:
        IzooError: there is none.
    """
    found = [logic for logic in root.findall("tlLogic") if logic.get("id") == MAIN]
    if not found or not found[-1].findall("phase"):
        raise IzooError(
            f"{path} has no signal program {MAIN} with phases; only intersections with a fixed-time signal can be used."
        )
    return found[-1]


def offset_s(program: Any) -> float:
    """Return when the first phase of a program begins; ``begin`` is the beginning of the simulation."""
    given = program.get("offset") or "0"
    return 0.0 if given == "begin" else float(given)


def open_to_cars(lane: Any) -> bool:
    """Whether izoo's vehicles may use a ``<lane>``: no sidewalk, cycle lane, bus lane or track."""
    if lane.get("allow"):  # SUMO reads ``disallow`` only without it
        return bool({_ALL, CAR} & set(lane.get("allow").split()))
    return not {_ALL, CAR} & set((lane.get("disallow") or "").split())


def open_lanes(root: Any) -> dict[str, list[Any]]:
    """Return the lanes that are open to cars, by edge, from the right; edges without one are left out."""
    edges = {edge.get("id"): edge.findall("lane") for edge in root.findall("edge")}
    opened = {edge: [lane for lane in lanes if open_to_cars(lane)] for edge, lanes in edges.items()}
    return {edge: lanes for edge, lanes in opened.items() if lanes}


def lane_number(lane: Any) -> int:
    """Return SUMO's index of a ``<lane>``: 0 is the rightmost of its edge, closed ones included."""
    return int(lane.get("id").rsplit("_", 1)[1])


def open_connections(root: Any) -> list[Any]:
    """Return the connections that neither begin, pass nor end on a lane that is closed to cars."""
    closed = {lane.get("id") for lane in root.iter("lane") if not open_to_cars(lane)}

    def lanes(connection: Any) -> set[str | None]:
        ends = (f"{connection.get(side)}_{connection.get(f'{side}Lane')}" for side in ("from", "to"))
        return {connection.get("via"), *ends}

    return [connection for connection in root.findall("connection") if not lanes(connection) & closed]


def is_no(word: str) -> bool:
    """Whether SUMO reads an attribute as false."""
    return word.lower() in _NO


def _sides(root: Any) -> Iterator[tuple[str, str]]:
    if not is_no(root.get("lefthand") or "no"):
        yield (
            f"the net is for traffic on the left (lefthand={root.get('lefthand')!r})",
            "izoo drives on the right; mirror the net, or build it from an OpenStreetMap extract, which is mirrored",
        )


def _programs(root: Any) -> Iterator[tuple[str, str]]:
    logics = root.findall("tlLogic")
    for logic in logics:
        if logic.get("programID") == _OFF_PROGRAM:
            yield f"signal {logic.get('id')} has a program off", "SUMO does not load it; remove that program"
    for logic in [logic for logic in logics if logic.get("id") == MAIN][-1:]:
        name = f"signal {MAIN}"
        if logic.get("type", "static") != "static":
            yield (
                f"{name} is of type {logic.get('type')}",
                'its times would not be those that vehicles are told; give it type="static" and fixed durations',
            )
        phases = logic.findall("phase")
        for k, phase in enumerate(phases):
            follows = phase.get("next")
            if follows and follows.split() != [str((k + 1) % len(phases))]:
                yield (
                    f"{name} has a phase with next={follows!r}",
                    "phases are taken in their order; write them out in the order in which they are shown",
                )
            for letter in phase.get("state") or "":
                if letter not in LETTERS:
                    yield f"{name} shows {letter!r}", f"choose among the letters {' '.join(LETTERS)}"


def _uncontrolled(root: Any) -> Iterator[tuple[str, str]]:
    for connection in open_connections(root):
        start, end = connection.get("from") or "", connection.get("to") or ""
        main = start.removesuffix("_intern").endswith(f"2{MAIN}") and end.startswith(f"{MAIN}2")
        if main and connection.get("tl") != MAIN:
            yield (
                f"the connection from {start} to {end} is not controlled by signal {MAIN}",
                "vehicles would be told that it is red for ever; let the signal control it, always green",
            )
