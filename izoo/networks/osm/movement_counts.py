"""Turning counts: vehicles per hour of the peak by intersection and movement, as traffic engineers count them."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE, HOUR_FACTOR
from izoo.contexts.spec import Approach, CountedApproach, IntersectionSpec, Leg
from izoo.errors import IzooError
from izoo.networks.net.connections import signal_links
from izoo.networks.osm.csv_tables import number, read_rows

COLUMNS = ("intersection", "from", "to", "vph")
Counts = Mapping[tuple[str, str], float]
"""Vehicles per hour by the legs where a movement comes from and leads to."""


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
    """Refuse counts of an approach to an exit that no lane leads to.

    Raises:
        IzooError: there is one; it names the movement and those that are served.
    """
    counted = [(leg.name, leg.approach) for leg in spec.legs if isinstance(leg.approach, CountedApproach)]
    if counted:
        _check_served(spec, [(leg, end) for leg, approach in counted for end, _ in approach.exit_counts])


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
    fields = {**vars(leg.approach), "aadt_per_lane": total / leg.approach.main_lane_count / HOUR_FACTOR["peak"]}
    counted = {"exit_counts": tuple(own.items())} if total > 0.0 else {}
    return dataclasses.replace(leg, approach=Approach(**{**fields, **counted}))
