"""Memory of the twin's arrays: in one block, whole lines of the processor's cache; and working memory that is shared.

What a step only writes down for itself is a large part of what it touches. Environments that one thread steps one after
the other write it to the same place, a *desk*, which then stays in the cache.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from izoo.envs.tables import LINE_BYTES, TablesType

Shapes = Mapping[str, int | tuple[int, ...]]


def zeros(kind: TablesType, shapes: Shapes) -> dict[str, np.ndarray]:
    """Return arrays of zeros for fields of ``kind``, by name, in one block of memory of their own."""
    return _truncate(np.zeros(_size(kind, shapes), np.uint8), kind, shapes)


def memory_of(first: np.ndarray) -> np.ndarray:
    """Return the memory of all arrays that a call of :func:`zeros` gave, uint8, by the first of them."""
    block: np.ndarray = first.base  # type: ignore[assignment]
    begin = -block.ctypes.data % LINE_BYTES
    return block[begin : begin + len(block) - LINE_BYTES]


class Desk:
    """Working memory of a thread, for any number of environments, one at a time."""

    def __init__(self) -> None:
        self._blocks: dict[TablesType, np.ndarray] = {}

    def spread(self, kind: TablesType, shapes: Shapes) -> dict[str, np.ndarray]:
        """Return arrays for fields of ``kind``, by name. Others have been given the same memory, and will be."""
        size = _size(kind, shapes)
        if kind not in self._blocks or size > len(self._blocks[kind]):
            self._blocks[kind] = np.zeros(size + size // 4, np.uint8)  # what was given away stays where it is
        return _truncate(self._blocks[kind], kind, shapes)


def _size(kind: TablesType, shapes: Shapes) -> int:
    return LINE_BYTES + sum(_lines(kind.dtypes[name].itemsize * _count(shape)) for name, shape in shapes.items())


def _truncate(block: np.ndarray, kind: TablesType, shapes: Shapes) -> dict[str, np.ndarray]:
    """Cut a block into arrays, each of which begins with a line of the cache."""
    arrays, at = {}, -block.ctypes.data % LINE_BYTES
    for name, shape in shapes.items():
        arrays[name] = np.ndarray(shape, kind.dtypes[name], block, at)  # type: ignore[call-overload]
        at += _lines(arrays[name].nbytes)
    return arrays


def _lines(size: int) -> int:
    """Return a size in bytes, rounded up to whole lines."""
    return -(-size // LINE_BYTES) * LINE_BYTES


def _count(shape: int | tuple[int, ...]) -> int:
    return shape if isinstance(shape, int) else math.prod(shape)
