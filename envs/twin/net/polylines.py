"""Distances between the shapes of lanes, and where they cross: of all pairs of a net at once.

A *shape* is a polyline in the plane (m). The pieces of all pairs lie in flat arrays, with a
*cell* for every piece of the one shape and every piece of the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

APART_M = 2.5
"""Two ways that come from one lane, or lead to one, are in conflict up to this distance between them."""
_LEAST_M = 1e-9


class Nearest(NamedTuple):
    """Where a shape is nearest to a point: its distance (m), inf where the shape is a point; the distance (m) along the
    shape to there; its direction there, of length 1."""

    distance_m: float
    along_m: float
    direction: tuple[float, float]


class Crossing(NamedTuple):
    """Where one shape crosses another: the distance (m) along both, and the sine of the angle between them."""

    along_m: float
    along_other_m: float
    sine: float


class Polylines:
    """Shapes as flat tables of their pieces.

    Args:
        shapes: arrays ``[n, 2]`` (m), each of two points or more.

    Attributes:
        length_m: per shape.
    """

    def __init__(self, shapes: Sequence[np.ndarray]) -> None:
        self._points = shapes
        self._count = np.array([len(shape) - 1 for shape in shapes])
        self._first = np.cumsum(self._count) - self._count
        self._begin = np.concatenate([shape[:-1] for shape in shapes])
        self._step = np.concatenate([shape[1:] for shape in shapes]) - self._begin
        self._piece_m = np.hypot(self._step[:, 0], self._step[:, 1])
        steps = iter(np.linalg.norm(self._step, axis=1).tolist())
        self._point_m = [
            list(itertools.accumulate(itertools.islice(steps, count), initial=0.0)) for count in self._count.tolist()
        ]
        self._along_m = np.concatenate([along[:-1] for along in self._point_m])
        self.length_m = [along[-1] for along in self._point_m]

    def crossings(self, pairs: Sequence[tuple[int, int]]) -> dict[tuple[int, int], Crossing]:
        """Return, for each pair ``(one, other)`` that crosses, the last crossing along ``one``."""
        if not pairs:
            return {}
        one, two = np.array(pairs).T
        pair, cell = _spread(self._count[one] * self._count[two])
        i = self._first[one][pair] + cell // self._count[two][pair]
        j = self._first[two][pair] + cell % self._count[two][pair]
        (ux, uy), (wx, wy) = self._step[i].T, self._step[j].T
        sine = ux * wy - uy * wx
        aslant = np.abs(sine) >= _LEAST_M
        to_x, to_y = (self._begin[j] - self._begin[i]).T
        safe = np.where(aslant, sine, 1.0)
        s, t = (to_x * wy - to_y * wx) / safe, (to_x * uy - to_y * ux) / safe
        within = (s >= -1e-9) & (s <= 1.0 + 1e-9) & (t >= -1e-9) & (t <= 1.0 + 1e-9)
        at = np.flatnonzero(aslant & within)
        i, j = i[at], j[at]
        along = self._along_m[i] + s[at] * self._piece_m[i]
        along_other = self._along_m[j] + t[at] * self._piece_m[j]
        sines = np.abs(sine[at]) / (self._piece_m[i] * self._piece_m[j])
        found: dict[tuple[int, int], Crossing] = {}
        for k, *values in zip(pair[at].tolist(), along.tolist(), along_other.tolist(), sines.tolist(), strict=True):
            crossing = Crossing(*values)
            found[pairs[k]] = max(found.get(pairs[k], crossing), crossing)
        return found

    def nearest(self, shapes: Sequence[int], points: np.ndarray) -> list[Nearest]:
        """Return where each of ``shapes`` is nearest to its point of ``points`` ``[n, 2]``."""
        if len(shapes) == 0:
            return []
        query, piece, t, distance, starts = self._cells(np.array(shapes), points)
        least = np.minimum.reduceat(distance, starts)
        at = np.flatnonzero(distance == least[query])[::-1]
        best = np.zeros(len(shapes), np.int64)
        best[query[at]] = at  # of equally near pieces the first
        piece, piece_m = piece[best], self._piece_m[piece[best]]
        along = self._along_m[piece] + t[best] * piece_m
        with np.errstate(invalid="ignore", divide="ignore"):
            direction = self._step[piece] / piece_m[:, None]
        rows = zip(least.tolist(), along.tolist(), direction.tolist(), strict=True)
        return [Nearest(distance_m, along_m, (x, y)) for distance_m, along_m, (x, y) in rows]

    def apart(self, pairs: Sequence[tuple[int, int]]) -> dict[tuple[int, int], float]:
        """Return, for each pair ``(one, other)``, the distance (m) along ``one`` at which it is :data:`APART_M` from
        ``other``; its length if it never is.

        The distance between the two is measured at the points of ``one`` and interpolated linearly.
        """
        if not pairs:
            return {}
        shapes = np.repeat([other for _, other in pairs], [len(self._points[one]) for one, _ in pairs])
        *_, distance, starts = self._cells(shapes, np.concatenate([self._points[one] for one, _ in pairs]))
        distances = iter(np.minimum.reduceat(distance, starts).tolist())
        return {
            (one, other): _apart(self._point_m[one], list(itertools.islice(distances, len(self._points[one]))))
            for one, other in pairs
        }

    def _cells(self, shapes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return, for each piece of each point's shape: number of the point, number of the piece, its share up to where
        it is nearest, its distance (m) there; and the cell with which each point begins."""
        query, cell = _spread(self._count[shapes])
        piece = self._first[shapes][query] + cell
        begin, step, point = self._begin[piece], self._step[piece], points[query]
        # matmul rounds like the product of two vectors, which need not be a sum of products.
        along = np.matmul((point - begin)[:, None, :], step[:, :, None])[:, 0, 0]
        is_long = self._piece_m >= _LEAST_M
        # pow rounds otherwise than a product.
        squares = np.array([piece_m**2 for piece_m in np.where(is_long, self._piece_m, 1.0).tolist()])
        t = np.clip(along / squares[piece], 0.0, 1.0)
        x, y = (begin + t[:, None] * step - point).T
        distance = np.where(is_long[piece], np.hypot(x, y), np.inf)
        return query, piece, t, distance, np.flatnonzero(cell == 0)


def _spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the group and the number within it of each member of groups of these sizes."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)


def _apart(along: Sequence[float], distances: Sequence[float]) -> float:
    for k in range(1, len(along)):
        if distances[k] > APART_M:
            before = distances[k - 1]
            if before >= APART_M:
                return along[k - 1]
            share = (APART_M - before) / (distances[k] - before)
            return along[k - 1] + share * (along[k] - along[k - 1])
    return along[-1]
