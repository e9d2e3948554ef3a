"""The 99 surrogate networks of ``neuralmoves`` in a few packed NumPy arrays."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from izoo.emissions.classes import DATA

INPUTS = 5
HIDDEN = 64
LINE_BYTES = 64
"""Bytes of a line of the processor's cache."""


class KernelWeights(NamedTuple):
    """The networks of all classes, laid out ``[class, in, out]`` so that the innermost loop is contiguous; float32.

    Attributes:
        w1: ``[C, 5, 64]`` first layer; inputs are temperature (C), relative humidity (%), speed (m/s), acceleration
            (m/s^2), grade (%).
        b1: ``[C, 64]``.
        w2: ``[C, 64, 64]`` second layer.
        b2: ``[C, 64]``.
        w3: ``[C, 64]`` last layer, one output.
        b3: ``[C]``.
        floor: ``[C]`` idling rate in g/s, the minimum of a running engine.
    """

    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray
    w3: np.ndarray
    b3: np.ndarray
    floor: np.ndarray


@functools.lru_cache(maxsize=1)
def load_weights() -> KernelWeights:
    """Return the weights of all of :data:`~izoo.emissions.classes.CLASSES`; read once per process, and read-only."""
    with np.load(DATA / "networks.npz", allow_pickle=False) as file:
        weights = KernelWeights(*(_aligned(file[name]) for name in KernelWeights._fields))
    for array in weights:
        array.flags.writeable = False
    return weights


def _aligned(array: np.ndarray) -> np.ndarray:
    """Return a contiguous copy that begins with a line of the processor's cache, so that no vector lies in two."""
    block = np.empty(array.nbytes + LINE_BYTES, np.uint8)
    first = -block.ctypes.data % LINE_BYTES
    copy = block[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy
