"""A finished SUMO net in the published dataset's convention, read back into an :class:`IntersectionSpec`."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from izoo.contexts.spec import Approach, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.files import read_bytes
from izoo.networks.representable import check_representable, main_program, offset_s
from izoo.networks.road import NetReader, RoadNet, parse_net, run_m

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
        root, sha256 = parse_net(data, path), hashlib.sha256(data).hexdigest()
        check_representable(root, str(path))
        reader = NetReader(root, str(path), sha256)
        road = reader.read()
        junctions = {junction.get("id"): junction for junction in root.findall("junction")}
        if "TL" not in junctions:
            raise IzooError(f"{path} has no junction TL; only nets in the published dataset's convention can be used.")
        letters = tuple(sorted({*road.approaches, *road.exits}))
        aadt = inflows(letters, frozenset(road.approaches))
        # SUMO leaves out the height of points at 0 m, so only a net without any height lacks elevation.
        shapes = [lane.get("shape", "0,0") for lanes in reader.edges.values() for lane in lanes]
        imputed = [] if any(shape.split()[0].count(",") == 2 for shape in shapes) else ["grade"]
        return IntersectionSpec(
            name=name,
            source="dataset",
            legs=tuple(_leg(road, letter, junctions, aadt.get(letter, 0.0), imputed) for letter in letters),
            signal_plan=_signal_plan(root, road, reader.signal_links()),
            right_on_red=junctions["TL"].get("type") == _RIGHT_ON_RED,
            city=city,
            imputed=tuple(imputed),
            net_path=str(path),
            net_sha256=sha256,
        )
    except IzooError as error:
        if str(path.parent) in str(error):
            raise
        raise IzooError(f"{path}: {error} Repair the net.") from error
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise IzooError(f"{path} is not a complete SUMO net ({error!r}); fetch the file again.") from error


def _leg(road: RoadNet, letter: str, junctions: dict[str, Any], aadt_per_lane: float, imputed: list[str]) -> Leg:
    approach, first = None, None
    if letter in road.approaches:
        p = road.approaches.index(letter)
        main, stop = (_lanes(road, road.incoming_edges[p][end]) for end in (0, -1))
        approach, first = _approach(road, p, main, stop, aadt_per_lane, imputed), road.shapes[main[0]][0]
    out = _lanes(road, f"TL2{letter}")
    # The leg's far end is its junction, or else where its lanes begin or end.
    centre, far = junctions["TL"], junctions.get(letter)
    end = road.shapes[out[0]][-1] if first is None else first
    x, y = end[:2] if far is None else (float(far.get("x")), float(far.get("y")))
    return Leg(
        name=letter,
        bearing_deg=math.degrees(math.atan2(x - float(centre.get("x")), y - float(centre.get("y")))) % 360.0,
        approach=approach,
        exit_lanes=len(out),
        exit_length_m=float(road.lane_length[out[0]]) if out else 0.0,
        exit_speed_limit_mps=float(road.lane_limit_mps[out[0]]) if out else 0.0,
    )


def _lanes(road: RoadNet, edge: str) -> list[int]:
    """The lanes of an edge, from the right."""
    return [lane for lane, name in enumerate(road.lane_ids) if name.rpartition("_")[0] == edge]


def _approach(
    road: RoadNet, p: int, main: list[int], stop: list[int], aadt_per_lane: float, imputed: list[str]
) -> Approach:
    lanes = _turns(road, p, stop, imputed)
    right = _right_pockets(road, p, main[0], stop, lanes) if len(stop) > len(main) else 0
    left = max(len(stop) - len(main), 0) - right
    return Approach(
        lanes=lanes,
        length_m=-float(road.lane_offset_m[main[0]]),
        speed_limit_mps=float(road.speed_limit_mps[p]),
        grade=_grade(*(road.shapes[lane] for lane in dict.fromkeys((main[0], stop[0])))),
        aadt_per_lane=aadt_per_lane,
        right_pockets=right,
        left_pockets=left,
        pocket_length_m=float(road.lane_length[stop[0]]) if right + left else 0.0,
    )


def _turns(road: RoadNet, p: int, stop: list[int], imputed: list[str]) -> tuple[str, ...]:
    """Turns per lane, right to left; a lane that leads nowhere takes those of its nearest neighbour."""
    found = [{"rsl"[road.movement_turn[p, q]] for q in np.flatnonzero(road.next_lane[lane] >= 0)} for lane in stop]
    leading = [lane for lane, turns in enumerate(found) if turns]
    for lane, turns in enumerate(found):
        if not turns:
            turns |= found[min(leading, key=lambda other: abs(other - lane))]
            imputed.append(f"turns of lane {lane} of {road.approaches[p]}")
    return tuple("".join(turn for turn in "rsl" if turn in turns) for turns in found)


def _right_pockets(road: RoadNet, p: int, rightmost: int, stop: list[int], turns: tuple[str, ...]) -> int:
    """How many lanes at the stop line are pockets on the right of where the approach's rightmost lane goes on.

    It fans out to the right pockets and itself. An only lane goes on as the first one with a straight movement, else as
    the middle one.
    """
    extra = len(stop) - int(road.main_lane_count[p])
    if road.main_lane_count[p] == 1:
        straight = [lane for lane, turn in enumerate(turns) if "s" in turn]
        return straight[0] if straight else extra // 2
    fan = 0
    for lane in stop:
        while lane not in (rightmost, -1):
            lane = road.prev_lane[lane, p]
        fan += lane == rightmost
    return min(max(fan - 1, 0), extra)


def _grade(*shapes: np.ndarray) -> float:
    """Mean rise over run along the shapes of one lane, or of two with a gap between them."""
    gaps = [float(np.linalg.norm(after[0, :2] - before[-1, :2])) for before, after in itertools.pairwise(shapes)]
    run = sum(map(run_m, shapes)) + sum(gaps)
    return float((shapes[-1][-1, 2] - shapes[0][0, 2]) / run) if run > 0.0 else 0.0


def _signal_plan(root: Any, road: RoadNet, links: dict[tuple[int, int], list[int]]) -> SignalPlan:
    """The plan of ``TL`` by movement: of its links' colours green comes before yellow before red, and a green has
    priority only where all greens have it."""
    program, phases = main_program(root, road.path), []
    for phase in program.findall("phase"):
        states = []
        for (p, q), indices in links.items():
            shown = {_COLOURS.get(phase.get("state")[index], "r") for index in indices}
            colour = next(colour for colour in "gGysr" if colour in shown)
            states += [(road.approaches[p], road.exits[q], colour)] if colour != "r" else []
        phases.append(SignalPhase(float(phase.get("duration")), tuple(states)))
    return SignalPlan(tuple(phases), offset_s(program))
