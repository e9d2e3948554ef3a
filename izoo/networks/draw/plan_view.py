"""Where the lanes and movements of a drawn intersection lie, in metres around the middle of its junction."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from izoo.contexts.spec import IntersectionSpec
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


def layout_of(road: RoadNet, spec: IntersectionSpec) -> Layout:
    """Lay out a net: the shapes of its lanes, cut where the legs leave the picture."""
    place, shapes = road.lane_location, [shape[:, :2] for shape in road.shapes]
    ways = [(k, shapes[k], int(road.lane_exit[k])) for k in np.flatnonzero(place == INSIDE)]
    for k, q in np.argwhere(road.next_lane >= 0):
        onward = road.next_lane[k, q]
        if place[k] == APPROACHING and place[onward] == LEAVING:  # a net without lanes inside its junction
            ways.append((k, np.array([shapes[k][-1], shapes[onward][0]]), int(q)))
    junction = np.concatenate([points for _, points, _ in ways])
    middle = (junction.min(axis=0) + junction.max(axis=0)) / 2.0
    extent = float(np.abs(junction - middle).max()) + REACH_M
    lanes = [
        DrawnLane(_clip(shapes[k] - middle, extent))
        if place[k] == LEAVING
        else DrawnLane(_clip(shapes[k][::-1] - middle, extent)[::-1], _turns_at_stop(road, spec, k))
        for k in np.flatnonzero(place != INSIDE)
    ]
    movements = [
        DrawnMovement(points - middle, road.approaches[road.lane_approach[k]], road.exits[q]) for k, points, q in ways
    ]
    return Layout(tuple(lane for lane in lanes if len(lane.points) > 1), tuple(movements), extent)


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
