"""One context-MDP: everything that is fixed for an episode, except its seed."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from izoo.contexts.population import DriverPopulation
from izoo.contexts.spec import IntersectionSpec, hold_floats
from izoo.errors import IzooError, check_choice, check_range

HOURS = ("peak", "off-peak")
HOUR_FACTOR = {"peak": 0.084, "off-peak": 0.055}
"""Share of the daily traffic that passes in the hour."""
FLOW_CAP_VPH_PER_LANE = 900.0
SEASONS = ("winter", "spring", "summer", "fall")
ENGINES = ("combustion", "electric")
CV_VEHICLES = ("paper", "human")
FLEET = ("passenger cars", "passenger trucks", "light commercial trucks", "transit buses")
"""Vehicle types in the order in which their shares are given."""


def checked_fleet(shares: Sequence[float]) -> tuple[float, ...]:
    """Return the shares of the fleet's types.

    Raises:
        IzooError: they are not four, or do not sum to 1.
    """
    fleet = tuple(float(share) for share in shares)
    if len(fleet) != len(FLEET) or min(fleet) < 0.0 or abs(sum(fleet) - 1.0) > 1e-6:
        raise IzooError(
            f"the fleet is {list(fleet)}; give the shares of {', '.join(FLEET)}, from 0 to 1, with a sum of 1."
        )
    return fleet


@dataclass(frozen=True)
class Context:
    """A context: with a seed it determines an episode entirely.

    Attributes:
        intersection: the roads, their demand and their signals.
        approach: the only leg with demand (one context-MDP per approach, as in the paper), or ``None`` for all.
        adoption: share of vehicles that are controlled (CVs), in [0, 1].
        hour: one of :data:`HOURS`.
        season: one of :data:`SEASONS`, or ``None`` when the weather was given as numbers.
        engine: one of :data:`ENGINES`; electric CVs emit nothing, human-driven vehicles stay combustion.
        temperature_c, humidity_pct: the weather.
        cv_vehicle: ``paper``: an uncommanded CV has the published CV parameters; ``human``: the
            driver and length that it would have had as a human-driven vehicle.
        drivers: the population that human drivers are drawn from; ``None``: the built-in one.
        fleet: shares of the four types of :data:`FLEET`, which sum to 1; ``None``: those of MOVES for 2019. Model years
            and fuels of each type are those of MOVES.
        context_id: the catalogue's integer id, or ``None`` for contexts outside the catalogue.
    """

    intersection: IntersectionSpec
    approach: str | None = None
    adoption: float = 1.0 / 3.0
    hour: str = "peak"
    season: str | None = "summer"
    engine: str = "combustion"
    temperature_c: float = 20.0
    humidity_pct: float = 46.0
    cv_vehicle: str = "paper"
    drivers: DriverPopulation | None = None
    fleet: tuple[float, ...] | None = None
    context_id: int | None = None

    def __post_init__(self) -> None:
        hold_floats(self)
        if self.approach is not None:
            check_choice(f"approach of {self.intersection.name}", self.approach, self.intersection.approach_names)
        check_range("adoption", self.adoption, 0.0, 1.0)
        check_choice("hour", self.hour, HOURS)
        if self.season is not None:
            check_choice("season", self.season, SEASONS)
        check_choice("engine", self.engine, ENGINES)
        check_choice("cv_vehicle", self.cv_vehicle, CV_VEHICLES)
        if self.fleet is not None:
            object.__setattr__(self, "fleet", checked_fleet(self.fleet))
        check_range("temperature", self.temperature_c, -60.0, 60.0, "degrees C")
        check_range("humidity", self.humidity_pct, 0.0, 100.0, "%")

    @property
    def name(self) -> str:
        """A short label: the intersection, and the approach where demand enters from one alone."""
        return self.intersection.name if self.approach is None else f"{self.intersection.name}/{self.approach}"

    @property
    def demand_approaches(self) -> tuple[str, ...]:
        """Legs that traffic enters from (those with AADT above zero)."""
        names = self.intersection.approach_names if self.approach is None else (self.approach,)
        return tuple(name for name in names if self.flow_vph_per_lane(name) > 0.0)

    def flow_vph_per_lane(self, leg: str) -> float:
        """Arrivals per main lane of ``leg`` in veh/h: AADT times the hour factor, at most 900."""
        approach = self.intersection.leg(leg).approach
        if approach is None or (self.approach is not None and self.approach != leg):
            return 0.0
        return min(approach.aadt_per_lane * HOUR_FACTOR[self.hour], FLOW_CAP_VPH_PER_LANE)

    def replace(self, **changes: Any) -> Context:
        """Return a copy with some fields changed; a catalogue id survives only if nothing else changed."""
        if changes and "context_id" not in changes:
            changes["context_id"] = None
        return dataclasses.replace(self, **changes)

    @functools.cached_property
    def content_hash(self) -> str:
        """SHA-256 over every field but ``context_id``, the place of the net file and that of the intersection.

        The built-in drivers and fleet, and exit counts where there are none, are left out, so that contexts keep the
        hash they had before these could be chosen.
        """
        fields = dataclasses.asdict(self)
        fields.pop("context_id")
        for name in ("drivers", "fleet"):
            if fields[name] is None:
                fields.pop(name)
        for name in ("net_path", "lonlat"):
            fields["intersection"].pop(name)
        for leg in fields["intersection"]["legs"]:
            if leg["approach"] and not leg["approach"]["exit_counts"]:
                leg["approach"].pop("exit_counts")
        return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
