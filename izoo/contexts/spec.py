"""What one intersection is: its legs, lanes, demand and signal plan, as frozen values.

Every source of intersections (procedural, city, OpenStreetMap, the published dataset) produces an
:class:`IntersectionSpec`; :mod:`izoo.networks` turns it into a SUMO net. The dataset brings a finished net, so its
specs also carry ``net_path``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from izoo.errors import IzooError, check_choice, check_line, check_range, plain_number

LEG_NAMES = "ABCDEF"
SOURCES = ("procedural", "city", "osm", "dataset")
TURNS = ("r", "s", "l")


def hold_floats(instance: Any) -> None:
    """Turn whole numbers in fields declared as float into floats, so that equal values hash alike (26 and 26.0), and
    numbers of NumPy's into Python's.
    """
    for field in dataclasses.fields(instance):
        value = plain_number(getattr(instance, field.name))
        is_whole = isinstance(value, int) and str(field.type).startswith("float")
        object.__setattr__(instance, field.name, float(value) if is_whole else value)


@dataclass(frozen=True)
class Approach:
    """The incoming side of a leg.

    Attributes:
        lanes: per lane at the stop line, right to left, the turns it may take: any non-empty subset of ``"rsl"``.
            Pocket lanes are included.
        length_m: node to node for procedural worlds, otherwise from the neighbour to the stop line, pocket included.
        speed_limit_mps: speed limit.
        grade: rise over run, positive uphill towards the stop line.
        aadt_per_lane: annual average daily traffic per main lane, veh/day; 0 means no demand.
        right_pockets, left_pockets: how many of ``lanes``, from the right and from the left, exist only in the pocket.
        pocket_length_m: length of the part with the pocket lanes; 0 when there are none.
        exit_counts: ``(leg, vehicles)`` of the exits that traffic takes, in any unit; empty: by rule
            (:mod:`izoo.networks.turning`).
    """

    lanes: tuple[str, ...]
    length_m: float
    speed_limit_mps: float
    grade: float
    aadt_per_lane: float
    right_pockets: int = 0
    left_pockets: int = 0
    pocket_length_m: float = 0.0
    exit_counts: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        hold_floats(self)
        if not self.lanes or any(not turns or set(turns) - set(TURNS) for turns in self.lanes):
            raise IzooError(f"approach lanes are {self.lanes!r}; each lane needs one or more of the turns r, s, l.")
        if self.main_lane_count < 1:
            raise IzooError(f"an approach of {len(self.lanes)} lanes cannot consist of pockets only.")
        check_range("approach length", self.length_m, 10.0, 5000.0, "m")
        check_range("speed limit", self.speed_limit_mps, 1.0, 60.0, "m/s")
        check_range("grade", self.grade, -0.35, 0.35)
        check_range("AADT per lane", self.aadt_per_lane, 0.0, 1e6, "veh/day")
        object.__setattr__(self, "exit_counts", tuple((str(leg), float(count)) for leg, count in self.exit_counts))
        for _, count in self.exit_counts:
            check_range("a count of vehicles to an exit", count, 0.0, 1e6)
        if self.exit_counts and not any(count for _, count in self.exit_counts):
            raise IzooError(f"exit counts are {dict(self.exit_counts)}; give a vehicle for one exit, or no counts.")

    @property
    def lane_count(self) -> int:
        """Lanes at the stop line, turn pockets included."""
        return len(self.lanes)

    @property
    def main_lane_count(self) -> int:
        """Lanes that exist over the whole approach."""
        return len(self.lanes) - self.right_pockets - self.left_pockets


@dataclass(frozen=True)
class Leg:
    """One street of the intersection.

    Attributes:
        name: one letter, ``A`` to ``F``; legs are named clockwise.
        bearing_deg: direction in which the leg leaves the junction, clockwise from north.
        approach: the incoming side, or ``None`` for a one-way street that leads away.
        exit_lanes: lanes of the outgoing side; 0 for a one-way street that leads in.
        exit_length_m, exit_speed_limit_mps: of the outgoing side.
    """

    name: str
    bearing_deg: float
    approach: Approach | None
    exit_lanes: int
    exit_length_m: float
    exit_speed_limit_mps: float

    def __post_init__(self) -> None:
        hold_floats(self)
        check_choice("leg name", self.name, tuple(LEG_NAMES))
        if self.approach is None and self.exit_lanes == 0:
            raise IzooError(f"leg {self.name} has neither incoming nor outgoing lanes.")


@dataclass(frozen=True)
class SignalPhase:
    """One interval of a fixed-time plan.

    Attributes:
        duration_s: length of the interval.
        states: one ``(from_leg, to_leg, colour)`` per movement that is not red: ``G`` protected green, ``g``
            permissive green, ``y`` yellow, ``s`` right turn on red after a stop. Movements left out are red.
    """

    duration_s: float
    states: tuple[tuple[str, str, str], ...]

    def __post_init__(self) -> None:
        hold_floats(self)


@dataclass(frozen=True)
class SignalPlan:
    """A fixed-time plan: phases in order, starting ``offset_s`` after the simulation does."""

    phases: tuple[SignalPhase, ...]
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        hold_floats(self)

    @property
    def cycle_s(self) -> float:
        """Length of the cycle."""
        return sum(phase.duration_s for phase in self.phases)


@dataclass(frozen=True)
class GhostSpec:
    """How the neighbouring (ghost) intersections shape arrivals.

    Attributes:
        through_green_s, cross_green_s, yellow_s: the ghost signal: green for the straight source, then for the
            turning source.
        offset_s: shift of the ghost signals against the main one.
        straight_source_length_m, turning_source_length_m: lengths of the two feeding edges; ``None`` repeats the
            approach's length.
        repeats_main: the straight source follows the main signal of the leg's own straight movement, shifted by
            ``offset_s``, and the turning source gets the rest of that cycle (procedural worlds); the green times above
            then do not count.
        outer_gates: whether gates of 82 s green, 3 s yellow and 5 s red stand at the outer ends of the sources.
    """

    through_green_s: float = 42.0
    cross_green_s: float = 42.0
    yellow_s: float = 3.0
    offset_s: float = 0.0
    straight_source_length_m: float | None = None
    turning_source_length_m: float | None = None
    repeats_main: bool = False
    outer_gates: bool = True

    def __post_init__(self) -> None:
        hold_floats(self)


@dataclass(frozen=True)
class IntersectionSpec:
    """One signalised intersection, complete enough to build its SUMO net.

    Attributes:
        name: unique within its source, for example ``salt-lake-city/19``.
        source: one of :data:`SOURCES`.
        legs: the streets, in letter order.
        signal_plan: the fixed-time plan; ``None`` asks :mod:`izoo.networks` to search for one.
        ghosts: the neighbouring intersections.
        right_on_red: whether right turns on red after a stop are legal.
        city: one of the ten built-in city names, or ``None``.
        imputed: names of the values that were guessed because the source lacks them.
        net_path: a finished SUMO net, for the published dataset.
        net_sha256: digest of that file, so that a context's hash covers its content.
        lonlat: where it lies, in degrees; ``None`` where that is unknown.
    """

    name: str
    source: str
    legs: tuple[Leg, ...]
    signal_plan: SignalPlan | None = None
    ghosts: GhostSpec = GhostSpec()
    right_on_red: bool = False
    city: str | None = None
    imputed: tuple[str, ...] = ()
    net_path: str | None = None
    net_sha256: str | None = None
    lonlat: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        hold_floats(self)
        if self.lonlat is not None:
            object.__setattr__(self, "lonlat", tuple(self.lonlat))
        check_line("the name of an intersection", self.name)
        check_choice("intersection source", self.source, SOURCES)
        names = [leg.name for leg in self.legs]
        if len(set(names)) != len(names) or len(names) < 2:
            raise IzooError(f"intersection {self.name} has legs {names}; it needs two or more, each with its own name.")
        if not any(leg.approach for leg in self.legs) or not any(leg.exit_lanes for leg in self.legs):
            raise IzooError(f"intersection {self.name} needs at least one incoming and one outgoing leg.")

    def leg(self, name: str) -> Leg:
        """Return the leg called ``name``."""
        for leg in self.legs:
            if leg.name == name:
                return leg
        raise IzooError(f"intersection {self.name} has no leg {name!r}; its legs: {', '.join(self.leg_names)}.")

    @property
    def leg_names(self) -> tuple[str, ...]:
        """All legs, in order."""
        return tuple(leg.name for leg in self.legs)

    @property
    def approach_names(self) -> tuple[str, ...]:
        """Legs with an incoming side, in order."""
        return tuple(leg.name for leg in self.legs if leg.approach is not None)


def spec_from_dict(fields: Mapping[str, Any]) -> IntersectionSpec:
    """Rebuild a spec from ``dataclasses.asdict``, also after a way through JSON."""
    legs = []
    for leg in fields["legs"]:
        approach = leg["approach"]
        if approach is not None:
            approach = Approach(**{**approach, "lanes": tuple(approach["lanes"])})
        legs.append(Leg(**{**leg, "approach": approach}))
    plan = fields["signal_plan"]
    if plan is not None:
        phases = tuple(SignalPhase(p["duration_s"], tuple(tuple(s) for s in p["states"])) for p in plan["phases"])
        plan = SignalPlan(phases, plan["offset_s"])
    changes = {"legs": tuple(legs), "signal_plan": plan, "imputed": tuple(fields["imputed"])}
    return IntersectionSpec(**{**fields, **changes, "ghosts": GhostSpec(**fields["ghosts"])})
