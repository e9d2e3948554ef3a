"""Choices of ``contexts=``: which set of context-MDPs episodes are drawn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from izoo.conf.built_in import CatalogueContexts, CityContexts
from izoo.conf.folders import DatasetContexts, OsmContexts
from izoo.conf.own_traffic import SourceConfig
from izoo.contexts.distributions import Box, Choice, Key, Uniform, as_distribution
from izoo.contexts.procedural import (
    DEFAULTS,
    EASY,
    NAMED_VALUES,
    SYSTEMATICITY_TEST_SAMPLE,
    SYSTEMATICITY_TRAIN,
    ProceduralSource,
    check_support,
)
from izoo.contexts.source import ContextList, ContextSource, MixedSource
from izoo.errors import IzooError, check_choice
from izoo.imports import imported
from izoo.options import CheckedOptions

PRESETS = {
    "systematicity_train": SYSTEMATICITY_TRAIN,
    "systematicity_test": SYSTEMATICITY_TEST_SAMPLE,
    "systematicity_grid": SYSTEMATICITY_TEST_SAMPLE,
    "easy": EASY,
}
Setting: TypeAlias = float | str | list[Any] | dict | None
"""Of a procedural feature: a number or a name, a list of equally likely ones, ``low..high`` for an interval, a mapping
from value to probability, or null for the preset's."""


@dataclass(frozen=True)
class PcgContexts(SourceConfig):
    """Procedural contexts: four equal legs, drawn anew for every episode.

    Every feature is a number (``lane_count=2``), a list of equally likely values (``lane_count=[1,2]``), values with
    their probabilities (``lane_count={1:0.25,2:0.75}``), or an interval (``green_s=20..32``); null keeps what the
    preset says.

    Attributes:
        preset: ``systematicity_train`` (the protocol's training box), ``systematicity_test`` (its test box),
            ``systematicity_grid`` (the 128 contexts at the ends of the test box's intervals) or ``easy`` (one fixed
            context with one lane and light traffic).
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
        exclude: boxes that no context lies in, each with one or more features, of which it holds a value, some values
            or an interval: ``[{lane_count:[2,3],green_s:26..29},{inflow_vph_per_lane:400..500}]``; null keeps the
            preset's, ``[]`` lifts them.
    """

    name: Literal["pcg"] = "pcg"
    preset: Literal["systematicity_train", "systematicity_test", "systematicity_grid", "easy"] = "systematicity_train"
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
    exclude: list[dict] | None = None

    def source(self) -> ContextSource:
        """Return the source; raises :class:`IzooError` for settings outside their legal range."""
        base = PRESETS[self.preset].product
        changes: dict[Key, Any] = {
            name: _setting(name, getattr(self, name)) for name in DEFAULTS if getattr(self, name) is not None
        }
        together = [key for key in base.features if not isinstance(key, str) and set(key) & set(changes)]
        if together:
            raise IzooError(
                f"contexts.preset={self.preset} draws {' and '.join(together[0])} together; "
                "choose another preset to set them."
            )
        boxes = base.exclude if self.exclude is None else tuple(_box(sides) for sides in self.exclude)
        fixed = {name: DEFAULTS[name] for box in boxes for name in box.sides if name in DEFAULTS}
        known = {name for key in base.features for name in ([key] if isinstance(key, str) else key)}
        missing: dict[Key, Any] = {name: value for name, value in fixed.items() if name not in known}
        features: dict[Key, Any] = {**missing, **base.features, **changes}
        source = ProceduralSource(features, boxes)
        return source.interval_ends() if self.preset == "systematicity_grid" else source


SingleContextsConfig: TypeAlias = PcgContexts | CityContexts | CatalogueContexts | DatasetContexts | OsmContexts


@dataclass(frozen=True)
class MixedContexts(CheckedOptions):
    """Several sets of contexts at once: every episode draws the set first, each as likely, then a context of it.

    Attributes:
        name: the source.
        sources: two or more of the other choices, each with options of its own:
            ``[{name:dataset,path:DIR,split:train},{name:city,city:atlanta,split:train}]``.
    """

    name: Literal["mixed"] = "mixed"
    sources: list[SingleContextsConfig] = field(default_factory=list)
    group = "contexts"

    def build(self) -> ContextSource:
        """Return the mixture; raises :class:`IzooError` where there are too few sources, or one cannot be built."""
        if len(self.sources) < 2:
            raise IzooError(
                f"contexts.sources has {len(self.sources)} entries; contexts=mixed needs two or more, like "
                "[{name:dataset,path:DIR,split:train},{name:city,city:atlanta,split:train}]."
            )
        return MixedSource([source.build() for source in self.sources])


@dataclass(frozen=True)
class OwnContexts:
    """A source of one's own.

    Attributes:
        name: ``module:name``: contexts, or a source, or a class or function without arguments that makes one.
    """

    name: str = ""

    def build(self) -> ContextSource:
        """Return the source; raises :class:`IzooError` where it is none."""
        found = imported("contexts", self.name)
        found = found() if callable(found) and not hasattr(found, "__len__") else found
        if not isinstance(found, ContextSource):
            if not isinstance(found, Sequence):
                raise IzooError(
                    f"contexts={self.name} is a {type(found).__name__}; give something with sample(generator)."
                )
            found = ContextList(found)
        return found


ContextsConfig: TypeAlias = SingleContextsConfig | MixedContexts | OwnContexts


def _setting(name: str, value: Any) -> Any:
    """Read ``low..high`` as an interval and a mapping as weights; whole numbers become integers, as counts need."""
    if isinstance(value, list):
        return [_setting(name, item) for item in value]
    try:
        if isinstance(value, Mapping):
            return Choice(tuple(map(_number, value)), tuple(value.values()))
        if isinstance(value, str) and ".." in value:
            return Uniform(*map(float, value.split("..")))
    except (TypeError, ValueError) as error:
        remedy = (
            "Write an interval as low..high, like 20..32, and weights as {value:probability}, like {1:0.25,2:0.75}."
        )
        raise IzooError(f"contexts.{name}: {str(error).rstrip('.')}. {remedy}") from error
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _number(value: Any) -> Any:
    """Keys of a mapping are texts once they have been saved."""
    try:
        number = float(value)
    except ValueError:
        return value
    return int(number) if number.is_integer() else number


def _box(sides: Mapping[str, Any]) -> Box:
    for name in sides:
        check_choice("feature of contexts.exclude", name, DEFAULTS)
    return Box({name: _side(name, side) for name, side in sides.items()})


def _side(name: str, side: Any) -> Any:
    """Read a side of a box: a value, a list of values, or an interval as ``(low, high)``."""
    value = _setting(f"exclude: {name}", side)
    if isinstance(value, Choice) or (isinstance(value, Uniform) and name in NAMED_VALUES):
        raise IzooError(f"contexts.exclude: {name} is {side!r}; give a value or a list of values.")
    if isinstance(value, Uniform):
        return value.low, value.high
    try:
        check_support(name, as_distribution(value))
    except IzooError as error:
        raise IzooError(f"contexts.exclude: {error}") from error
    return value
