"""A hand-made world for the tests of this room: four equal legs, without a net."""

from dataclasses import dataclass, field, replace

import numpy as np

from izoo.contexts.context import HOUR_FACTOR, Context
from izoo.contexts.spec import Approach, IntersectionSpec, Leg

LEGS = ("A", "B", "C", "D")


@dataclass(frozen=True)
class Roads:
    """The part of a RoadNet that traffic reads: four legs, two main lanes each, all turns."""

    approaches: tuple[str, ...] = LEGS
    exits: tuple[str, ...] = LEGS
    movement_turn: np.ndarray = field(
        default_factory=lambda: np.array([[-1, 2, 1, 0], [0, -1, 2, 1], [1, 0, -1, 2], [2, 1, 0, -1]], np.int8)
    )
    movement_links: np.ndarray = field(default_factory=lambda: 1 - np.eye(4, dtype=np.int64))
    main_lane_count: np.ndarray = field(default_factory=lambda: np.full(4, 2))
    speed_limit_mps: np.ndarray = field(default_factory=lambda: np.array([15.0, 15.0, 3.5, 15.0]))
    sources: tuple[dict[str, str], ...] = tuple({"AB": f"{leg}B2{leg}", "AA": f"{leg}A2{leg}"} for leg in LEGS)
    source_lanes: tuple[dict[str, tuple[int, ...]], ...] = tuple({"AB": (0, 1), "AA": (0, 1)} for _ in LEGS)
    incoming_edges: tuple[tuple[str, ...], ...] = tuple((f"{leg}2TL", f"{leg}2TL_intern") for leg in LEGS)
    outgoing_edge: tuple[str, ...] = tuple(f"TL2{leg}" for leg in LEGS)


def make_context(flow_vph: float = 500.0, legs: tuple[str, ...] = LEGS, **changes: object) -> Context:
    """Return a peak context in which every leg has ``flow_vph`` per main lane before the cap."""
    approach = Approach(("rs", "sl"), 200.0, 15.0, 0.0, flow_vph / HOUR_FACTOR["peak"])
    spec = IntersectionSpec(
        "test/1", "procedural", tuple(Leg(leg, 90.0 * k, approach, 2, 200.0, 15.0) for k, leg in enumerate(legs))
    )
    return replace(Context(spec), **changes)  # type: ignore[arg-type]
