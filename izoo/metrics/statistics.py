"""Aggregates with their uncertainty: every number comes with the n it rests on, and an interval only where one holds.

Scores are ``[S, M]``: training seeds (1 where nothing was trained) by approaches. A figure is computed for every
training seed, which is one policy on all approaches, and averaged over them. Two things could have been others: the
intersections, whose approaches are not independent, and the training seeds. Each adds a variance to the figure, both
are estimated from whole intersections and whole seeds, and the interval is Student's with Satterthwaite's degrees of
freedom (Biometrics Bulletin 2, 1946). Percentiles of a bootstrap are not used: with six intersections those of a
nominal 95 % cover some 80 %, with four training seeds less. ``tests/metrics/test_coverage.py`` simulates all of them.

Interquartile mean, probability of improvement and performance profile are those of Agarwal et al., "Deep Reinforcement
Learning at the Edge of the Statistical Precipice" (NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from izoo.errors import IzooError
from izoo.metrics.student import student_t_below, student_t_quantile

Array = NDArray[np.float64]
Statistic = Callable[[Array], Array]
"""Reduces the approaches: ``[*R, M] -> [*R]``, or ``[*R, M, K] -> [*R]``."""

CONFIDENCE = 0.95
MIN_INTERSECTIONS, MIN_TRAIN_SEEDS, MIN_EVAL_SEEDS = 6, 4, 3
"""With fewer, no interval is given: over intersections, over training seeds, over the episode seeds of an approach."""
PLACES, PLACES_AND_SEEDS = "intersections", "intersections and training seeds"
"""What an interval is over: other intersections for the same weights, or other training seeds as well."""


@dataclass(frozen=True)
class Estimate:
    """A number, its interval and what it rests on.

    Attributes:
        value: the figure; NaN when ``n`` is 0.
        low, high: ends of the interval; NaN where there is none.
        n: number of approaches (or of episode seeds).
        groups: number of intersections that they lie on.
        seeds: number of training seeds.
        over: what could have been others (:data:`PLACES`, :data:`PLACES_AND_SEEDS`); empty where there is no interval.
        missing: in words, what the interval leaves out, or why there is none; empty where nothing is missing.
        confidence: nominal coverage of ``[low, high]``.
    """

    value: float
    low: float
    high: float
    n: int
    groups: int
    seeds: int = 1
    over: str = ""
    missing: str = ""
    confidence: float = CONFIDENCE

    def to_dict(self) -> dict[str, float | int | str | None]:
        """As plain values; NaN becomes ``None``, as JSON has no NaN."""
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(self).items()}


class Part(NamedTuple):
    """A part of a figure's variance, and the degrees of freedom with which it was estimated."""

    variance: float
    degrees: int


def mean(x: Array) -> Array:
    """Mean over the last axis: ``[*R, N] -> [*R]``."""
    return np.asarray(x.mean(axis=-1))


def iqm(x: Array) -> Array:
    """Interquartile mean over the last axis: ``[*R, N] -> [*R]``.

    The mean of what is left when ``floor(N / 4)`` values are cut from each end (scipy's ``trim_mean(x, 0.25)``).
    """
    count = x.shape[-1]
    cut = count // 4
    if cut == 0:
        return mean(x)
    return mean(np.partition(x, (cut, count - cut - 1), axis=-1)[..., cut : count - cut])


def share_positive(x: Array) -> Array:
    """Share of values above 0 over the last axis: ``[*R, N] -> [*R]``."""
    return mean((x > 0).astype(np.float64))


def estimate(scores: ArrayLike, statistic: Statistic, groups: Sequence[object], *, share: bool = False) -> Estimate:
    """Return the mean over training seeds of a statistic over approaches, with its interval.

    Args:
        scores: ``[S, M]``, or ``[S, M, K]``, K numbers of each.
        statistic: of such an array.
        groups: ``[M]`` labels, the intersections of the approaches.
        share: the statistic is a share of approaches, so that 0 and 1 are possible and its interval is Wilson's.
    """
    x = np.asarray(scores, dtype=np.float64)
    if x.ndim not in (2, 3) or x.shape[1] != len(groups):
        raise IzooError(f"scores of shape {x.shape} came with {len(groups)} group labels; give [seeds, approaches].")
    seeds, count = x.shape[:2]
    if count == 0 or seeds == 0:
        return _nothing(seeds)
    members = group_members(groups)
    of_seeds = np.asarray(statistic(x))
    without = [_left_out(x, statistic, left_out) for left_out in members] if len(members) > 1 else []
    parts = [_jackknifed(without)] + ([_of_seeds(of_seeds)] if seeds >= MIN_TRAIN_SEEDS else [])
    return _interval(float(of_seeds.mean()), parts, share, (count, len(members), seeds), 1 < seeds < MIN_TRAIN_SEEDS)


