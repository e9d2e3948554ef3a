"""The choices ``contexts=dataset`` and ``contexts=osm``: intersections in a folder of the user's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from izoo.conf.built_in import Engine, Hour, Season, Split
from izoo.conf.own_traffic import SourceConfig
from izoo.contexts.cities.weather import weather
from izoo.contexts.context import Context
from izoo.contexts.source import ContextList, ContextSource
from izoo.contexts.splits import split_names
from izoo.errors import IzooError
from izoo.files import make_absolute


@dataclass(frozen=True)
class FolderContexts(SourceConfig):
    """Intersections in a folder of the user's.

    Attributes:
        path: the folder.
        split: ``train``, ``validation`` and ``test`` share out the intersections 80/10/10 by name; ``all``: every one.
        approaches: ``one``: a context per incoming approach, fed from it alone; ``all``: one per intersection.
        adoption: share of controlled vehicles, 0 to 1; a list of shares: every context once with each.
        hour: ``peak`` or ``off-peak``.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
    """

    path: str | None = None
    split: Split = "all"
    approaches: Literal["one", "all"] = "one"
    adoption: float | list[float] = 1.0 / 3.0
    hour: Hour = "peak"
    engine: Engine = "combustion"
    cv_vehicle: Literal["paper", "human"] = "paper"
    remedy: ClassVar[str] = "give the folder of the intersections"

    def __post_init__(self) -> None:
        super().__post_init__()
        make_absolute(self, "path")
        if self.adoption == []:
            raise IzooError("contexts.adoption is an empty list; give a share from 0 to 1, or a list of shares.")

    def check(self) -> Path:
        """Return the folder; raise :class:`IzooError` where none is named, or none is there; reads nothing."""
        if self.path is None:
            raise IzooError(f"contexts={self.name} needs a folder: contexts.path=DIR.")
        if not Path(self.path).exists():
            raise IzooError(f"contexts.path={self.path} does not exist; {self.remedy}.")
        return Path(self.path)

    def load(self, **fields: Any) -> ContextList:
        """Read the folder and return its contexts, with further fields of each."""
        # Imported here: reading options must not wait for SUMO's packages.
        from izoo.networks.dataset.intersections import load_dataset

        shares = [self.adoption] if isinstance(self.adoption, float) else self.adoption
        same = {name: getattr(self, name) for name in ("approaches", "hour", "engine", "cv_vehicle")}
        contexts = load_dataset(self.check(), adoption=shares[0], **same, **fields)
        if len(shares) > 1:
            contexts = ContextList([context.replace(adoption=share) for share in shares for context in contexts])
        if self.split == "all":
            return contexts
        names = list(dict.fromkeys(context.intersection.name for context in contexts))
        chosen = set(split_names(names)[self.split])
        if not chosen:
            raise IzooError(
                f"{self.path} has {len(names)} intersections, too few for a {self.split} set; choose "
                "contexts.split=all."
            )
        return ContextList([context for context in contexts if context.intersection.name in chosen])


@dataclass(frozen=True)
class DatasetContexts(FolderContexts):
    """The published dataset of measured intersections, downloaded by the user.

    Attributes:
        path: a folder of intersection folders, or one intersection folder with ``net.net.xml`` and ``inflows.txt``.
        season: season of the weather.
        weather: ``published``: the values of the paper's summer experiments (those of Salt Lake City where a folder
            is not named after one of the ten cities); ``county``: by city and season.
    """

    name: Literal["dataset"] = "dataset"
    season: Season = "summer"
    weather: Literal["published", "county"] = "published"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weather == "published" and self.season != "summer":
            raise IzooError(
                f"contexts.season is {self.season!r}, but contexts.weather=published is the weather of the paper's "
                "summer; choose contexts.season=summer or contexts.weather=county."
            )

    def source(self) -> ContextSource:
        """Read the folders and return their contexts; raises :class:`IzooError` naming the file that cannot be used."""
        contexts = self.load()
        if self.weather == "published":
            return contexts
        return ContextList([_with_county_weather(context, self.season) for context in contexts])


@dataclass(frozen=True)
class OsmContexts(FolderContexts):
    """Intersections that ``python -m izoo.contexts build --osm FILE OUT`` made of an OpenStreetMap extract.

    Attributes:
        path: the folder ``OUT``.
        temperature_c, humidity_pct: the weather.
    """

    name: Literal["osm"] = "osm"
    temperature_c: float = 20.0
    humidity_pct: float = 46.0
    remedy = "build intersections first: python -m izoo.contexts build --osm FILE OUT"

    def check(self) -> Path:
        """Return the folder; raise :class:`IzooError` also where it holds no such build; reads nothing."""
        from izoo.networks.osm.store import CMDP_FILE

        folder = super().check()
        if not (folder / CMDP_FILE).is_file():
            raise IzooError(f"{self.path} holds no intersections built from OpenStreetMap; {self.remedy}.")
        return folder

    def source(self) -> ContextSource:
        """Read the folder and return its contexts; raises :class:`IzooError` where it is no such folder."""
        return self.load(temperature_c=self.temperature_c, humidity_pct=self.humidity_pct, season=None)


def _with_county_weather(context: Context, season: str) -> Context:
    spec = context.intersection
    if spec.city is None:
        raise IzooError(
            f"contexts.weather=county needs the city, and {spec.name} does not lie in a folder named after one of the "
            "ten; rename the folder or choose contexts.weather=published."
        )
    temperature_c, humidity_pct = weather(spec.city, season)
    return context.replace(temperature_c=temperature_c, humidity_pct=humidity_pct, season=season)
