"""Procedural contexts: four equal legs, described by a few numbers, each fixed or drawn."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from izoo.contexts.context import CV_VEHICLES, ENGINES, FLOW_CAP_VPH_PER_LANE, HOUR_FACTOR, Context
from izoo.contexts.distributions import Box, Choice, Key, Product, Uniform
from izoo.contexts.features import BY_NAME
from izoo.contexts.source import ContextList, Lazy
from izoo.contexts.spec import Approach, GhostSpec, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError, check_choice, check_range, unknown_choice

LEGS = "ABCD"
YELLOW_S = 3.0
LEFT_GREEN_S = 6.0
STRAIGHT_SOURCE_M = 246.0
MAX_LANES = 4
PHASE_COUNTS = (1, 2)

NAMED_VALUES: dict[str, tuple[Any, ...]] = {
    "phase_count": PHASE_COUNTS,
    "engine": ENGINES,
    "cv_vehicle": CV_VEHICLES,
    "approach": (*LEGS, "all"),
}


def signal_plan(phase_count: int, green_s: float, red_s: float) -> SignalPlan:
    """Return the main plan: through A and C, [their lefts], through B and D, [their lefts].

    The cycle is ``green_s + red_s + 6`` for one phase and ``+ 24`` for two. Lefts follow their through green, as in the
    released nets.
    """
    phases: list[SignalPhase] = []
    for axis, green in (("AC", green_s), ("BD", red_s)):
        phases += _green_then_yellow([(leg, _opposite(leg)) for leg in axis], green)
        if phase_count == 2:
            phases += _green_then_yellow([(leg, _left_of(leg)) for leg in axis], LEFT_GREEN_S)
    return SignalPlan(tuple(phases))


def procedural_intersection(
    lane_count: int = 1,
    phase_count: int = 1,
    inflow_vph_per_lane: float = 250.0,
    green_s: float = 26.0,
    red_s: float = 26.0,
    lane_length_m: float = 300.0,
    speed_limit_mps: float = 16.0,
    offset_s: float = 0.0,
    grade: float = 0.0,
) -> IntersectionSpec:
    """Build a procedural intersection: four equal legs A to D at bearings 0, 90, 180 and 270 degrees.

    Args:
        lane_count: lanes per approach, 1 to 4.
        phase_count: 1: straight only; 2: lefts as well, from the leftmost or only lane, in a phase of their own.
        inflow_vph_per_lane: peak arrivals per lane, veh/h, at most 900.
        green_s, red_s: through green of legs A and C, and of B and D.
        lane_length_m: node to node.
        speed_limit_mps: of every road.
        offset_s: shift of the ghosts' cycle against the main one.
        grade: rise over run, positive uphill towards the stop line, on every approach.

    The ghosts repeat the main signal: each leg's straight source shows what its straight movement does, ``offset_s``
    later, and its turning source is green for the rest of the cycle but a yellow.
    """
    check_choice("lane_count", lane_count, range(1, MAX_LANES + 1))
    check_choice("phase_count", phase_count, PHASE_COUNTS)
    check_range("inflow_vph_per_lane", inflow_vph_per_lane, 0.0, FLOW_CAP_VPH_PER_LANE, "veh/h")
    for name, value in (("green_s", green_s), ("red_s", red_s), ("offset_s", offset_s)):
        BY_NAME[name].check(value)
    turns = ["s"] * lane_count
    if phase_count == 2:
        turns[-1] = "sl"
    approach = Approach(
        lanes=tuple(turns),
        length_m=lane_length_m,
        speed_limit_mps=speed_limit_mps,
        grade=grade,
        aadt_per_lane=inflow_vph_per_lane / HOUR_FACTOR["peak"],
    )
    plan = signal_plan(phase_count, green_s, red_s)
    legs = tuple(
        Leg(name, 90.0 * index, approach, lane_count, lane_length_m, speed_limit_mps) for index, name in enumerate(LEGS)
    )
    ghosts = GhostSpec(
        yellow_s=YELLOW_S,
        offset_s=offset_s,
        straight_source_length_m=STRAIGHT_SOURCE_M,
        turning_source_length_m=None,
        repeats_main=True,
        outer_gates=False,
    )
    name = (
        f"procedural/{lane_count}x{phase_count}-q{inflow_vph_per_lane:.4g}-g{green_s:.4g}-r{red_s:.4g}"
        f"-l{lane_length_m:.4g}-v{speed_limit_mps:.4g}-o{offset_s:.4g}" + (f"-s{grade:.4g}" if grade else "")
    )
    return IntersectionSpec(name, "procedural", legs, plan, ghosts)


_SPEC_FEATURES = inspect.signature(procedural_intersection).parameters
DEFAULTS: dict[str, Any] = {
    **{name: feature.default for name, feature in _SPEC_FEATURES.items()},
    **{"adoption": 1.0 / 3.0, "temperature_c": 20.0, "humidity_pct": 46.0},
    **{"engine": "combustion", "cv_vehicle": "paper", "approach": "A"},
}
"""Every feature of a procedural context with the value it has when nothing is said: an easy, one-lane context with the
published Salt Lake City weather and demand from leg A alone. ``inflow_vph_per_lane`` is the peak inflow."""


def procedural_context(**values: Any) -> Context:
    """Build one procedural context; features that are not named take their value in :data:`DEFAULTS`."""
    for name in values:
        if name not in DEFAULTS:
            raise unknown_choice("procedural feature", name, DEFAULTS)
    point = {**DEFAULTS, **values}
    spec = procedural_intersection(**{name: point.pop(name) for name in _SPEC_FEATURES})
    approach = None if point["approach"] == "all" else point["approach"]
    return Context(spec, season=None, **{**point, "approach": approach})


class ProceduralSource:
    """A CMDP of procedural contexts: a distribution per feature, minus exclusion boxes.

    Args:
        features: per name in :data:`DEFAULTS` a fixed value, a list, or a distribution of
            :mod:`izoo.contexts.distributions`; a tuple of names draws them together. Features that are not named stay
            at their default. ``None`` means the ranges of the systematicity protocol's training set, exclusion
            included.
        exclude: boxes in which no context may lie.
    """

    def __init__(self, features: Mapping[Key, Any] | None = None, exclude: Sequence[Box] = ()) -> None:
        if features is None:
            features, exclude = _TRAIN_FEATURES, (*_TEST_BOXES, *exclude)
        self.product = Product(features, tuple(exclude))
        for key, distribution in self.product.features.items():
            check_support(key, distribution)

    def sample(self, generator: np.random.Generator) -> Context:
        """Draw one context."""
        return procedural_context(**self.product.sample(generator))

    def contexts(self) -> ContextList:
        """Return all contexts, in a stable order; refuses when a feature is an interval."""
        return _all(self.product)

    def interval_ends(self) -> ContextList:
        """Return the grid in which every interval is replaced by its two ends."""
        return _all(self.product.interval_ends())


def _point(product: Product, index: int) -> Context:
    return procedural_context(**product[index])


def _all(product: Product) -> ContextList:
    return ContextList(Lazy(len(product), functools.partial(_point, product)))


def _green_then_yellow(movements: list[tuple[str, str]], green_s: float) -> list[SignalPhase]:
    return [
        SignalPhase(green_s, tuple((start, end, "G") for start, end in movements)),
        SignalPhase(YELLOW_S, tuple((start, end, "y") for start, end in movements)),
    ]


def _opposite(leg: str) -> str:
    return LEGS[(LEGS.index(leg) + 2) % 4]


def _left_of(leg: str) -> str:
    """The leg that a left turn from ``leg`` leads to: the next one clockwise."""
    return LEGS[(LEGS.index(leg) + 1) % 4]


def check_support(key: Key, distribution: Any) -> None:
    """Check a feature's whole support against its legal values."""
    names = (key,) if isinstance(key, str) else key
    for name in names:
        if name not in DEFAULTS:
            raise unknown_choice("procedural feature", name, DEFAULTS)
        if isinstance(distribution, Uniform) and (name in NAMED_VALUES or name == "lane_count"):
            raise IzooError(f"{name} takes separate values; give a list instead of an interval.")
    ends: Any = (distribution.low, distribution.high) if isinstance(distribution, Uniform) else distribution.support
    for end in ends:
        for name, value in zip(names, (end,) if isinstance(key, str) else end, strict=True):
            if name in NAMED_VALUES:
                check_choice(name, value, NAMED_VALUES[name])
            elif name == "lane_count":
                check_choice(name, value, range(1, MAX_LANES + 1))
            else:
                BY_NAME[name].check(value)


