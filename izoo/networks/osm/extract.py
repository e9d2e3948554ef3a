"""Intersections from an OpenStreetMap extract: a folder of specs that trains like a city.

The rules by which lanes, turns and limits are read and imputed stand in :mod:`izoo.networks.osm.tags`. Beyond those:

- length: to the next junction with a signal along the street, at most 680 m; a street that ends with the extract counts
  150 m at least and is marked as imputed;
- turn pockets: lanes that a way next to the stop line has over the way behind it, if that begins within 150 m;
- grade: from the elevation raster, over the whole approach; 0 and imputed without one;
- demand: from turning counts, from the AADT table, else per lane by street class and imputed;
- right turns on red: legal in North America, unless one of the approaches forbids them;
- signal plans: from a file of them, else searched for and marked as imputed.

Where traffic drives on the left the extract is mirrored (:mod:`izoo.networks.osm.streets`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from izoo.console import counted, plain
from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE
from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import LEG_NAMES, Approach, IntersectionSpec, Leg
from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.osm.carriageways import approach_of, exit_of
from izoo.networks.osm.counts import TrafficCounts, peak_flows, read_counts, read_movement_counts, with_counts
from izoo.networks.osm.elevation import Elevation
from izoo.networks.osm.junctions import Core, StreetGraph, find_cores
from izoo.networks.osm.legs import Street, find_streets
from izoo.networks.osm.plans import IMPUTED as PLAN_IMPUTED
from izoo.networks.osm.plans import read_plans, with_plan
from izoo.networks.osm.store import check_target, save_cmdp
from izoo.networks.osm.streets import Side, StreetMap, read_streets
from izoo.networks.osm.tags import class_default
from izoo.networks.osm.turn_bans import TurnBans, bans_turns_on_red

MAX_CORE_M = 120.0


def build_from_osm(
    file: Path | str,
    *,
    target: Path | str,
    elevation: Path | str | None = None,
    aadt: Path | str | None = None,
    signals: Path | str | None = None,
    counts: Path | str | None = None,
    drives_on: Side | None = None,
) -> OsmReport:
    """Find the signalised intersections of an extract and write them to ``target``, all or nothing.

    Args:
        file: the extract.
        target: a new or empty folder, or an earlier build, which is replaced unless it was edited.
        elevation: a raster of heights in m.
        aadt: a CSV table of traffic counts; see :func:`izoo.networks.osm.counts.read_counts`.
        signals: a JSON file of signal plans by intersection; see :mod:`izoo.networks.osm.plans`.
        counts: a CSV table of turning counts; see :func:`izoo.networks.osm.counts.read_movement_counts`.
        drives_on: the side that traffic drives on; ``None``: that of the country.

    Raises:
        IzooError: a file is missing or malformed, the extract has no usable signalised intersection, or the target has
            been edited since it was built.
    """
    file, target = expanded(file), expanded(target).absolute()
    check_target(target)
    plans = {} if signals is None else read_plans(signals)
    counted = {} if counts is None else read_movement_counts(counts)
    streets = read_streets(file, drives_on)
    builder = _Builder(
        streets,
        target.name,
        None if elevation is None else Elevation(elevation),
        TrafficCounts() if aadt is None else read_counts(aadt, streets),
    )
    builder.build()
    if not builder.specs:
        others = f", and {streets.uncycled} that blink, meter a ramp or wait for emergencies"
        reasons = "; ".join(f"{key}: {reason}" for key, reason in list(builder.skipped.items())[:3])
        raise IzooError(
            f"{file} has no usable intersection with traffic signals ({len(streets.signals)} signal nodes there"
            f"{others if streets.uncycled else ''}{'; ' + reasons if reasons else ''}); export a larger extract, with "
            "complete ways."
        )
    builder.give("turning counts", counted, with_counts, str(counts))
    builder.give("a signal plan", plans, with_plan, str(signals))
    notes = {
        "source": file.name,
        "source_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "elevation": elevation is not None,
        "aadt": aadt is not None,
        "signals": signals is not None,
        "counts": counts is not None,
        "mirrored": streets.mirrored,
        "skipped": builder.skipped,
    }
    save_cmdp(target, builder.specs, builder.details, notes)
    names = {key: detail["streets"] for key, detail in builder.details.items()}
    return OsmReport(target, streets, builder.specs, names, builder.skipped, builder.stray_signals)


class _Builder:
    """Works through the intersections of one extract."""

    def __init__(self, streets: StreetMap, name: str, elevation: Elevation | None, counts: TrafficCounts) -> None:
        self.streets, self.name, self.elevation, self.counts = streets, name, elevation, counts
        self.graph = StreetGraph(streets)
        self.specs: dict[str, IntersectionSpec] = {}
        self.details: dict[str, dict] = {}
        self.skipped: dict[str, str] = {}
        self.stray_signals = 0

    def build(self) -> None:
        cores = find_cores(self.graph)
        nodes = frozenset(node for core in cores for node in core.nodes)
        self.stray_signals = len(self.streets.signals) - sum(len(core.signals) for core in cores)
        for core in cores:
            try:
                legs = find_streets(self.graph, core, nodes - core.nodes)
                spec = self._spec(core, legs)
            except IzooError as error:
                self.skipped[str(core.id)] = str(error)
                continue
            key = str(core.id)
            places = [self.streets.drawn_lonlat(node) for node in core.nodes]
            self.specs[key] = spec
            self.details[key] = {
                "streets": {leg.name: street.name for leg, street in zip(spec.legs, legs, strict=True)},
                "lonlat": [sum(place[axis] for place in places) / len(places) for axis in (0, 1)],
                "nodes": sorted(core.nodes),
            }

    def give(
        self,
        what: str,
        values: Mapping[str, Any],
        given: Callable[[IntersectionSpec, Any], IntersectionSpec],
        file: str,
    ) -> None:
        """Give intersections what a ``file`` says of them, by their keys."""
        if astray := sorted(set(values) - set(self.specs)):
            raise IzooError(
                f"{file} has {what} for {astray[0]!r}, which is not an intersection of the extract; choose among "
                f"{', '.join(self.specs)}."
            )
        for key, value in values.items():
            try:
                self.specs[key] = given(self.specs[key], value)
            except IzooError as error:
                raise IzooError(f"{file}, {key}: {error}") from error

    def _spec(self, core: Core, streets: list[Street]) -> IntersectionSpec:
        width = max(self.graph.distance(one, two) for one in core.nodes for two in core.nodes)
        if width > MAX_CORE_M:
            raise IzooError(
                f"its junction nodes are spread over {width:.0f} m; only up to {MAX_CORE_M:.0f} m is taken."
            )
        if not 3 <= len(streets) <= len(LEG_NAMES):
            raise IzooError(f"{len(streets)} streets meet there; an intersection needs 3 to {len(LEG_NAMES)}.")
        guessed: list[str] = []
        exits = [exit_of(street) for street in streets]
        bare = [
            Leg(name, street.bearing_deg, _ANY_APPROACH, *exit_)
            for name, street, exit_ in zip(LEG_NAMES, streets, exits, strict=False)
        ]
        bans = TurnBans(self.graph, core)
        by_name = {leg.name: street for leg, street in zip(bare, streets, strict=True)}
        red_turns = _in_north_america(*self.streets.lonlat[core.id]) and not self.streets.mirrored
        legs = []
        for leg, street in zip(bare, streets, strict=True):
            available = frozenset(exits_by_turn(bare, leg.name)) if street.arriving else frozenset[str]()
            approach = None
            if available:
                banned = frozenset(
                    turn
                    for turn, names in exits_by_turn(bare, leg.name).items()
                    if all(bans.forbids(street, by_name[name]) for name in names)
                )
                approach = approach_of(self.graph, street, leg.name, available, banned, guessed)
                approach = self._with_grade_and_demand(approach, street, leg, guessed)
            legs.append(
                Leg(leg.name, leg.bearing_deg, approach, leg.exit_lanes, leg.exit_length_m, leg.exit_speed_limit_mps)
            )
        return IntersectionSpec(
            name=f"{self.name}/{core.id}",
            source="osm",
            legs=tuple(legs),
            right_on_red=red_turns and not bans_turns_on_red(self.graph, streets),
            imputed=(*guessed, PLAN_IMPUTED),
        )

    def _with_grade_and_demand(self, approach: Approach, street: Street, leg: Leg, guessed: list[str]) -> Approach:
        stub = max(street.arriving, key=lambda stub: stub.length_m)
        ways = [piece.way for main in street.arriving for piece in main.pieces]
        flow = self.counts.directional(ways, both_ways=leg.exit_lanes > 0)
        if flow is None:
            guessed.append(f"AADT of {leg.name}")
            aadt_per_lane = class_default(stub.pieces[0].way).aadt_per_lane
        else:
            aadt_per_lane = flow / approach.main_lane_count
        grade = self._grade(stub.nodes)
        if grade is None:
            guessed.append(f"grade of {leg.name}")
        return dataclasses.replace(approach, aadt_per_lane=aadt_per_lane, grade=grade or 0.0)

    def _grade(self, nodes: tuple[int, ...]) -> float | None:
        """Rise over run towards the stop line; ``None`` where a height is missing or the slope is implausible."""
        if self.elevation is None:
            return None
        run = sum(self.graph.distance(one, two) for one, two in itertools.pairwise(nodes))
        rise = self.elevation.at(self.streets.lonlat[nodes[0]]) - self.elevation.at(self.streets.lonlat[nodes[-1]])
        grade = rise / run if run > 0.0 else math.nan
        return grade if abs(grade) <= 0.25 else None


_ANY_APPROACH = Approach(("s",), 100.0, 10.0, 0.0, 0.0)
"""Stands in while only the exits matter."""


def _in_north_america(lon: float, lat: float) -> bool:
    return -170.0 < lon < -50.0 and 15.0 < lat < 75.0


@dataclass(frozen=True)
class OsmReport:
    """What a build found.

    Attributes:
        target: the folder that was written; :func:`izoo.networks.dataset.intersections.load_dataset` reads it.
        read: the streets of the extract.
        specs: the intersections, by id.
        streets: per intersection, the name of each leg's street.
        skipped: why other junctions with signals were left out, by id.
        stray_signals: signal nodes at no junction: pedestrian crossings, or streets cut by the extract's edge.
    """

    target: Path
    read: StreetMap
    specs: Mapping[str, IntersectionSpec]
    streets: Mapping[str, Mapping[str, str]]
    skipped: Mapping[str, str]
    stray_signals: int

    def __str__(self) -> str:
        places, read = counted(len(self.specs), "intersection"), self.read
        approaches = f"{sum(len(spec.approach_names) for spec in self.specs.values())} approaches"
        lines = [f"built {places} with {approaches} into {self.target}"]
        if read.mirrored:
            lines.append(
                f"  traffic drives on the left there ({read.mirrored}): all intersections are mirrored, east and west, "
                "left and right exchanged, so that it drives on the right; --drives-on right takes the map as it is"
            )
        for key, legs in self.streets.items():
            flows = peak_flows(self.specs[key])
            lines.append(f"  {key}: " + ", ".join(f"{k} {v or '-'}{_flow(*flows.get(k, ()))}" for k, v in legs.items()))
        lines += [f"  left out {key}: {reason}" for key, reason in self.skipped.items()]
        if self.stray_signals:
            lines.append(f"  {self.stray_signals} signal nodes stand at no junction (crossings, or the extract's edge)")
        if read.uncycled:
            lines.append(f"  {read.uncycled} signal nodes blink, meter a ramp or wait for emergencies: no cycle")
        if read.reversible:
            lines.append(f"  taken as two-way, whatever their direction by time: {', '.join(read.reversible)}")
        imputed = Counter(name.rsplit(" of ", 1)[0] for spec in self.specs.values() for name in spec.imputed)
        whole = {PLAN_IMPUTED: places}
        lines += [f"  imputed {kind}: {imputed[kind]} of {whole.get(kind, approaches)}" for kind in sorted(imputed)]
        return "\n".join(map(plain, lines))


def _flow(vph: float | None = None, cut: bool = False) -> str:
    if vph is None:
        return ""
    return f" ({vph:.0f} veh/h{f', cut to {FLOW_CAP_VPH_PER_LANE:.0f} per lane' if cut else ''})"
