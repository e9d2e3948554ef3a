"""Choices of ``contexts=``: which set of context-MDPs episodes are drawn from."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Union

from izoo.contexts.context import CV_VEHICLES, ENGINES, HOURS
from izoo.contexts.distributions import Uniform
from izoo.contexts.procedural import EASY, SYSTEMATICITY_TEST_SAMPLE, SYSTEMATICITY_TRAIN, ProceduralSource
from izoo.contexts.source import ContextSource
from izoo.errors import IzooError, check_choice, check_range

PRESETS = {
    "systematicity_train": SYSTEMATICITY_TRAIN,
    "systematicity_test": SYSTEMATICITY_TEST_SAMPLE,
    "easy": EASY,
}
Setting = Union[float, str, list[Any], None]
"""Of a procedural feature: a number or a name, a list of them, ``low..high`` for an interval, or null for the preset's."""


@dataclass(frozen=True)
class PcgContexts:
    """Procedural contexts: four equal legs, drawn anew for every episode.

    Every feature but the preset is a number (``lane_count=2``), a list of equally likely values (``lane_count=[1,2]``),
    or an interval (``green_s=20..32``); null keeps what the preset says.

    Attributes:
        name: the source.
        preset: ``systematicity_train`` (the protocol's training box), ``systematicity_test`` (its test box) or
            ``easy`` (one fixed context with one lane and light traffic).
        lane_count: lanes per approach, 1 to 4.
        phase_count: 1: straight on only; 2: protected lefts as well.
        inflow_vph_per_lane: peak arrivals per lane, veh/h.
        green_s: through green of legs A and C.
        red_s: through green of legs B and D.
        lane_length_m: length of every leg.
        speed_limit_mps: speed limit.
        offset_s: shift of the neighbours' signals.
        grade: rise over run towards the stop line.
        adoption: share of controlled vehicles, 0 to 1.
        temperature_c: air temperature.
        humidity_pct: relative humidity.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
        approach: the leg that demand enters from, A to D, or ``all``.
    """

    name: Literal["pcg"] = "pcg"
    preset: Literal["systematicity_train", "systematicity_test", "easy"] = "systematicity_train"
    lane_count: Setting = None
    phase_count: Setting = None
    inflow_vph_per_lane: Setting = None
    green_s: Setting = None
    red_s: Setting = None
    lane_length_m: Setting = None
    speed_limit_mps: Setting = None
    offset_s: Setting = None
    grade: Setting = None
    adoption: Setting = None
    temperature_c: Setting = None
    humidity_pct: Setting = None
    engine: Setting = None
    cv_vehicle: Setting = None
    approach: Setting = None

    def __post_init__(self) -> None:
        check_choice("contexts.preset", self.preset, PRESETS)

    def build(self) -> ContextSource:
        """Return the source; raises :class:`IzooError` for settings outside their legal range."""
        base = PRESETS[self.preset].product
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("name", "preset")}
        changes = {name: _setting(name, value) for name, value in named.items() if value is not None}
        together = [key for key in base.features if not isinstance(key, str) and set(key) & set(changes)]
        if together:
            raise IzooError(
                f"contexts.preset={self.preset} draws {' and '.join(together[0])} together; choose another preset to set them."
            )
        return ProceduralSource({**base.features, **changes}, base.exclude)


@dataclass(frozen=True)
class DatasetContexts:
    """The published dataset of measured intersections, downloaded by the user.

    Attributes:
        name: the source.
        path: a folder of intersection folders, or one intersection folder with ``net.net.xml`` and ``inflows.txt``.
        approaches: ``one``: a context per incoming approach, fed from it alone; ``all``: one per intersection.
        adoption: share of controlled vehicles, 0 to 1.
        hour: ``peak`` or ``off-peak``.
        engine: of controlled vehicles, ``combustion`` or ``electric``.
        cv_vehicle: ``paper`` or ``human`` parameters of uncommanded controlled vehicles.
    """

    name: Literal["dataset"] = "dataset"
    path: str | None = None
    approaches: Literal["one", "all"] = "one"
    adoption: float = 1.0 / 3.0
    hour: Literal["peak", "off-peak"] = "peak"
    engine: Literal["combustion", "electric"] = "combustion"
    cv_vehicle: Literal["paper", "human"] = "paper"

    def __post_init__(self) -> None:
        check_range("contexts.adoption", self.adoption, 0.0, 1.0)
        check_choice("contexts.hour", self.hour, HOURS)
        check_choice("contexts.engine", self.engine, ENGINES)
        check_choice("contexts.cv_vehicle", self.cv_vehicle, CV_VEHICLES)
        if self.path is not None:
            # Absolute, so that a run can be resumed and evaluated from another folder.
            object.__setattr__(self, "path", str(Path(self.path).expanduser().absolute()))

    def build(self) -> ContextSource:
        """Read the folders and return their contexts; raises :class:`IzooError` naming the file that cannot be used."""
        from izoo.networks.dataset import load_dataset

        if self.path is None:
            raise IzooError("contexts=dataset needs the dataset's folder: contexts.path=DIR.")
        return load_dataset(
            self.path,
            approaches=self.approaches,
            adoption=self.adoption,
            hour=self.hour,
            engine=self.engine,
            cv_vehicle=self.cv_vehicle,
        )


ContextsConfig = Union[PcgContexts, DatasetContexts]


def _setting(name: str, value: Any) -> Any:
    """Read ``low..high`` as an interval; whole numbers become integers, as counts need."""
    if isinstance(value, list):
        return [_setting(name, item) for item in value]
    if isinstance(value, str) and ".." in value:
        try:
            low, high = (float(end) for end in value.split(".."))
        except ValueError:
            raise IzooError(f"contexts.{name} is {value!r}; an interval is written low..high, like 20..32.") from None
        return Uniform(low, high)
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value
