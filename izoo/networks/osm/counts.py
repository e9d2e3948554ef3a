"""Counted traffic, from CSV tables that users give with an extract: AADT of streets, and turning counts."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE, HOUR_FACTOR
from izoo.contexts.spec import IntersectionSpec, Leg
from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.net.connections import signal_links
from izoo.networks.osm.streets import StreetMap, Way

COLUMNS = ("intersection", "from", "to", "vph")
Counts = Mapping[tuple[str, str], float]
"""Vehicles per hour by the legs where a movement comes from and leads to."""


def read_rows(
    path: Path | str, what: str, columns: Sequence[str], or_columns: Sequence[str] = ()
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield where each row stands, in words, and its values by column, without spaces around them.

    Args:
        path: the file.
        what: it holds, for messages.
        columns: that it must have, in any order and case.
        or_columns: at least one of these it must have too; those it lacks are empty.

    Raises:
        IzooError: the file cannot be read, or lacks columns.
    """
    path = expanded(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            names = {name.strip().lower(): name for name in reader.fieldnames or []}
            if not set(columns) <= set(names) or (or_columns and not set(or_columns) & set(names)):
                listed = ", ".join(columns) + (f", and {' or '.join(or_columns)}" if or_columns else "")
                raise IzooError(f"{path} needs a header with the columns {listed}; it has {list(names)}.")
            for row in reader:
                values = {name: (row.get(names.get(name, "")) or "").strip() for name in (*columns, *or_columns)}
                yield f"{path}, line {reader.line_num}", values
    except OSError as error:
        raise IzooError(f"cannot read {what} {path}: {error.strerror}; give a CSV file.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise IzooError(f"{path} cannot be read as a CSV table ({error}).") from error


def number(text: str, most: float, what: str, unit: str, place: str) -> float:
    """Return a number from 0 to ``most``; raises :class:`IzooError` for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= most:
        raise IzooError(f"{place}: {text!r} is not a usable {what}; write {unit} between 0 and {most:,.0f}.")
    return value


@dataclass(frozen=True)
class TrafficCounts:
    """Annual average daily traffic in veh/day by way id and by street name (lower case).

    A value by id is that of the way: of both directions for a two-way one. A value by name is that of the street: of
    both directions where traffic runs both ways.
    """

    by_way: Mapping[int, float] = field(default_factory=dict)
    by_name: Mapping[str, float] = field(default_factory=dict)

    def directional(self, ways: list[Way], *, both_ways: bool) -> float | None:
        """AADT of the arriving direction; ``None`` where the table says nothing.

        Args:
            ways: the approach's ways, nearest to the stop line first.
            both_ways: whether the leg also has outgoing lanes.
        """
        for way in ways:
            if way.id in self.by_way:
                return self.by_way[way.id] / (1.0 if way.oneway else 2.0)
        for way in ways:
            if way.name.lower() in self.by_name:
                return self.by_name[way.name.lower()] / (2.0 if both_ways else 1.0)
        return None


def read_counts(path: Path | str, streets: StreetMap) -> TrafficCounts:
    """Read a CSV table with the columns ``way`` (OpenStreetMap id) or ``name`` (street), and ``aadt`` (veh/day).

    Raises:
        IzooError: the file is missing, lacks the columns, holds something that is not a count, contradicts itself, or
            names a way or street that the extract does not have.
    """
    by_way: dict[int, float] = {}
    by_name: dict[str, float] = {}
    names = {way.name.lower() for way in streets.ways.values() if way.name}
    unknown: list[str] = []
    for place, row in read_rows(path, "the AADT table", ("aadt",), ("way", "name")):
        value = number(row["aadt"], 1e6, "AADT", "vehicles per day", place)
        way, name = row["way"], row["name"]
        if not way and not name:
            raise IzooError(f"{place}: a way id or a street name is missing.")
        if way and not way.removeprefix("-").isdecimal():  # editors number what is new below zero
            raise IzooError(f"{place}: {way!r} is not the id of a way; put street names in the column name.")
        known = int(way) in streets.ways if way else name.lower() in names
        if not known:
            unknown.append(way or name)
        elif way:
            _put(by_way, int(way), value, place)
        else:
            _put(by_name, name.lower(), value, place)
    if unknown:
        raise IzooError(
            f"{path} names {len(unknown)} ways that are not drivable streets of the extract "
            f"({', '.join(unknown[:5])}); correct or remove those lines."
        )
    return TrafficCounts(by_way, by_name)


def _put(table: dict[Any, float], key: Any, value: float, place: str) -> None:
    if table.setdefault(key, value) != value:
        raise IzooError(f"{place}: {key} has two different values, {table[key]:g} and {value:g}; keep one line.")


def read_movement_counts(path: Path | str) -> dict[str, Counts]:
    """Read a CSV table with the columns :data:`COLUMNS`; returns the counts by the key of the intersection.

    Raises:
        IzooError: the file is missing, lacks the columns, holds something that is not a count, or contradicts itself.
    """
    found: dict[str, dict[tuple[str, str], float]] = defaultdict(dict)
    for place, row in read_rows(path, "the counts", COLUMNS):
        key, start, end, text = row.values()
        if (start, end) in found[key]:
            raise IzooError(f"{place}: {key} has two counts from {start} to {end}; keep one line.")
        found[key][start, end] = number(text, 20_000.0, "count", "vehicles per hour", place)
    return dict(found)


def with_counts(spec: IntersectionSpec, counts: Counts) -> IntersectionSpec:
    """Return the intersection with counted demand on the approaches that are counted; it is then not imputed.

    Raises:
        IzooError: a count is of a movement that no lane serves.
    """
    _check_served(spec, counts)
    legs = tuple(_counted(leg, counts) for leg in spec.legs)
    known = {f"AADT of {start}" for start, _ in counts}
    return dataclasses.replace(spec, legs=legs, imputed=tuple(name for name in spec.imputed if name not in known))


def check_exit_counts(spec: IntersectionSpec) -> None:
    """Raise :class:`IzooError` for counts of an approach to an exit that no lane leads to."""
    _check_served(spec, [(leg.name, end) for leg in spec.legs if leg.approach for end, _ in leg.approach.exit_counts])


def peak_flows(spec: IntersectionSpec) -> dict[str, tuple[float, bool]]:
    """Return per approach the vehicles per hour of the peak that are played, and whether more were asked for."""
    found = {}
    for leg in spec.legs:
        if leg.approach is not None:
            per_lane = leg.approach.aadt_per_lane * HOUR_FACTOR["peak"]
            played = min(per_lane, FLOW_CAP_VPH_PER_LANE) * leg.approach.main_lane_count
            found[leg.name] = played, per_lane > FLOW_CAP_VPH_PER_LANE * (1.0 + 1e-9)
    return found


def _check_served(spec: IntersectionSpec, movements: Iterable[tuple[str, str]]) -> None:
    served = {(link.from_leg, link.to_leg) for link in signal_links(spec)}
    for start, end in movements:
        if (start, end) not in served:
            listed = ", ".join(f"{one} to {two}" for one, two in sorted(served))
            raise IzooError(f"no lane serves {start} to {end}; choose among {listed}.")


def _counted(leg: Leg, counts: Counts) -> Leg:
    own = {end: vph for (start, end), vph in counts.items() if start == leg.name}
    if leg.approach is None or not own:
        return leg
    total = sum(own.values())
    aadt_per_lane = total / leg.approach.main_lane_count / HOUR_FACTOR["peak"]
    exits = tuple(own.items()) if total > 0.0 else ()
    return dataclasses.replace(
        leg, approach=dataclasses.replace(leg.approach, aadt_per_lane=aadt_per_lane, exit_counts=exits)
    )
