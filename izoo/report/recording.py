"""An episode as small data to draw: the lanes of the net, the signals, and every vehicle's way through the region."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from izoo.envs.mdp.metric_sums import METRIC
from izoo.envs.mdp.snapshot import Scene
from izoo.networks.road import APPROACHING, RoadNet

COUNTER_STEPS = 10
"""Steps between two entries of the counters."""
DM_PER_M = 10.0
"""Positions are kept in tenths of a metre."""


@dataclass
class _Track:
    """One vehicle while it is recorded; positions are those of the front bumper along its route, in dm."""

    first: int
    is_cv: bool
    length_dm: int
    approach: int
    exit: int
    positions: list[int] = field(default_factory=list)
    lanes: list[list[int]] = field(default_factory=list)


class Recorder:
    """Collects the states of one episode; call :meth:`take` before every action."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}
        self._signals: list[list[Any]] = []
        self._counters: list[list[float]] = []
        self.frames = 0

    def take(self, scene: Scene) -> None:
        """Record the present state."""
        columns = scene.vehicles
        positions = np.rint(columns["path_position_m"] * DM_PER_M).astype(int)
        starts = np.rint((columns["path_position_m"] - columns["lane_position_m"]) * DM_PER_M).astype(int)
        for k, number in enumerate(columns["vehicle_number"].tolist()):
            track = self._tracks.get(number)
            if track is None:
                track = self._tracks[number] = _Track(
                    self.frames,
                    bool(columns["is_cv"][k]),
                    round(float(columns["length_m"][k]) * DM_PER_M),
                    int(columns["approach"][k]),
                    int(columns["exit"][k]),
                )
            track.positions.append(int(positions[k]))
            lane = int(columns["region_lane"][k])
            if track.lanes and track.lanes[-1][0] == lane:
                track.lanes[-1][1] += 1
            else:
                track.lanes.append([lane, 1, int(starts[k])])
        colours = "".join("gyr"[colour] for colour in scene.colour.ravel())
        if not self._signals or self._signals[-1][1] != colours:
            self._signals.append([self.frames, colours])
        if self.frames % COUNTER_STEPS == 0:
            sums = scene.approach_metrics.sum(axis=0)
            self._counters.append([float(sums[METRIC["crossed"]]), round(float(sums[METRIC["emission_g"]]), 1)])
        self.frames += 1

    def content(self) -> dict[str, Any]:
        """Return the episode as plain values.

        ``vehicles``: per vehicle ``[first frame, is CV, length in dm, approach, exit, lanes, positions]``, where
        ``lanes`` holds ``[lane, frames, path position of its beginning in dm]`` and ``positions`` what
        :func:`second_differences` makes of the path positions in dm. ``signals``: ``[frame, colours]`` at every
        change, a letter per movement in the order of ``[P, Q]``. ``counters``: vehicles that crossed and their CO2 in
        g, every :data:`COUNTER_STEPS`.
        """
        vehicles = [
            [t.first, int(t.is_cv), t.length_dm, t.approach, t.exit, t.lanes, second_differences(t.positions)]
            for _, t in sorted(self._tracks.items())
        ]
        return {
            "frames": self.frames,
            "vehicles": vehicles,
            "signals": self._signals,
            "counters": self._counters,
            "counter_steps": COUNTER_STEPS,
        }


def second_differences(values: list[int]) -> list[int]:
    """Second differences of ``[0, 0, *values]``: as many numbers, and small ones where motion is smooth."""
    return np.diff(np.array([0, 0, *values]), n=2).tolist() if values else []


def geometry(road: RoadNet) -> dict[str, Any]:
    """Return what is to be drawn of a net, in m around the middle of its stop lines.

    ``lanes``: per lane of the region ``{"p": [x, y, ...], "n": nominal length, "w": location, "s": left line}``, where
    the location is 0 approaching, 1 inside, 2 leaving. ``stops``: per lane that ends at a stop line
    ``[lane, approach, exits that it leads to]``. ``exits``, ``approaches``: leg names.
    """
    stop = [
        lane
        for lane in range(len(road.lane_ids))
        if road.lane_location[lane] == APPROACHING and abs(road.lane_offset_m[lane] + road.lane_length[lane]) < 1e-6
    ]
    shapes = road.shapes
    centre = np.mean([shapes[lane][-1, :2] for lane in stop], axis=0)
    lanes = [
        {
            "p": np.round(shape[:, :2] - centre, 2).ravel().tolist(),
            "n": round(float(road.lane_length[lane]), 2),
            "w": int(road.lane_location[lane]),
            "s": int(road.lane_left[lane] >= 0 and not road.lane_ids[lane].startswith(":")),
        }
        for lane, shape in enumerate(shapes)
    ]
    stops = [[lane, int(road.lane_approach[lane]), np.flatnonzero(road.next_lane[lane] >= 0).tolist()] for lane in stop]
    return {"lanes": lanes, "stops": stops, "approaches": list(road.approaches), "exits": list(road.exits)}
