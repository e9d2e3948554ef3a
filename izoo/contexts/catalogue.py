"""The catalogue: 1,306,720 scenarios, each with an integer id that rebuilds it on any machine.

A scenario is (intersection of a city) x season x adoption level x hour x engine. :class:`Scenarios` is a lazy set of
them: it filters and counts by arithmetic and builds a context only when it is asked for one.
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, Literal, NamedTuple

import numpy as np

from izoo.contexts.cities.rebuilt import CITIES, SIZES, city_name, city_table
from izoo.contexts.cities.rebuilt import get as get_city
from izoo.contexts.cities.shapes import SHAPES
from izoo.contexts.cities.weather import WEATHER_PUBLISHED, weather
from izoo.contexts.context import CV_VEHICLES, ENGINES, HOURS, SEASONS, Context
from izoo.contexts.source import ContextList, Lazy
from izoo.contexts.spec import LEG_NAMES
from izoo.contexts.splits import SplitName, city_split
from izoo.errors import IzooError, check_choice, check_range, plain_number

ADOPTIONS = (0.1, 0.2, 0.5, 0.75, 1.0)
"""Adoption levels of the catalogue."""
_LEVELS: tuple[tuple[Any, ...], ...] = (SEASONS, ADOPTIONS, HOURS, ENGINES)
PER_INTERSECTION = 80
"""Scenarios per intersection: 4 seasons x 5 adoption levels x 2 hours x 2 engines."""
INTERSECTIONS = sum(SIZES.values())
SIZE = INTERSECTIONS * PER_INTERSECTION
_SHAPE = (INTERSECTIONS, *map(len, _LEVELS))
APPROACHES = ("all", "one")
WEATHERS = ("county", "published")


class Scenario(NamedTuple):
    """What an id stands for."""

    city: str
    intersection: int
    season: str
    adoption: float
    hour: str
    engine: str


def find_id(city: str, intersection: int, season: str, adoption: float, hour: str, engine: str) -> int:
    """Return the catalogue's id of a scenario."""
    city = city_name(city)
    if not 0 <= intersection < SIZES[city]:
        raise IzooError(f"intersection {intersection} of {city} does not exist; legal: 0 to {SIZES[city] - 1}.")
    values, digits = (season, adoption, hour, engine), []
    for name, value, legal in zip(("season", "adoption level", "hour", "engine"), values, _LEVELS, strict=True):
        check_choice(name, value, legal)
        digits.append(legal.index(value))
    place = sum(SIZES[name] for name in CITIES[: CITIES.index(city)]) + intersection
    return int(np.ravel_multi_index((place, *digits), _SHAPE))


def describe(context_id: int) -> Scenario:
    """Return what an id stands for, without building it."""
    if isinstance(context_id, bool) or not isinstance(context_id, (int, np.integer)) or not 0 <= context_id < SIZE:
        raise IzooError(
            f"context id {plain_number(context_id)!r} does not exist; ids are integers from 0 to {SIZE - 1}."
        )
    place, *digits = map(int, np.unravel_index(int(context_id), _SHAPE))
    ends = list(itertools.accumulate(SIZES.values()))
    which = bisect.bisect_right(ends, place)
    intersection = place - ends[which] + SIZES[CITIES[which]]
    return Scenario(CITIES[which], intersection, *(legal[k] for legal, k in zip(_LEVELS, digits, strict=True)))


def get(context_id: int) -> Context:
    """Build the scenario with an id: demand from all approaches, weather of its city's county."""
    return build(describe(context_id))


def build(
    scenario: Scenario, approach: str | None = None, weather_from: str = "county", cv_vehicle: str = "paper"
) -> Context:
    """Build a scenario; one that is not in the catalogue as it stands gets no id.

    Args:
        scenario: its ``adoption`` may be any share.
        approach: the only leg with demand; ``None`` for all.
        weather_from: ``county`` (by season) or ``published`` (the paper's fixed values, two cities only).
        cv_vehicle: whose parameters uncommanded CVs have; see :class:`~izoo.contexts.context.Context`.
    """
    check_choice("weather", weather_from, WEATHERS)
    if weather_from == "published":
        check_choice("city with published weather", scenario.city, WEATHER_PUBLISHED)
        temperature_c, humidity_pct = WEATHER_PUBLISHED[scenario.city]
    else:
        temperature_c, humidity_pct = weather(scenario.city, scenario.season)
    as_listed = approach is None and weather_from == "county" and cv_vehicle == "paper"
    listed = as_listed and scenario.adoption in ADOPTIONS
    return Context(
        intersection=get_city(scenario.city)[scenario.intersection],
        approach=approach,
        adoption=scenario.adoption,
        hour=scenario.hour,
        season=scenario.season if weather_from == "county" else None,
        engine=scenario.engine,
        temperature_c=temperature_c,
        humidity_pct=humidity_pct,
        cv_vehicle=cv_vehicle,
        context_id=find_id(*scenario) if listed else None,
    )