_TEST_RANGES = {
    "inflow_vph_per_lane": (400.0, 500.0),
    "green_s": (26.0, 29.0),
    "red_s": (26.0, 29.0),
    "lane_length_m": (325.0, 500.0),
    "speed_limit_mps": (17.0, 18.0),
    "offset_s": (2.0, 3.0),
}
_TEST_SHAPES = ((2, 2), (3, 1))
_TEST_BOXES = tuple(Box({"lane_count": lanes, "phase_count": phases, **_TEST_RANGES}) for lanes, phases in _TEST_SHAPES)
_TRAIN_FEATURES: dict[Key, Any] = {
    "lane_count": [1, 2, 3],
    "phase_count": [1, 2],
    "inflow_vph_per_lane": Uniform(100.0, 600.0),
    "green_s": Uniform(20.0, 32.0),
    "red_s": Uniform(20.0, 32.0),
    "lane_length_m": Uniform(100.0, 775.0),
    "speed_limit_mps": Uniform(16.0, 20.0),
    "offset_s": Uniform(1.0, 3.0),
}

EASY = ProceduralSource({})
"""One fixed, easy context: one lane, straight on only, 250 veh/h from leg A."""
SYSTEMATICITY_TRAIN = ProceduralSource()
"""Training set of the systematicity protocol: wide ranges, without the test box."""
SYSTEMATICITY_TEST_SAMPLE = ProceduralSource(
    {
        ("lane_count", "phase_count"): Choice(_TEST_SHAPES),
        **{name: Uniform(low, high) for name, (low, high) in _TEST_RANGES.items()},
    }
)
"""The test box of the systematicity protocol, drawn from at random; ``interval_ends()`` is the published set of 128."""
