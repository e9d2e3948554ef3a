"""A finished SUMO net in the published dataset's convention, read back into an :class:`IntersectionSpec`."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from izoo.contexts.spec import LEG_NAMES, TURNS, Approach, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.files import read_bytes
from izoo.networks.representable import (
    check_representable,
    lane_number,
    main_program,
    offset_s,
    open_connections,
    open_lanes,
)
from izoo.networks.road import lane_shape, parse_net

TURN_OF_DIRECTION = {"r": "r", "R": "r", "s": "s", "l": "l", "L": "l", "t": "l"}
_COLOURS = {"G": "G", "g": "g", "y": "y", "Y": "y", "s": "s"}
_RIGHT_ON_RED = "traffic_light_right_on_red"
Inflows = Callable[[tuple[str, ...], frozenset[str]], dict[str, float]]
"""Given all legs and the incoming ones, returns the AADT per lane of the incoming ones, veh/day."""


def spec_from_net(path: Path, *, name: str, city: str | None, inflows: Inflows) -> IntersectionSpec:
    """Describe a finished net.

    Args:
        path: the net file.
        name: the intersection's name.
        city: one of the ten cities, or ``None``.
        inflows: source of the demand.

    Raises:
        IzooError: the file is not a net, lacks the signal ``TL``, an incoming or an outgoing leg, or holds a value
            outside the range that an :class:`Approach` accepts.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise IzooError(f"cannot read the net {path}: {error.strerror}; fetch the file again.") from error
    try:
        root = parse_net(data, path)
        check_representable(root, str(path))
        reader = _NetSpecReader(root, path)
        aadt = inflows(reader.legs, reader.incoming)
        legs = tuple(reader.leg(letter, aadt.get(letter, 0.0)) for letter in reader.legs)
        return IntersectionSpec(
            name=name,
            source="dataset",
            legs=legs,
            signal_plan=reader.signal_plan(),
            right_on_red=reader.junctions["TL"].get("type") == _RIGHT_ON_RED,
            city=city,
            imputed=tuple(reader.imputed),
            net_path=str(path),
            net_sha256=hashlib.sha256(data).hexdigest(),
        )
    except IzooError as error:
        if str(path.parent) in str(error):
            raise
        raise IzooError(f"{path}: {error} Repair the net.") from error
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise IzooError(f"{path} is not a complete SUMO net ({error!r}); fetch the file again.") from error


