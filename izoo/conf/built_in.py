"""The choices ``contexts=city`` and ``contexts=catalogue``: the ten built-in cities, by feature or by scenario id."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Literal

from izoo.conf.own_traffic import SourceConfig
from izoo.contexts import catalogue
from izoo.contexts.cities.rebuilt import city_name
from izoo.contexts.source import ContextSource
from izoo.errors import IzooError

Season = Literal["winter", "spring", "summer", "fall"]
Hour = Literal["peak", "off-peak"]
Engine = Literal["combustion", "electric"]
Split = Literal["train", "validation", "test", "all"]


@dataclass(frozen=True)
class CityContexts(SourceConfig):
    """Intersections of the built-in cities, which are rebuilt from published statistics.

    ``city``, ``season``, ``hour``, ``engine`` and ``adoption`` take one value, a list of values, or null for all.

    Attributes:
        city: one of the ten cities, for example ``atlanta``; ``python -m izoo.contexts cities`` lists them.
        season: season of the weather.
        hour: ``peak`` or ``off-peak``.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        adoption: share of controlled vehicles, 0 to 1; null: the catalogue's 0.1, 0.2, 0.5, 0.75 and 1.
        split: ``train``, ``validation`` and ``test`` share out the intersections 80/10/10; ``all``: every one.
        approaches: ``one``: a context per incoming approach, fed from it alone; ``all``: one per intersection.
        weather: ``county``: by city and season; ``published``: the values of the paper's summer experiments
            (Salt Lake City and Atlanta).
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
    """

    name: Literal["city"] = "city"
    city: str | list[str] | None = "salt_lake_city"
    season: Season | list[Season] | None = "summer"
    hour: Hour | list[Hour] | None = "peak"
    engine: Engine | list[Engine] | None = "combustion"
    adoption: float | list[float] | None = 1.0 / 3.0
    split: Split = "all"
    approaches: Literal["one", "all"] = "one"
    weather: Literal["county", "published"] = "county"
    cv_vehicle: Literal["paper", "human"] = "paper"

    def __post_init__(self) -> None:
        super().__post_init__()
        for city in [self.city] if isinstance(self.city, str) else self.city or ():
            city_name(city)

    def source(self) -> ContextSource:
        """Return the scenarios, lazily; raises :class:`IzooError` where none is left."""
        own = {name: value for name, value in vars(self).items() if name not in vars(SourceConfig())}
        return catalogue.Scenarios(**own)


@dataclass(frozen=True)
class CatalogueContexts(SourceConfig):
    """Scenarios of the catalogue by id.

    Attributes:
        ids: ids, and ranges of ids with both ends included: ``[17,100..199]``; ``python -m izoo.contexts list`` finds
            them, ``show ID`` prints one.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
    """

    name: Literal["catalogue"] = "catalogue"
    ids: tuple[int | str, ...] = ()
    cv_vehicle: Literal["paper", "human"] = "paper"

    def source(self) -> ContextSource:
        """Return the scenarios, lazily."""
        if not self.ids:
            raise IzooError(
                f"contexts.ids is empty; give ids from 0 to {catalogue.SIZE - 1}: contexts.ids=[17,100..199]."
            )
        return catalogue.by_ids([_range(item) for item in self.ids], self.cv_vehicle)


def _range(item: int | str) -> range:
    low, dots, high = str(item).partition("..")
    with contextlib.suppress(ValueError):
        found = range(int(low), int(high if dots else low) + 1)
        if found and found[0] >= 0 and found[-1] < catalogue.SIZE:
            return found
    raise IzooError(
        f"contexts.ids has {item!r}; give an id from 0 to {catalogue.SIZE - 1}, or a range with its low end first, "
        "like 100..199."
    )
