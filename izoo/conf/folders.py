"""The choices ``contexts=dataset`` and ``contexts=osm``: intersections in a folder of the user's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from izoo.conf.built_in import Engine, Hour, Season, Split
from izoo.conf.own_traffic import check_traffic, with_own_traffic
from izoo.contexts.cities.weather import weather
from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, ContextSource
from izoo.contexts.splits import split_names
from izoo.errors import IzooError, check_range, check_types
from izoo.files import expanded


@dataclass(frozen=True)
class DatasetContexts:
    """The published dataset of measured intersections, downloaded by the user.

    Attributes:
        name: the source.
        path: a folder of intersection folders, or one intersection folder with ``net.net.xml`` and ``inflows.txt``.
        split: ``train``, ``validation`` and ``test`` share out the intersections 80/10/10 by name; ``all``: every one.
        approaches: ``one``: a context per incoming approach, fed from it alone; ``all``: one per intersection.
        adoption: share of controlled vehicles, 0 to 1; a list of shares: every context once with each.
        hour: ``peak`` or ``off-peak``.
        season: season of the weather.
        weather: ``published``: the values of the paper's summer experiments (those of Salt Lake City where a folder
            is not named after one of the ten cities); ``county``: by city and season.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
        drivers: a population that ``python -m izoo.drivers calibrate`` wrote, as a JSON file; null: the built-in one.
        fleet: shares of passenger cars, passenger trucks, light commercial trucks and transit buses, with a sum of 1:
            ``[0.7,0.2,0.06,0.04]``; null: those of MOVES for 2019.
    """

    name: Literal["dataset"] = "dataset"
    path: str | None = None
    split: Split = "all"
    approaches: Literal["one", "all"] = "one"
    adoption: float | list[float] = 1.0 / 3.0
    hour: Hour = "peak"
    season: Season = "summer"
    weather: Literal["published", "county"] = "published"
    engine: Engine = "combustion"
    cv_vehicle: Literal["paper", "human"] = "paper"
    drivers: str | None = None
    fleet: list[float] | None = None

    def __post_init__(self) -> None:
        check_types("contexts", self)
        _check_adoption(self.adoption)
        if self.weather == "published" and self.season != "summer":
            raise IzooError(
                f"contexts.season is {self.season!r}, but contexts.weather=published is the weather of the paper's "
                "summer; choose contexts.season=summer or contexts.weather=county."
            )
        _make_absolute(self)

    def check(self) -> None:
        """Raise :class:`IzooError` where no folder is named, or none is there; reads nothing."""
        _check(self.name, self.path)

    def build(self) -> ContextSource:
        """Read the folders and return their contexts; raises :class:`IzooError` naming the file that cannot be used."""
        contexts = _load(self, self.path, {})
        if self.weather == "county":
            contexts = ContextList([_with_county_weather(context, self.season) for context in contexts])
        return with_own_traffic(contexts, self)


@dataclass(frozen=True)
class OsmContexts:
    """Intersections that ``python -m izoo.contexts build --osm FILE OUT`` made of an OpenStreetMap extract.

    Attributes:
        name: the source.
        path: the folder ``OUT``.
        split: ``train``, ``validation`` and ``test`` share out the intersections 80/10/10 by name; ``all``: every one.
        approaches: ``one``: a context per incoming approach, fed from it alone; ``all``: one per intersection.
        adoption: share of controlled vehicles, 0 to 1; a list of shares: every context once with each.
        hour: ``peak`` or ``off-peak``.
        temperature_c, humidity_pct: the weather.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
        drivers: a population that ``python -m izoo.drivers calibrate`` wrote, as a JSON file; null: the built-in one.
        fleet: shares of passenger cars, passenger trucks, light commercial trucks and transit buses, with a sum of 1:
            ``[0.7,0.2,0.06,0.04]``; null: those of MOVES for 2019.
    """

    name: Literal["osm"] = "osm"
    path: str | None = None
    split: Split = "all"
    approaches: Literal["one", "all"] = "one"
    adoption: float | list[float] = 1.0 / 3.0
    hour: Hour = "peak"
    temperature_c: float = 20.0
    humidity_pct: float = 46.0
    engine: Engine = "combustion"
    cv_vehicle: Literal["paper", "human"] = "paper"
    drivers: str | None = None
    fleet: list[float] | None = None

    def __post_init__(self) -> None:
        check_types("contexts", self)
        _check_adoption(self.adoption)
        check_range("contexts.temperature_c", self.temperature_c, -60.0, 60.0, "degrees C")
        check_range("contexts.humidity_pct", self.humidity_pct, 0.0, 100.0, "%")
        _make_absolute(self)

    def check(self) -> None:
        """Raise :class:`IzooError` where no folder is named, or it holds no such build; reads nothing."""
        from izoo.networks.osm.store import CMDP_FILE

        remedy = "build intersections first: python -m izoo.contexts build --osm FILE OUT"
        if not (_check(self.name, self.path, remedy) / CMDP_FILE).is_file():
            raise IzooError(f"{self.path} holds no intersections built from OpenStreetMap; {remedy}.")

    def build(self) -> ContextSource:
        """Read the folder and return its contexts; raises :class:`IzooError` where it is no such folder."""
        self.check()
        fields = {"temperature_c": self.temperature_c, "humidity_pct": self.humidity_pct, "season": None}
        return with_own_traffic(_load(self, self.path, fields), self)


def _check_adoption(adoption: float | list[float]) -> None:
    if adoption == []:
        raise IzooError("contexts.adoption is an empty list; give a share from 0 to 1, or a list of shares.")
    for share in [adoption] if isinstance(adoption, float) else adoption:
        check_range("contexts.adoption", share, 0.0, 1.0)


def _check(name: str, path: str | None, remedy: str = "give the folder of the intersections") -> Path:
    if path is None:
        raise IzooError(f"contexts={name} needs a folder: contexts.path=DIR.")
    if not Path(path).exists():
        raise IzooError(f"contexts.path={path} does not exist; {remedy}.")
    return Path(path)


def _load(config: DatasetContexts | OsmContexts, path: str | None, fields: dict[str, Any]) -> ContextList:
    # Imported here: reading options must not wait for SUMO's packages.
    from izoo.networks.dataset.intersections import load_dataset

    folder = _check(config.name, path)
    shares = [config.adoption] if isinstance(config.adoption, float) else config.adoption
    contexts = load_dataset(
        folder,
        approaches=config.approaches,
        adoption=shares[0],
        hour=config.hour,
        engine=config.engine,
        cv_vehicle=config.cv_vehicle,
        **fields,
    )
    if len(shares) > 1:
        contexts = ContextList([context.replace(adoption=share) for share in shares for context in contexts])
    if config.split == "all":
        return contexts
    names = list(dict.fromkeys(context.intersection.name for context in contexts))
    chosen = set(split_names(names)[config.split])
    if not chosen:
        raise IzooError(
            f"{path} has {len(names)} intersections, too few for a {config.split} set; choose contexts.split=all."
        )
    return ContextList([context for context in contexts if context.intersection.name in chosen])


def _with_county_weather(context: Context, season: str) -> Context:
    spec = context.intersection
    if spec.city is None:
        raise IzooError(
            f"contexts.weather=county needs the city, and {spec.name} does not lie in a folder named after one of the "
            "ten; rename the folder or choose contexts.weather=published."
        )
    temperature_c, humidity_pct = weather(spec.city, season)
    return context.replace(temperature_c=temperature_c, humidity_pct=humidity_pct, season=season)


def _make_absolute(config: DatasetContexts | OsmContexts) -> None:
    """Resolve the paths, so that a run can be resumed and evaluated from another folder."""
    if config.path is not None:
        object.__setattr__(config, "path", str(expanded(config.path).absolute()))
    check_traffic(config)
