"""Distributions over context features: lists, weighted or not, and intervals; their product; and boxes cut out of it.

Randomness is always a :class:`numpy.random.Generator` that the caller passes in. Finite products enumerate in a stable
order (the last feature varies fastest) and have a length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from izoo.errors import IzooError, unknown_choice

Key: TypeAlias = str | tuple[str, ...]
"""A feature name, or several names whose values are drawn together as one tuple."""

MAX_REJECTIONS = 100_000
MAX_ENUMERATION = 10_000_000
PROBABILITY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Choice:
    """One of ``values``: each equally likely, or with ``probabilities``, which sum to 1."""

    values: tuple[Any, ...]
    probabilities: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(self.values))
        object.__setattr__(self, "probabilities", tuple(float(p) for p in self.probabilities))
        if not self.values:
            raise IzooError("a list of feature values is empty; give at least one value.")
        if self.probabilities and len(self.values) != len(self.probabilities):
            counts = f"{len(self.values)} values have {len(self.probabilities)} probabilities"
            raise IzooError(f"{counts}; give one probability per value.")
        if not all(0.0 <= p <= 1.0 for p in self.probabilities):
            raise IzooError(f"probabilities are {list(self.probabilities)}; each must lie in [0, 1].")
        total = math.fsum(self.probabilities)
        if self.probabilities and abs(total - 1.0) > PROBABILITY_TOLERANCE:
            raise IzooError(f"probabilities sum to {total:g}; they must sum to 1 (within {PROBABILITY_TOLERANCE:g}).")

    @property
    def support(self) -> tuple[Any, ...]:
        """The values whose probability is not 0, in the order given."""
        chances = self.probabilities or (1.0,) * len(self.values)
        return tuple(value for value, p in zip(self.values, chances, strict=True) if p > 0.0)

    def sample(self, generator: np.random.Generator) -> Any:
        """Draw one value."""
        if not self.probabilities:
            return self.values[int(generator.integers(len(self.values)))]
        edges = np.cumsum(self.probabilities)
        index = int(np.searchsorted(edges, generator.random() * edges[-1], side="right"))
        return self.values[min(index, len(self.values) - 1)]


@dataclass(frozen=True)
class Uniform:
    """Uniform over the interval from ``low`` to ``high``."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise IzooError(f"the range [{self.low}, {self.high}] is not finite; both ends must be numbers.")
        if self.low > self.high:
            raise IzooError(f"the range [{self.low:g}, {self.high:g}] is upside down; its low end must come first.")

    @property
    def support(self) -> None:
        """``None``: the values cannot be enumerated."""
        return None

    def sample(self, generator: np.random.Generator) -> float:
        """Draw one number."""
        return self.low + (self.high - self.low) * float(generator.random())


Distribution: TypeAlias = Choice | Uniform


def as_distribution(value: Any) -> Distribution:
    """Read a feature's setting: a distribution as it is, a list or a single value as a :class:`Choice`."""
    if isinstance(value, Distribution):
        return value
    return Choice(tuple(value) if isinstance(value, list) else (value,))


@dataclass(frozen=True)
class Box:
    """A closed box: per feature the interval ``(low, high)``, the list of values, or the single one, that lies inside.

    Features that are not named are unrestricted.
    """

    sides: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not self.sides:
            raise IzooError("an exclusion box without any feature would exclude everything; name at least one feature.")
        for name, side in self.sides.items():
            if isinstance(side, tuple) and (len(side) != 2 or not side[0] <= side[1]):
                raise IzooError(f"the side of the box along {name!r} is {side!r}; it must be (low, high), low first.")

    def contains(self, point: Mapping[str, Any]) -> bool:
        """Say whether ``point`` lies inside, ends included."""
        return all(_inside(point[name], side) for name, side in self.sides.items())


def _inside(value: Any, side: Any) -> bool:
    if isinstance(side, tuple):
        return bool(side[0] <= value <= side[1])
    return value in side if isinstance(side, list) else bool(value == side)


