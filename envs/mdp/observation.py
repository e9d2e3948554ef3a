"""A CV's observation: every column declared once, with its name, unit, scale and source.

An observation is the ego columns, then the neighbour columns of each chosen neighbour, then the observed context
features of the ego's movement. Names, specs and the layout page follow from the declarations here, and so does the
compiled code (:mod:`izoo.envs.mdp.observation_kernel`), which holds each value divided by its scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from izoo.contexts.context import ENGINES, Context
from izoo.contexts.features import BY_NAME
from izoo.networks.clock import GREEN, RED, YELLOW
from izoo.networks.road import APPROACHING, INSIDE, LEAVING, RoadNet
from izoo.networks.turning import LEFT, RIGHT, STRAIGHT

FAR_M = 1000.0
"""Distance of an absent neighbour, whose speed, blinkers and flag ``present`` are 0."""
SPEED_SCALE_MPS, DISTANCE_SCALE_M, TIME_SCALE_S = 15.0, 250.0, 100.0
NEIGHBOURS = ("leader", "follower", "left_leader", "left_follower", "right_leader", "right_follower")
"""Neighbours that a CV can observe: leader and follower on its own lane, the one to the left and to the right."""


@dataclass(frozen=True)
class Column:
    """One column of the observation.

    Attributes:
        name: its name; a neighbour's column has the neighbour's name before it.
        unit: of the value before it is divided by the scale; empty for flags and shares.
        scale: the observation holds ``value / scale``.
        value: gives the value; it is compiled. An ego column's is ``value(vehicle, road, signal)`` of a vehicle
            (:data:`izoo.envs.mdp.columns.Vehicle`), the road (:class:`~izoo.envs.mdp.displacement.Road`) and what its
            movement is shown (:data:`~izoo.envs.mdp.signals.Shown`). A neighbour column's is
            ``value(other, present, gap_m, lane_exists)``; if the neighbour is absent, the gap is
            :data:`FAR_M` and the record ``other`` is of no meaning.
        meaning: further explanation.
    """

    name: str
    unit: str
    scale: float
    value: Callable[..., float]
    meaning: str = ""


def _located(where: int) -> Callable[..., float]:
    return lambda vehicle, road, signal: 1.0 if vehicle.location == where else 0.0


def _turning(turn: int) -> Callable[..., float]:
    return lambda vehicle, road, signal: 1.0 if vehicle.movement == turn else 0.0


def _shows(colour: int) -> Callable[..., float]:
    return lambda vehicle, road, signal: 1.0 if signal.colour == colour else 0.0


def _lane(vehicle: Any, road: Any, signal: Any) -> float:
    lane = road.lanes[vehicle.region_lane]
    siblings = lane.siblings
    return lane.index / (siblings - 1) if siblings > 1 else 0.0


EGO_COLUMNS = (
    Column("speed", "m/s", SPEED_SCALE_MPS, lambda vehicle, road, signal: vehicle.speed_mps),
    Column(
        "stop_line_distance",
        "m",
        DISTANCE_SCALE_M,
        lambda vehicle, road, signal: vehicle.stop_line_distance_m,
        "negative before the line, 0 in the junction",
    ),
    Column("location_approaching", "", 1.0, _located(APPROACHING)),
    Column("location_inside", "", 1.0, _located(INSIDE)),
    Column("location_leaving", "", 1.0, _located(LEAVING)),
    Column("lane", "", 1.0, _lane, "0 for the rightmost lane of the edge, 1 for the leftmost"),
    Column("intention_right", "", 1.0, _turning(RIGHT)),
    Column("intention_straight", "", 1.0, _turning(STRAIGHT)),
    Column("intention_left", "", 1.0, _turning(LEFT)),
    Column("signal_green", "", 1.0, _shows(GREEN), "of the vehicle's own movement, as are those that follow"),
    Column("signal_yellow", "", 1.0, _shows(YELLOW)),
    Column("signal_red", "", 1.0, _shows(RED)),
    Column(
        "signal_time_left",
        "s",
        TIME_SCALE_S,
        lambda vehicle, road, signal: signal.change_s,
        "until the colour changes",
    ),
    Column(
        "signal_second_green",
        "s",
        TIME_SCALE_S,
        lambda vehicle, road, signal: signal.second_green_s,
        "until the second green; a current one is first",
    ),
    Column(
        "signal_third_green",
        "s",
        TIME_SCALE_S,
        lambda vehicle, road, signal: signal.third_green_s,
        "until the third green",
    ),
)
NEIGHBOUR_COLUMNS = (
    Column("speed", "m/s", SPEED_SCALE_MPS, lambda other, present, gap_m, lane: other.speed_mps if present else 0.0),
    Column(
        "distance",
        "m",
        DISTANCE_SCALE_M,
        lambda other, present, gap_m, lane: gap_m,
        f"bumper to bumper; {FAR_M:g} m if absent",
    ),
    Column("blinker_left", "", 1.0, lambda other, present, gap_m, lane: float(other.blinker_left) if present else 0.0),
    Column(
        "blinker_right", "", 1.0, lambda other, present, gap_m, lane: float(other.blinker_right) if present else 0.0
    ),
    Column("present", "", 1.0, lambda other, present, gap_m, lane: 1.0 if present else 0.0),
    Column("lane_exists", "", 1.0, lambda other, present, gap_m, lane: 1.0 if lane else 0.0),
)

EGO_FEATURES = tuple(column.name for column in EGO_COLUMNS)
NEIGHBOUR_FEATURES = tuple(column.name for column in NEIGHBOUR_COLUMNS)

FEATURE_VALUES: dict[str, Callable[[Context, RoadNet], Any]] = {
    "adoption": lambda context, road: context.adoption,
    "green_s": lambda context, road: road.clock.green_s,
    "red_s": lambda context, road: road.clock.red_s,
    "temperature_c": lambda context, road: context.temperature_c,
    "humidity_pct": lambda context, road: context.humidity_pct,
    "engine": lambda context, road: float(ENGINES.index(context.engine)),
    "lane_count": lambda context, road: road.lane_count[:, None],
    "lane_length_m": lambda context, road: road.lane_length_m[:, None],
    "speed_limit_mps": lambda context, road: road.speed_limit_mps[:, None],
}
"""Source of each observed context feature, which broadcasts to ``[P, Q]``."""


def observed_table(context: Context, road: RoadNet, names: Sequence[str]) -> np.ndarray:
    """Return ``[P, Q, O]`` scaled values of the named features for every movement of the net."""
    table = np.empty((*road.movement_turn.shape, len(names)))
    for k, name in enumerate(names):
        table[..., k] = FEATURE_VALUES[name](context, road)
    return table / np.array([BY_NAME[name].scale for name in names])


def neighbour_columns(neighbours: Sequence[str]) -> np.ndarray:
    """Return ``[6]``, in the order of :data:`NEIGHBOURS`: the first column of each in the observation, -1 if unseen."""
    first = {name: len(EGO_COLUMNS) + len(NEIGHBOUR_COLUMNS) * j for j, name in enumerate(neighbours)}
    return np.array([first.get(name, -1) for name in NEIGHBOURS], np.int64)


def observation_columns(neighbours: Sequence[str], observed: Sequence[str]) -> list[Column]:
    """Return the ``F`` columns of ``("agents", "observation")`` under their full names, in order.

    Args:
        neighbours: observed neighbours, of :data:`NEIGHBOURS`.
        observed: observed context features.
    """
    seen = [
        Column(f"{neighbour}_{column.name}", column.unit, column.scale, column.value, column.meaning)
        for neighbour in neighbours
        for column in NEIGHBOUR_COLUMNS
    ]
    features = [
        Column(f"context_{name}", BY_NAME[name].unit, BY_NAME[name].scale, FEATURE_VALUES[name]) for name in observed
    ]
    return [*EGO_COLUMNS, *seen, *features]