def improvement(x: ArrayLike, y: ArrayLike, groups: Sequence[object]) -> Estimate:
    """Return the probability that a seed of X beats a seed of Y on an approach, ties counting one half.

    The interval is over other intersections and both sides' training seeds.

    Args:
        x: ``[S_x, M]`` scores (higher is better).
        y: ``[S_y, M]``.
        groups: ``[M]`` labels, the intersections of the approaches.
    """
    above = _wins(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    if above.shape[2] != len(groups):
        raise IzooError(f"{len(groups)} group labels were given for {above.shape[2]} approaches; give one for each.")
    counts = above.shape[:2]
    if above.size == 0:
        return _nothing(max(counts))
    members = group_members(groups)
    of_approach = above.mean(axis=(0, 1))[None]
    without = [_left_out(of_approach, mean, left_out) for left_out in members] if len(members) > 1 else []
    parts = [_jackknifed(without)]
    for axis, count in enumerate(counts):
        if count >= MIN_TRAIN_SEEDS:
            parts.append(_of_seeds(above.mean(axis=(1 - axis, 2))))
    few = any(1 < count < MIN_TRAIN_SEEDS for count in counts)
    return _interval(float(above.mean()), parts, True, (above.shape[2], len(members), max(counts)), few)


def paired_saving(policy: ArrayLike, baseline: ArrayLike) -> Estimate:
    """Return ``1 - mean(policy) / mean(baseline)`` with Student's interval over other episode seeds.

    A ratio of means whose numerator and denominator come from the same episodes: its variance is that of the residuals
    ``policy - ratio * baseline`` (Cochran, Sampling Techniques, section 6.3).

    Args:
        policy, baseline: ``[S]``, one value per episode seed, in the same order.
    """
    x, y = np.asarray(policy, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 1:
        raise IzooError(f"paired values have shapes {x.shape} and {y.shape}; both must be [seeds].")
    if x.size == 0 or not y.any():
        return _nothing(1)
    ratio = float(x.mean() / y.mean())
    if x.size < MIN_EVAL_SEEDS:
        return Estimate(1.0 - ratio, math.nan, math.nan, x.size, 1, missing=_too_few(x.size, "episode seed"))
    spread = float(((x - ratio * y) / y.mean()).std(ddof=1)) / math.sqrt(x.size)
    if _is_nothing(spread, ratio):
        missing = f"no interval: the same ratio in each of {x.size} episodes"
        return Estimate(1.0 - ratio, math.nan, math.nan, x.size, 1, missing=missing)
    half = student_t_quantile(0.5 + 0.5 * CONFIDENCE, x.size - 1) * spread
    return Estimate(1.0 - ratio, 1.0 - ratio - half, 1.0 - ratio + half, x.size, 1, over="episode seeds")


def fall_p_value(difference: ArrayLike, groups: Sequence[object]) -> float:
    """One-sided paired test over intersections: the p-value of "the mean difference is not below 0".

    Student's t with the jackknife's variance. Without variance, and so for a single intersection, the sign decides.

    Args:
        difference: ``[M]``, one per approach.
        groups: ``[M]`` labels, the intersections of the approaches.
    """
    x = np.asarray(difference, dtype=np.float64)[None]
    members = group_members(groups)
    part = _jackknifed([_left_out(x, mean, left_out) for left_out in members] if len(members) > 1 else [])
    centre = float(x.mean())
    if not part.variance > 0.0:
        return 0.0 if centre < 0.0 else 1.0
    return student_t_below(centre / math.sqrt(part.variance), part.degrees)


def performance_profile(values: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share of ``values`` (any shape) strictly above each threshold: ``[K] -> [K]``."""
    x = np.asarray(values, dtype=np.float64).reshape(-1)
    if x.size == 0:
        raise IzooError("a performance profile needs at least one value.")
    return np.asarray((x[None] > np.asarray(thresholds, dtype=np.float64)[:, None]).mean(axis=1))


def group_members(groups: Sequence[object]) -> list[NDArray[np.intp]]:
    """Indices of the approaches of each group, groups in order of first appearance."""
    members: dict[object, list[int]] = {}
    for k, label in enumerate(groups):
        members.setdefault(label, []).append(k)
    return [np.array(indices, dtype=np.intp) for indices in members.values()]


def _wins(x: Array, y: Array) -> Array:
    """``[S_x, S_y, M]``: 1 where a seed of X beats one of Y on an approach, one half for ties."""
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1]:
        raise IzooError(f"scores have shapes {x.shape} and {y.shape}; both must be [seeds, approaches] over the same.")
    return (x[:, None] > y[None]) + 0.5 * (x[:, None] == y[None])


def _left_out(x: Array, statistic: Statistic, left_out: NDArray[np.intp]) -> float:
    """The figure without the approaches of one intersection, in all training seeds."""
    kept = np.ones(x.shape[1], dtype=bool)
    kept[left_out] = False
    return float(np.mean(statistic(x[:, kept])))


def _jackknifed(without: Sequence[float]) -> Part:
    """Variance from the figures without each of the intersections (the delete-one jackknife)."""
    count = len(without)
    if count < 2:
        return Part(math.nan, 0)
    return Part((count - 1) * float(np.var(without)), count - 1)


def _of_seeds(values: Array) -> Part:
    """Variance of a mean over training seeds. It holds the seeds' interaction with the intersections, as the jackknife
    over those does: counted twice, it makes intervals a little wide rather than narrow."""
    return Part(float(values.var(ddof=1)) / values.size, values.size - 1)


def _interval(
    value: float, parts: Sequence[Part], share: bool, counts: tuple[int, int, int], few_seeds: bool
) -> Estimate:
    """Return the estimate whose variance is the sum of ``parts``, the first of them over intersections.

    Args:
        counts: of approaches, intersections and training seeds.
        few_seeds: there were training seeds, but too few for a part of their own.
    """
    n, groups, seeds = counts
    if groups < MIN_INTERSECTIONS:
        return Estimate(value, math.nan, math.nan, n, groups, seeds, missing=_too_few(groups, "intersection"))
    if not share and _is_nothing(math.sqrt(parts[0].variance), value):
        missing = f"no interval: the same figure without any of its {groups} intersections"
        return Estimate(value, math.nan, math.nan, n, groups, seeds, missing=missing)
    variance = sum(part.variance for part in parts)
    weights = sum(part.variance**2 / part.degrees for part in parts)
    # Satterthwaite's degrees of freedom, rounded down.
    degrees = int(variance**2 / weights + 1e-9) if weights > 0.0 else parts[0].degrees
    t = student_t_quantile(0.5 + 0.5 * CONFIDENCE, max(degrees, 1))
    low, high = _wilson(value, variance, t, n * seeds, groups) if share else _student(value, variance, t)
    over = PLACES if len(parts) == 1 else PLACES_AND_SEEDS
    missing = f"not over training seeds, which needs {MIN_TRAIN_SEEDS}" if few_seeds else ""
    return Estimate(value, low, high, n, groups, seeds, over, missing)


def _is_nothing(spread: float, value: float) -> bool:
    """Whether a spread is 0 but for rounding. Then nothing says how far other intersections would be from the figure,
    as where the gate is closed on every approach: an interval of no width would claim certainty."""
    return spread <= 1e-12 * max(abs(value), 1.0)


def _student(value: float, variance: float, t: float) -> tuple[float, float]:
    half = t * math.sqrt(variance)
    return value - half, value + half


def _wilson(share: float, variance: float, t: float, n: int, groups: int) -> tuple[float, float]:
    """Wilson's interval of a share with the n at which independent observations would have its variance.

    At most ``n``, and the number of intersections where all or none have what is counted.
    """
    inside = share * (1.0 - share)
    effective = float(groups) if inside <= 0.0 else min(inside / variance, n) if variance > 0.0 else float(n)
    centre = share + 0.5 * t**2 / effective
    half = t * math.sqrt(inside / effective + 0.25 * (t / effective) ** 2)
    scale = 1.0 + t**2 / effective
    return max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0)


def _nothing(seeds: int) -> Estimate:
    return Estimate(math.nan, math.nan, math.nan, 0, 0, seeds, missing="nothing to count")


def _too_few(count: int, what: str) -> str:
    least = {"intersection": MIN_INTERSECTIONS, "episode seed": MIN_EVAL_SEEDS}[what]
    return f"no interval: {count} {what}{'' if count == 1 else 's'}, and one needs {least}"
