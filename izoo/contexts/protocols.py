"""The context sets of the paper's protocols: what to train on, select on and test on."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from izoo.contexts.catalogue import Scenarios
from izoo.contexts.cities.rebuilt import city_name
from izoo.contexts.cities.weather import WEATHER_PUBLISHED
from izoo.contexts.procedural import SYSTEMATICITY_TEST, SYSTEMATICITY_TEST_SAMPLE, SYSTEMATICITY_TRAIN
from izoo.contexts.source import ContextList, ContextSource
from izoo.contexts.splits import PAPER_PAIR
from izoo.errors import check_choice

COMMON: dict[str, Any] = {
    "season": "summer",
    "hour": "peak",
    "engine": "combustion",
    "adoption": 1.0 / 3.0,
    "approaches": "one",
}
"""Settings that the city protocols share."""
SAMPLE_SEED, SAMPLE_SIZE = 241015221, 128
"""Published constants of the drawn procedural sets; never to change."""
FORMS = ("split", "paper")


@dataclass(frozen=True)
class ContextSets:
    """What a protocol trains on, selects on and tests on; ``validation`` and ``test`` are finite and ordered."""

    name: str
    train: ContextSource
    validation: ContextList | Scenarios
    test: ContextList | Scenarios


def in_distribution(
    city: str = PAPER_PAIR[0],
    form: Literal["split", "paper"] = "split",
    weather: Literal["county", "published"] | None = None,
) -> ContextSets:
    """Train and test in one city.

    Args:
        city: one of the ten.
        form: ``split`` by intersection, 80/10/10, or ``paper``: everything in every role.
        weather: ``published`` or ``county``; ``None`` takes the published values where the city has them.
    """
    return productivity(city, city, form, weather)


def productivity(
    train: str = PAPER_PAIR[0],
    test: str = PAPER_PAIR[1],
    form: Literal["split", "paper"] = "split",
    weather: Literal["county", "published"] | None = None,
) -> ContextSets:
    """Train in one city and test, zero-shot, in another; arguments as for :func:`in_distribution`."""
    check_choice("form", form, FORMS)
    train, test = city_name(train), city_name(test)
    return ContextSets(
        name=f"{train} -> {test}",
        train=_city(train, "train" if form == "split" else "all", weather),
        validation=_city(train, "validation" if form == "split" else "all", weather),
        test=_city(test, "test" if form == "split" else "all", weather),
    )


def systematicity(test: Literal["grid", "sample"] = "grid") -> ContextSets:
    """Train on wide procedural ranges and test inside a box that training excludes.

    Args:
        test: ``grid``: the 128 contexts at the ends of the test intervals, as published; ``sample``: 128 drawn ones.
    """
    check_choice("test", test, ("grid", "sample"))
    return ContextSets(
        name=f"systematicity ({test})",
        train=SYSTEMATICITY_TRAIN,
        validation=_drawn("validation"),
        test=SYSTEMATICITY_TEST if test == "grid" else _drawn("test"),
    )


def _city(city: str, split: Any, weather: Any) -> Scenarios:
    if weather is None:
        weather = "published" if city in WEATHER_PUBLISHED else "county"
    return Scenarios(city=city, split=split, weather=weather, **COMMON)


@functools.cache
def _drawn(role: str) -> ContextList:
    """Draw the fixed procedural sets: validation from the training ranges, test from the test box."""
    source = {"validation": SYSTEMATICITY_TRAIN, "test": SYSTEMATICITY_TEST_SAMPLE}[role]
    generator = np.random.default_rng([SAMPLE_SEED, ("validation", "test").index(role)])
    return ContextList([source.sample(generator) for _ in range(SAMPLE_SIZE)])
