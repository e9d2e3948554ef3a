"""Loads the 99 surrogate networks of ``neuralmoves`` into a few packed NumPy arrays."""

from __future__ import annotations

import csv
import functools
from typing import NamedTuple

import numpy as np

from izoo.emissions.classes import CLASSES
from izoo.emissions.tables import moves_file

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
    import torch  # only torch can read the files

    nets = []
    for model_year, source_type, fuel in CLASSES:
        path = moves_file("NN_3", f"NN_model_{model_year}_{source_type}_{fuel}.pt")
        nets.append(torch.load(path, map_location="cpu", weights_only=True))

    def stack(name: str) -> np.ndarray:
        return np.stack([net[name].numpy().astype(np.float32) for net in nets])

    weights = KernelWeights(
        w1=stack("layer1.weight").transpose(0, 2, 1),
        b1=stack("layer1.bias"),
        w2=stack("layer2.weight").transpose(0, 2, 1),
        b2=stack("layer2.bias"),
        w3=stack("layer3.weight")[:, 0],
        b3=stack("layer3.bias")[:, 0],
        floor=_idling_rates(),
    )
    weights = KernelWeights(*(_aligned(array) for array in weights))
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


def _idling_rates() -> np.ndarray:
    """Return the idling rate per class in g/s, ``[C]``."""
    rates: dict[tuple[int, int, int], float] = {}
    with moves_file("idling_emissions.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            key = (int(row["modelYear"]), int(row["sourceTypeID"]), int(row["fuelTypeID"]))
            # neuralmoves uses the first row of a class.
            rates.setdefault(key, float(row["emission_per_second_MOVES"]))
    return np.array([rates[key] for key in CLASSES], dtype=np.float32)