class Scenarios(ContextList):
    """A lazy, finite CMDP of city scenarios, in catalogue order; one-approach contexts follow in letter order.

    Args:
        city, season, hour, engine: one value or several; ``None`` means all.
        adoption: one share or several; any share in [0, 1]; ``None`` means the catalogue's levels.
        split: which intersections of each city (:mod:`izoo.contexts.splits`).
        approaches: ``all``: demand from every approach at once; ``one``: one context per approach (the paper's form).
        weather: ``county`` or ``published``: that of the paper's summer, so that ``season`` must be ``summer``.
        cv_vehicle: ``paper`` or ``human``.
    """

    def __init__(
        self,
        city: str | Iterable[str] | None = None,
        season: str | Iterable[str] | None = None,
        hour: str | Iterable[str] | None = None,
        engine: str | Iterable[str] | None = None,
        adoption: float | Iterable[float] | None = None,
        split: SplitName = "all",
        approaches: Literal["all", "one"] = "all",
        weather: Literal["county", "published"] = "county",
        cv_vehicle: Literal["paper", "human"] = "paper",
    ) -> None:
        check_choice("approaches", approaches, APPROACHES)
        check_choice("weather", weather, WEATHERS)
        check_choice("cv_vehicle", cv_vehicle, CV_VEHICLES)
        self.approaches, self.weather, self.cv_vehicle = approaches, weather, cv_vehicle
        self.cities = _ordered("city", [city_name(name) for name in _several(city, CITIES)], CITIES)
        seasons = _ordered("season", _several(season, SEASONS), SEASONS)
        hours = _ordered("hour", _several(hour, HOURS), HOURS)
        engines = _ordered("engine", _several(engine, ENGINES), ENGINES)
        shares = _several(adoption, ADOPTIONS)
        for value in shares:
            check_range("adoption", value, 0.0, 1.0)
        adoptions = tuple(sorted({float(value) for value in shares}))
        if weather == "published":
            if seasons != ("summer",):
                raise IzooError(
                    f"season is {season!r}, but weather='published' is the weather of the paper's summer; choose "
                    "season='summer' or weather='county'."
                )
            for name in self.cities:
                check_choice("city with published weather", name, WEATHER_PUBLISHED)
        self._levels: tuple[tuple[Any, ...], ...] = (seasons, adoptions, hours, engines)
        self._places = [np.asarray(city_split(name, split)) for name in self.cities]
        counts = [
            _contexts_per_intersection(name, approaches)[places]
            for name, places in zip(self.cities, self._places, strict=True)
        ]
        self._ends = np.cumsum(np.concatenate(counts)) if counts else np.zeros(0, dtype=int)
        self._city_ends = np.cumsum([len(places) for places in self._places])
        count = int(self._ends[-1]) * self._per_place if len(self._ends) else 0
        if count == 0:
            raise IzooError("no scenario is selected: a filter is empty; leave it out to mean every value.")
        super().__init__(Lazy(count, self._build))

    def _build(self, index: int) -> Context:
        return build(*self.locate(index), self.weather, self.cv_vehicle)

    @property
    def _per_place(self) -> int:
        return int(np.prod([len(level) for level in self._levels]))

    def locate(self, index: int) -> tuple[Scenario, str | None]:
        """Return what entry ``index`` stands for, without building it: the scenario and its only approach, if any."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"entry {index} of {len(self)} scenarios does not exist.")
        number = int(index) % len(self)
        # In catalogue order the intersection varies slowest, then (for one-approach contexts) season ... approach.
        place = int(np.searchsorted(self._ends, number // self._per_place, side="right"))
        first = int(self._ends[place - 1]) if place else 0
        within = number - first * self._per_place
        within, leg = divmod(within, int(self._ends[place]) - first)
        digits = np.unravel_index(within, [len(level) for level in self._levels])
        values = (level[digit] for level, digit in zip(self._levels, digits, strict=True))
        which = int(np.searchsorted(self._city_ends, place, side="right"))
        city = self.cities[which]
        intersection = int(self._places[which][place - (int(self._city_ends[which - 1]) if which else 0)])
        scenario = Scenario(city, intersection, *values)
        return scenario, None if self.approaches == "all" else _incoming(city, intersection)[leg]


def by_ids(ids: Sequence[range], cv_vehicle: str = "paper") -> ContextList:
    """Return the scenarios with the ids in some ranges, in that order, each built when it is asked for."""
    check_choice("cv_vehicle", cv_vehicle, CV_VEHICLES)
    for several in ids:
        if len(several):
            describe(several[0]), describe(several[-1])
    return ContextList(Lazy(sum(map(len, ids)), functools.partial(_listed, list(ids), cv_vehicle)))


def _listed(ids: Sequence[range], cv_vehicle: str, index: int) -> Context:
    for numbers in ids:
        if index < len(numbers):
            return build(describe(numbers[index]), cv_vehicle=cv_vehicle)
        index -= len(numbers)
    raise AssertionError("unreachable: the index was checked")


def _several(value: Any, every: tuple[Any, ...]) -> tuple[Any, ...]:
    if value is None:
        return every
    if isinstance(value, (str, Real)):
        return (value,)
    return tuple(value)


def _ordered(what: str, values: Sequence[str], legal: tuple[str, ...]) -> tuple[str, ...]:
    """Check names and return them once each, in catalogue order."""
    for value in values:
        check_choice(what, value, legal)
    return tuple(value for value in legal if value in values)


def _contexts_per_intersection(city: str, approaches: str) -> np.ndarray:
    if approaches == "all":
        return np.ones(SIZES[city], dtype=int)
    return np.diff(city_table(city).first)


def _incoming(city: str, intersection: int) -> tuple[str, ...]:
    """Names of the incoming legs of an intersection."""
    return tuple(LEG_NAMES[leg] for leg in SHAPES[city_table(city).shape[intersection]].incoming)
