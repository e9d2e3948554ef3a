"""A top view of an intersection as an RGB image, without a screen."""

from __future__ import annotations

from typing import Any

import numpy as np

from izoo.envs.mdp.snapshot import Scene
from izoo.networks.clock import GREEN, YELLOW
from izoo.networks.road import APPROACHING, RoadNet

CV_COLOUR, HDV_COLOUR = "#1f77b4", "#ff9f1c"
_SIGNAL_COLOUR = {GREEN: "#2ecc40", YELLOW: "#ffdc00"}
_RED = "#ff4136"
_LANE_WIDTH_M, _VEHICLE_WIDTH_M = 3.2, 1.8


def vehicle_pose(shape: np.ndarray, length_m: float, position_m: float) -> tuple[float, float, float]:
    """Return x, y in m of a lane position and the heading there in radians, counter-clockwise from east.

    ``shape [n, 3]`` is the lane's geometry, which may be longer or shorter than its nominal ``length_m``.
    """
    step = np.diff(shape[:, :2], axis=0)
    run = np.linalg.norm(step, axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(run)])
    along = np.clip(position_m / max(length_m, 1e-9), 0.0, 1.0) * travelled[-1]
    k = int(np.clip(np.searchsorted(travelled, along, side="right") - 1, 0, len(run) - 1))
    x, y = shape[k, :2] + step[k] * (along - travelled[k]) / max(run[k], 1e-9)
    return float(x), float(y), float(np.arctan2(step[k, 1], step[k, 0]))


def draw(scene: Scene, *, span_m: float = 120.0, size_px: int = 640) -> np.ndarray:
    """Draw the state of an environment as ``[size_px, size_px, 3]`` uint8.

    Args:
        scene: the state.
        span_m: width of the part of the world that is shown, around the junction.
        size_px: width and height of the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size_px / 100, size_px / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    road = scene.road
    centre = junction_centre(road)
    axes.set_facecolor("#e8ece4")
    axes.set_aspect("equal")
    axes.set_xlim(centre[0] - span_m / 2, centre[0] + span_m / 2)
    axes.set_ylim(centre[1] - span_m / 2, centre[1] + span_m / 2)
    axes.set_axis_off()
    figure.patch.set_facecolor("#e8ece4")
    points_per_m = size_px * 0.72 / span_m
    _draw_lanes(axes, road, points_per_m)
    _draw_signals(axes, road, scene.colour, points_per_m)
    _draw_vehicles(axes, road, scene.vehicles)
    _draw_legend(axes, f"{scene.context.name}   t = {scene.time_s:.1f} s")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def junction_centre(road: RoadNet) -> np.ndarray:
    """Return the mean ``[2]`` of the stop-line ends of all approaching lanes, in m."""
    shapes = road.shapes
    return np.mean([shapes[lane][-1, :2] for lane in _stop_lanes(road)], axis=0)


def _stop_lanes(road: RoadNet) -> list[int]:
    return [
        lane
        for lane in range(len(road.lane_ids))
        if road.lane_location[lane] == APPROACHING and abs(road.lane_offset_m[lane] + road.lane_length[lane]) < 1e-6
    ]


def _draw_lanes(axes: Any, road: RoadNet, points_per_m: float) -> None:
    shapes = road.shapes
    for shape in shapes:
        axes.plot(*shape[:, :2].T, color="#5b6168", lw=_LANE_WIDTH_M * points_per_m, solid_capstyle="butt", zorder=1)
    for lane, shape in enumerate(shapes):
        if road.lane_left[lane] >= 0 and road.lane_location[lane] != 1:
            step = shape[-1, :2] - shape[0, :2]
            normal = np.array([-step[1], step[0]]) / max(float(np.linalg.norm(step)), 1e-9)
            line = shape[:, :2] + normal * _LANE_WIDTH_M / 2
            axes.plot(*line.T, color="white", lw=0.25 * points_per_m, ls=(0, (6, 8)), zorder=2)


def _draw_signals(axes: Any, road: RoadNet, colour: np.ndarray, points_per_m: float) -> None:
    shapes = road.shapes
    for lane in _stop_lanes(road):
        p = road.lane_approach[lane]
        exits = [q for q in range(len(road.exits)) if road.next_lane[lane, q] >= 0]
        best = min((int(colour[p, q]) for q in exits), default=2)
        shape = shapes[lane][-2:, :2]
        step = (shape[1] - shape[0]) / max(float(np.linalg.norm(shape[1] - shape[0])), 1e-9)
        normal = np.array([-step[1], step[0]]) * _LANE_WIDTH_M / 2 * 0.9
        ends = np.stack([shape[1] - normal, shape[1] + normal])
        axes.plot(*ends.T, color=_SIGNAL_COLOUR.get(best, _RED), lw=1.0 * points_per_m, zorder=4)


def _draw_vehicles(axes: Any, road: RoadNet, vehicles: dict[str, np.ndarray]) -> None:
    from matplotlib.patches import Polygon

    shapes = road.shapes
    for v in range(len(vehicles["is_cv"])):
        lane, length = int(vehicles["region_lane"][v]), float(vehicles["length_m"][v])
        x, y, heading = vehicle_pose(shapes[lane], road.lane_length[lane], vehicles["lane_position_m"][v])
        ahead = np.array([np.cos(heading), np.sin(heading)])
        side = np.array([-ahead[1], ahead[0]]) * _VEHICLE_WIDTH_M / 2
        front = np.array([x, y])
        corners = [front + side, front - side, front - side - ahead * length, front + side - ahead * length]
        face = CV_COLOUR if vehicles["is_cv"][v] else HDV_COLOUR
        axes.add_patch(Polygon(corners, closed=True, facecolor=face, edgecolor="black", lw=0.5, zorder=5))


def _draw_legend(axes: Any, title: str) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker="s", ls="", color=CV_COLOUR, label="controlled (CV)"),
        Line2D([], [], marker="s", ls="", color=HDV_COLOUR, label="human-driven (HDV)"),
    ]
    axes.legend(handles=handles, loc="lower left", fontsize=8, framealpha=0.9).set_zorder(9)
    box = {"fc": "white", "alpha": 0.8}
    axes.text(0.02, 0.97, title, transform=axes.transAxes, va="top", fontsize=9, zorder=9, bbox=box)