@dataclass(frozen=True)
class Product:
    """Independent features, minus boxes; features under one tuple key are drawn together.

    Args:
        features: per feature name (or tuple of names) a distribution, a list, or a fixed value.
        exclude: boxes that no drawn or enumerated point lies in; the rest keeps its relative probabilities.
    """

    features: Mapping[Key, Any]
    exclude: tuple[Box, ...] = ()
    _kept: np.ndarray | None = field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self) -> None:
        features = {key: as_distribution(value) for key, value in self.features.items()}
        object.__setattr__(self, "features", features)
        object.__setattr__(self, "exclude", tuple(self.exclude))
        names = self.names
        if len(set(names)) != len(names):
            raise IzooError(f"features {list(names)} name one feature twice; give each feature one distribution.")
        for key, distribution in features.items():
            _check_tuples(key, distribution)
        for box in self.exclude:
            for name, side in box.sides.items():
                if name not in names:
                    raise unknown_choice("feature of an exclusion box", name, names)
                drawn = features.get(name)
                if isinstance(drawn, Uniform) and drawn.low < drawn.high and not isinstance(side, tuple):
                    raise IzooError(
                        f"excluding {side!r} along {name!r} means nothing, since {name} is drawn from an interval, "
                        "which hits no single value; give (low, high), as an option low..high."
                    )
        if self.exclude and self.is_finite:
            object.__setattr__(self, "_kept", self._kept_indices())
        elif self.exclude:
            self.sample(np.random.default_rng(0))  # raises where nothing can be drawn

    @property
    def names(self) -> tuple[str, ...]:
        """All feature names, in order."""
        keys = ((key,) if isinstance(key, str) else key for key in self.features)
        return tuple(itertools.chain.from_iterable(keys))

    @property
    def is_finite(self) -> bool:
        """Whether every feature has finitely many values."""
        return all(distribution.support is not None for distribution in self.features.values())

    def sample(self, generator: np.random.Generator) -> dict[str, Any]:
        """Draw one point, outside every box."""
        for _ in range(MAX_REJECTIONS):
            point = _flatten({key: distribution.sample(generator) for key, distribution in self.features.items()})
            if not any(box.contains(point) for box in self.exclude):
                return point
        raise self._nothing_left()

    def _nothing_left(self) -> IzooError:
        sides = [dict(box.sides) for box in self.exclude]
        return IzooError(f"the exclusion {sides} leaves nothing, or too little to draw from; shrink a box.")

    def __len__(self) -> int:
        if not self.is_finite:
            names = [key for key, distribution in self.features.items() if distribution.support is None]
            raise IzooError(f"features {names} are intervals, so the product has no length; give lists instead.")
        return math.prod(self._shape()) if self._kept is None else len(self._kept)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is outside a product of {len(self)} points.")
        index %= len(self)
        return self._point(index if self._kept is None else int(self._kept[index]))

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[index] for index in range(len(self)))

    def interval_ends(self) -> Product:
        """Return the finite product in which each interval is replaced by its two ends."""
        ends = {
            key: Choice((value.low, value.high)) if isinstance(value, Uniform) else value
            for key, value in self.features.items()
        }
        return Product(ends, self.exclude)

    def _shape(self) -> tuple[int, ...]:
        return tuple(len(distribution.support) for distribution in self.features.values())

    def _point(self, flat: int) -> dict[str, Any]:
        digits = np.unravel_index(flat, self._shape())
        drawn = zip(self.features.items(), digits, strict=True)
        return _flatten({key: distribution.support[digit] for (key, distribution), digit in drawn})

    def _kept_indices(self) -> np.ndarray:
        count = math.prod(self._shape())
        if count > MAX_ENUMERATION:
            raise IzooError(f"a finite product with exclusions has {count} points; at most {MAX_ENUMERATION} work.")
        kept = [index for index in range(count) if not any(box.contains(self._point(index)) for box in self.exclude)]
        if not kept:
            raise self._nothing_left()
        return np.asarray(kept, dtype=np.int64)


def _flatten(values: Mapping[Key, Any]) -> dict[str, Any]:
    point: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(key, str):
            point[key] = value
        else:
            point.update(zip(key, value, strict=True))
    return point


def _check_tuples(key: Key, distribution: Distribution) -> None:
    if isinstance(key, str):
        return
    for value in distribution.support or (None,):
        if not isinstance(value, tuple) or len(value) != len(key):
            raise IzooError(f"{value!r} is not a value for {key!r}; features drawn together need tuples of {len(key)}.")
