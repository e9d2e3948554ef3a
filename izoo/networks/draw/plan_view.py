"""Where the lanes and movements of a drawn intersection lie, in metres around the middle of its junction."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import IntersectionSpec, Leg
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet

LANE_M = 3.2
REACH_M = 70.0
"""How much of each leg is drawn."""


@dataclass(frozen=True)
class DrawnLane:
    """A lane along its direction of travel, ``[n, 2]``; ``turns`` is empty unless it ends at the stop line."""

    points: np.ndarray
    turns: str = ""


@dataclass(frozen=True)
class DrawnMovement:
    """A way through the junction, ``[n, 2]``, from one leg to another."""

    points: np.ndarray
    origin: str
    exit: str


@dataclass(frozen=True)
class Layout:
    """All there is to draw; ``extent_m`` is the distance from the middle to the ends of the legs."""

    lanes: tuple[DrawnLane, ...]
    movements: tuple[DrawnMovement, ...]
    extent_m: float


def layout_of_spec(spec: IntersectionSpec) -> Layout:
    """Lay out a description: straight legs along their bearings, lanes side by side."""
    radius = _junction_radius(spec)
    lanes: list[DrawnLane] = []
    ends: dict[tuple[str, int], np.ndarray] = {}
    starts: dict[tuple[str, int], np.ndarray] = {}
    for leg in spec.legs:
        out, right = _axes(leg)
        for index in range(leg.exit_lanes):
            # Lane 0 is the rightmost, so it is the outermost on the way out as well.
            side = right * LANE_M * (leg.exit_lanes - index - 0.5)
            starts[leg.name, index] = side + radius * out
            lanes.append(DrawnLane(np.array([side + radius * out, side + (radius + REACH_M) * out])))
        if leg.approach is None:
            continue
        count = leg.approach.lane_count
        for index, turns in enumerate(leg.approach.lanes):
            side = -right * LANE_M * (count - index - 0.5)
            pocket = index < leg.approach.right_pockets or index >= count - leg.approach.left_pockets
            reach = min(leg.approach.pocket_length_m, REACH_M) if pocket else REACH_M
            ends[leg.name, index] = side + radius * out
            lanes.append(DrawnLane(np.array([side + (radius + reach) * out, side + radius * out]), turns))
    return Layout(tuple(lanes), tuple(_curves(spec, ends, starts)), radius + REACH_M)


def layout_of_road(road: RoadNet, spec: IntersectionSpec) -> Layout:
    """Lay out a net: the shapes of its lanes, cut where the legs leave the picture; one without lanes inside the
    junction is laid out as the intersection says."""
    inside = [k for k in range(len(road.lane_ids)) if road.lane_location[k] == INSIDE]
    if not inside:
        return layout_of_spec(spec)
    junction = np.concatenate([road.shapes[k][:, :2] for k in inside])
    middle = (junction.min(axis=0) + junction.max(axis=0)) / 2.0
    extent = float(np.abs(junction - middle).max()) + REACH_M
    lanes, movements = [], []
    for k in range(len(road.lane_ids)):
        points = road.shapes[k][:, :2] - middle
        if road.lane_location[k] == APPROACHING:
            lanes.append(DrawnLane(_clip(points[::-1], extent)[::-1], _turns_at_stop(road, spec, k)))
        elif road.lane_location[k] == LEAVING:
            lanes.append(DrawnLane(_clip(points, extent)))
        else:
            origin, to = road.approaches[road.lane_approach[k]], road.exits[road.lane_exit[k]]
            movements.append(DrawnMovement(points, origin, to))
    return Layout(tuple(lane for lane in lanes if len(lane.points) > 1), tuple(movements), extent)


def _axes(leg: Leg) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors out along a leg and to the right of it, looking out."""
    angle = np.radians(leg.bearing_deg)
    return np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])


def _junction_radius(spec: IntersectionSpec) -> float:
    """Distance from the middle at which neighbouring legs no longer overlap."""
    widths = [max(leg.exit_lanes, leg.approach.lane_count if leg.approach else 0) * LANE_M for leg in spec.legs]
    bearings = [leg.bearing_deg for leg in spec.legs]
    radius = 8.0
    for k, bearing in enumerate(bearings):
        other = (k + 1) % len(bearings)
        half = np.radians(max((bearings[other] - bearing) % 360.0, 20.0)) / 2.0
        if half < np.pi / 2.0:
            radius = max(radius, max(widths[k], widths[other]) / np.tan(half) + 2.0)
    return float(min(radius, 45.0))


def _curves(
    spec: IntersectionSpec, ends: dict[tuple[str, int], np.ndarray], starts: dict[tuple[str, int], np.ndarray]
) -> list[DrawnMovement]:
    """Bezier curves from the lanes to the exits of their turns."""
    found = []
    for leg in spec.legs:
        if leg.approach is None:
            continue
        exits = exits_by_turn(spec.legs, leg.name)
        users = {turn: [i for i, turns in enumerate(leg.approach.lanes) if turn in turns] for turn in "rsl"}
        for turn, names in exits.items():
            for place, index in enumerate(users[turn]):
                for to in names:
                    count = spec.leg(to).exit_lanes
                    target = min(place, count - 1) if turn != "l" else max(count - len(users[turn]) + place, 0)
                    points = _bezier(ends[leg.name, index], -_axes(leg)[0], starts[to, target], _axes(spec.leg(to))[0])
                    found.append(DrawnMovement(points, leg.name, to))
    return found


def _bezier(start: np.ndarray, heading: np.ndarray, end: np.ndarray, end_heading: np.ndarray) -> np.ndarray:
    reach = 0.45 * float(np.linalg.norm(end - start))
    t = np.linspace(0.0, 1.0, 25)[:, None]
    one, two = start + reach * heading, end - reach * end_heading
    return (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * one + 3 * (1 - t) * t**2 * two + t**3 * end


def _turns_at_stop(road: RoadNet, spec: IntersectionSpec, lane: int) -> str:
    """Turns of an approach lane that ends at the stop line, otherwise an empty string."""
    leg = road.approaches[road.lane_approach[lane]]
    approach = spec.leg(leg).approach
    edge = road.lane_ids[lane].rsplit("_", 1)[0]
    if approach is None or edge != road.incoming_edges[road.approaches.index(leg)][-1]:
        return ""
    return approach.lanes[int(road.lane_index[lane])]


def _clip(points: np.ndarray, extent: float) -> np.ndarray:
    """The part of a line from its beginning until it is ``extent`` m from the middle."""
    kept = [points[0]]
    for one, two in itertools.pairwise(points):
        if np.linalg.norm(one) > extent:
            break
        if np.linalg.norm(two) > extent:
            steps = one + np.linspace(0.0, 1.0, 200)[:, None] * (two - one)
            kept.append(steps[np.linalg.norm(steps, axis=1) <= extent][-1])
            break
        kept.append(two)
    line = np.array(kept)
    return line if np.linalg.norm(line[0]) <= extent else line[:1]
