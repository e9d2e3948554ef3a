"""Random states and what neuralmoves' own API says of them."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import neuralmoves
import numpy as np

from izoo.emissions.classes import CLASSES

STATES_PER_CLASS = 1_100
SOURCE_NAMES = {
    11: "Motorcycles",
    21: "Passenger Car",
    31: "Passenger Truck",
    32: "Light Commercial Truck",
    42: "Transit Bus",
}
FUEL_NAMES = {1: "Gasoline", 2: "Diesel"}


@dataclass(frozen=True)
class Reference:
    """Arrays ``[99, 1100]``; ``temperature_c`` and ``humidity_pct`` are ``[99, 1]``."""

    speed_mps: np.ndarray
    accel_mps2: np.ndarray
    grade_pct: np.ndarray
    moves_class: np.ndarray
    temperature_c: np.ndarray
    humidity_pct: np.ndarray
    rate_gps: np.ndarray


@functools.lru_cache(maxsize=1)
def reference() -> Reference:
    """Return 10^5 random states, a quarter of them standing still, with their rates by the package's API."""
    generator = np.random.default_rng(0)
    shape = (len(CLASSES), STATES_PER_CLASS)
    speed = np.maximum(generator.uniform(-10.0, 30.0, shape), 0.0)
    accel = generator.uniform(-4.5, 2.6, shape)
    grade = generator.uniform(-10.0, 10.0, shape)
    temperature = generator.uniform(-10.0, 40.0, (len(CLASSES), 1))
    humidity = generator.uniform(10.0, 100.0, (len(CLASSES), 1))
    rates = [
        neuralmoves.estimate_emissions_timeseries(
            speed[c],
            accel[c],
            grade[c],
            temperature[c, 0],
            humidity[c, 0],
            model_year=year,
            source_type=SOURCE_NAMES[source_type],
            fuel_type=FUEL_NAMES[fuel],
        )
        for c, (year, source_type, fuel) in enumerate(CLASSES)
    ]
    classes = np.broadcast_to(np.arange(len(CLASSES))[:, None], shape)
    arrays = (array.astype(np.float32) for array in (speed, accel, grade))
    return Reference(*arrays, classes, temperature.astype(np.float32), humidity.astype(np.float32), np.array(rates))