class _NetSpecReader:
    """Tables of one net; ``imputed`` collects the names of guessed values on the way."""

    def __init__(self, root: Any, path: Path) -> None:
        self.root, self.path = root, path
        self.imputed: list[str] = []
        self.edges = open_lanes(root)
        self.junctions = {junction.get("id"): junction for junction in root.findall("junction")}
        if "TL" not in self.junctions:
            raise IzooError(f"{path} has no junction TL; only nets in the published dataset's convention can be used.")
        self.connections: dict[str, list[Any]] = {}
        for connection in open_connections(root):
            self.connections.setdefault(connection.get("from"), []).append(connection)
        incoming = {edge[0] for edge in self.edges if re.fullmatch(f"[{LEG_NAMES}]2TL", edge)}
        self.outgoing = frozenset(edge[3] for edge in self.edges if re.fullmatch(f"TL2[{LEG_NAMES}]", edge))
        self.incoming = frozenset(incoming)
        self.legs = tuple(sorted(self.incoming | self.outgoing))
        if not self.incoming:
            raise IzooError(f"{path} has no incoming approach: no edge such as A2TL leads to TL; fetch the file again.")
        if not self.outgoing:
            raise IzooError(f"{path} has no outgoing leg: no edge such as TL2A leads away from TL; fetch it again.")
        # SUMO leaves out the height of points at 0 m, so only a net without any height lacks elevation.
        lanes = [lane for edge in self.edges.values() for lane in edge]
        if not any(lane.get("shape", "0,0").split()[0].count(",") == 2 for lane in lanes):
            self.imputed.append("grade")

    def leg(self, letter: str, aadt_per_lane: float) -> Leg:
        """Describe one leg; ``aadt_per_lane`` is that of its incoming side."""
        out = self.edges.get(f"TL2{letter}", [])
        return Leg(
            name=letter,
            bearing_deg=self._bearing(letter),
            approach=self._approach(letter, aadt_per_lane) if letter in self.incoming else None,
            exit_lanes=len(out),
            exit_length_m=float(out[0].get("length")) if out else 0.0,
            exit_speed_limit_mps=float(out[0].get("speed")) if out else 0.0,
        )

    def _approach(self, letter: str, aadt_per_lane: float) -> Approach:
        main_edge, pocket_edge = f"{letter}2TL", f"{letter}2TL_intern"
        main = self.edges[main_edge]
        stop_edge = pocket_edge if pocket_edge in self.edges else main_edge
        stop = self.edges[stop_edge]
        lanes = self._turns(letter, stop_edge)
        right, left = self._pockets(main_edge, lanes, len(main)) if stop_edge != main_edge else (0, 0)
        length = float(main[0].get("length"))
        if stop_edge != main_edge:
            length += self._joint_length(main_edge, pocket_edge) + float(stop[0].get("length"))
        return Approach(
            lanes=lanes,
            length_m=length,
            speed_limit_mps=float(main[0].get("speed")),
            grade=_grade(main[0], stop[0]),
            aadt_per_lane=aadt_per_lane,
            right_pockets=right,
            left_pockets=left,
            pocket_length_m=float(stop[0].get("length")) if right + left else 0.0,
        )

    def _turns(self, letter: str, edge: str) -> tuple[str, ...]:
        """Turns per lane, right to left; a lane that leads nowhere takes those of its nearest neighbour."""
        found: list[set[str]] = [set() for _ in self.edges[edge]]
        row = {lane_number(lane): number for number, lane in enumerate(self.edges[edge])}
        for connection in self.connections.get(edge, []):
            if connection.get("to")[3:] in self.outgoing and connection.get("to").startswith("TL2"):
                found[row[int(connection.get("fromLane"))]].add(TURN_OF_DIRECTION.get(connection.get("dir"), "s"))
        leading = [lane for lane, turns in enumerate(found) if turns]
        if not leading:
            raise IzooError(f"{self.path}: no lane of {edge} leads across the junction TL; repair the net.")
        for lane, turns in enumerate(found):
            if not turns:
                turns |= found[min(leading, key=lambda other: abs(other - lane))]
                self.imputed.append(f"turns of lane {lane} of {letter}")
        return tuple("".join(turn for turn in TURNS if turn in turns) for turns in found)

    def _pockets(self, main_edge: str, lanes: tuple[str, ...], main_count: int) -> tuple[int, int]:
        """How many of ``lanes`` begin with the pocket part: on the right, on the left.

        The rightmost main lane fans out to the right pockets and itself, the leftmost to itself and the left ones. A
        single main lane goes on as the first lane with a straight movement, else as the middle one.
        """
        extra = len(lanes) - main_count
        if extra <= 0:
            return 0, 0
        if main_count == 1:
            straight = [lane for lane, turns in enumerate(lanes) if "s" in turns]
            right = straight[0] if straight else extra // 2
        else:
            rightmost = lane_number(self.edges[main_edge][0])
            onward = self.connections.get(main_edge, [])
            targets = {int(c.get("toLane")) for c in onward if int(c.get("fromLane")) == rightmost}
            right = min(max(len(targets) - 1, 0), extra)
        return right, extra - right

    def _joint_length(self, main_edge: str, pocket_edge: str) -> float:
        """Length of the lane between the main and the pocket part in m; 0 where the net has no internal lanes."""
        onward = [c for c in self.connections.get(main_edge, []) if c.get("to") == pocket_edge and c.get("via")]
        if not onward:
            return 0.0
        via = min(onward, key=lambda c: (int(c.get("fromLane")), int(c.get("toLane")))).get("via")
        lanes = {lane.get("id"): lane for lane in self.edges.get(via.rsplit("_", 1)[0], [])}
        return float(lanes[via].get("length")) if via in lanes else 0.0

    def _bearing(self, letter: str) -> float:
        """Direction from the junction to the leg's far end, degrees clockwise from north."""
        centre = self.junctions["TL"]
        far = self.junctions.get(letter)
        if far is not None:
            end = (float(far.get("x")), float(far.get("y")))
        elif letter in self.incoming:
            end = tuple(lane_shape(self.edges[f"{letter}2TL"][0])[0, :2])
        else:
            end = tuple(lane_shape(self.edges[f"TL2{letter}"][0])[-1, :2])
        return math.degrees(math.atan2(end[0] - float(centre.get("x")), end[1] - float(centre.get("y")))) % 360.0

    def signal_plan(self) -> SignalPlan:
        """The plan of ``TL`` by movement; of the links of one movement the greenest counts, of programs the last."""
        program = main_program(self.root, str(self.path))
        phases = program.findall("phase")
        links: dict[tuple[str, str], list[int]] = {}
        for letter in sorted(self.incoming):
            edge = f"{letter}2TL_intern" if f"{letter}2TL_intern" in self.edges else f"{letter}2TL"
            for connection in self.connections.get(edge, []):
                if connection.get("tl") == "TL" and connection.get("to")[3:] in self.outgoing:
                    links.setdefault((letter, connection.get("to")[3:]), []).append(int(connection.get("linkIndex")))
        shortest = min(len(phase.get("state")) for phase in phases)
        if any(index >= shortest for indices in links.values() for index in indices):
            raise IzooError(f"{self.path}: the signal program TL has fewer states than links; fetch the file again.")
        return SignalPlan(phases=tuple(_phase(phase, links) for phase in phases), offset_s=offset_s(program))


def _phase(phase: Any, links: dict[tuple[str, str], list[int]]) -> SignalPhase:
    state, duration_s = phase.get("state"), float(phase.get("duration"))
    if not 0.0 < duration_s < math.inf:
        raise IzooError(f"the signal program TL has a phase of {duration_s:g} s; phases need a positive duration.")
    shown = {pair: {_COLOURS.get(state[index], "r") for index in indices} for pair, indices in links.items()}
    colours = {pair: _movement_colour(found) for pair, found in shown.items()}
    return SignalPhase(
        duration_s=duration_s,
        states=tuple((origin, to, colour) for (origin, to), colour in colours.items() if colour != "r"),
    )


def _movement_colour(found: set[str]) -> str:
    """Colour of a movement from those of its links: green before yellow before red; protected only if all green are."""
    return next(colour for colour in "gGysr" if colour in found)


def _grade(first: Any, last: Any) -> float:
    """Mean rise over run from the beginning of lane ``first`` to the end of lane ``last``."""
    one, two = lane_shape(first), lane_shape(last)
    run = sum(float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).sum()) for points in (one, two))
    run = run + float(np.linalg.norm(two[0, :2] - one[-1, :2])) if first is not last else run / 2.0
    return float((two[-1, 2] - one[0, 2]) / run) if run > 0.0 else 0.0
