"""Aggregates with their uncertainty: every number comes with the n it rests on.

Definitions follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS
2021) and their package rliable, which is not a dependency because it brings scipy, arch and seaborn. Intervals are
percentile bootstrap intervals. Randomness is passed in, so the same evaluation twice gives the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from izoo.errors import IzooError

Array = NDArray[np.float64]
Statistic = Callable[[Array], Array]
"""Reduces the observations: ``[*R, N] -> [*R]``, or ``[*R, N, K] -> [*R]``."""

RESAMPLES = 2000
CONFIDENCE = 0.95
_NUMBERS_AT_ONCE = 2_000_000


@dataclass(frozen=True)
class Estimate:
    """A number, its interval and what it rests on.

    Attributes:
        value: the statistic on the data; NaN when ``n`` is 0.
        low, high: ends of the interval; NaN when ``n`` is 0.
        n: number of observations (approaches, or runs times tasks).
        groups: number of independent groups that were resampled.
        confidence: nominal coverage of ``[low, high]``.
    """

    value: float
    low: float
    high: float
    n: int
    groups: int
    confidence: float = CONFIDENCE

    def to_dict(self) -> dict[str, float | int | None]:
        """As plain values; NaN becomes ``None``, as JSON has no NaN."""
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(self).items()}


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


def bootstrap(
    values: ArrayLike,
    statistic: Statistic,
    generator: np.random.Generator,
    groups: Sequence[object] | None = None,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Interval of ``statistic`` over another sample of the same size.

    Args:
        values: ``[N]`` observations, for example one benefit per approach, or ``[N, K]``, K numbers of each.
        statistic: of such an array.
        generator: source of the resampling.
        groups: ``[N]`` labels; observations of one group (the approaches of one intersection) are resampled
            together, because they are not independent. ``None``: each observation is its own group.
    """
    x = np.asarray(values, dtype=np.float64)
    _check(resamples, confidence)
    count = x.shape[0]
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, 0, confidence)
    if groups is not None and len(groups) != count:
        raise IzooError(f"{len(groups)} group labels were given for {count} values; give one label per value.")
    members = _members(range(count) if groups is None else groups)
    draws = np.empty(resamples)
    if len(members) == count:
        for part in _chunks(resamples, x.size):
            draws[part] = statistic(x[generator.integers(count, size=(part.stop - part.start, count))])
    else:
        for r in range(resamples):
            chosen = generator.integers(len(members), size=len(members))
            draws[r] = statistic(x[np.concatenate([members[k] for k in chosen])])
    return _percentiles(float(statistic(x)), draws, count, len(members), confidence)


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Statistic,
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Interval of ``statistic`` over another set of runs on the same tasks (rliable's stratified bootstrap).

    Args:
        scores: ``[runs, tasks]``; runs are resampled within each task, independently of the other tasks.
        statistic: reduces the last axis; it is given all ``runs * tasks`` scores flattened.
    """
    x = np.asarray(scores, dtype=np.float64)
    _check(resamples, confidence)
    if x.ndim != 2:
        raise IzooError(f"scores have shape {x.shape}; a stratified bootstrap needs [runs, tasks].")
    if x.size == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, 0, confidence)
    runs, tasks = x.shape
    draws = np.empty(resamples)
    for part in _chunks(resamples, x.size):
        chosen = generator.integers(runs, size=(part.stop - part.start, runs, tasks))
        draws[part] = statistic(x[chosen, np.arange(tasks)].reshape(len(chosen), -1))
    return _percentiles(float(statistic(x.reshape(-1))), draws, x.size, runs, confidence)


def paired_bootstrap(
    policy: ArrayLike,
    baseline: ArrayLike,
    statistic: Callable[[Array, Array], Array],
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Interval of a comparison over other seeds; a seed's policy and baseline values stay together.

    Args:
        policy, baseline: ``[S]``, one value per seed, in the same order of seeds.
        statistic: reduces the last axis of both: ``([*R, S], [*R, S]) -> [*R]``.
    """
    x, y = np.asarray(policy, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    _check(resamples, confidence)
    if x.shape != y.shape or x.ndim != 1:
        raise IzooError(f"paired values have shapes {x.shape} and {y.shape}; both must be [seeds].")
    if x.size == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, 0, confidence)
    index = generator.integers(x.size, size=(resamples, x.size))
    return _percentiles(float(statistic(x, y)), statistic(x[index], y[index]), x.size, x.size, confidence)


def relative_saving(policy: Array, baseline: Array) -> Array:
    """``1 - mean(policy) / mean(baseline)`` over the last axis: ``([*R, S], [*R, S]) -> [*R]``."""
    return 1.0 - mean(policy) / mean(baseline)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Mean over tasks of the probability that a run of X beats a run of Y; ties count one half.

    Args:
        x: ``[runs_x, tasks]`` scores (higher is better).
        y: ``[runs_y, tasks]``.
    """
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise IzooError(f"scores have shapes {a.shape} and {b.shape}; both must be [runs, tasks] over the same tasks.")
    above = (a[:, None] > b[None]) + 0.5 * (a[:, None] == b[None])
    return float(above.mean())


def improvement_estimate(
    x: ArrayLike,
    y: ArrayLike,
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """:func:`probability_of_improvement` with its interval over other runs (both stratified by task)."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    _check(resamples, confidence)
    value = probability_of_improvement(a, b)
    draws = np.empty(resamples)
    for r in range(resamples):
        pick_a = generator.integers(a.shape[0], size=a.shape)
        pick_b = generator.integers(b.shape[0], size=b.shape)
        draws[r] = probability_of_improvement(np.take_along_axis(a, pick_a, 0), np.take_along_axis(b, pick_b, 0))
    return _percentiles(value, draws, a.size + b.size, a.shape[0] + b.shape[0], confidence)


def performance_profile(values: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share of ``values`` (any shape) strictly above each threshold: ``[K] -> [K]``."""
    x = np.asarray(values, dtype=np.float64).reshape(-1)
    if x.size == 0:
        raise IzooError("a performance profile needs at least one value.")
    return np.asarray((x[None] > np.asarray(thresholds, dtype=np.float64)[:, None]).mean(axis=1))


def _chunks(resamples: int, size: int) -> list[slice]:
    """Parts of the resamples that, at ``size`` numbers each, stay small in memory."""
    step = max(1, _NUMBERS_AT_ONCE // max(size, 1))
    return [slice(start, min(start + step, resamples)) for start in range(0, resamples, step)]


def _members(groups: Sequence[object]) -> list[NDArray[np.intp]]:
    """Indices of the observations of each group, groups in order of first appearance."""
    members: dict[object, list[int]] = {}
    for k, label in enumerate(groups):
        members.setdefault(label, []).append(k)
    return [np.array(indices, dtype=np.intp) for indices in members.values()]


def _check(resamples: int, confidence: float) -> None:
    if resamples < 1 or not 0.0 < confidence < 1.0:
        raise IzooError(
            f"bootstrap with {resamples} resamples at confidence {confidence}; it needs one or more, in (0, 1)."
        )


def _percentiles(value: float, draws: Array, n: int, groups: int, confidence: float) -> Estimate:
    tail = 0.5 * (1.0 - confidence)
    low, high = np.quantile(draws, (tail, 1.0 - tail))
    return Estimate(value, float(low), float(high), n, groups, confidence)
