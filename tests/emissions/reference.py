"""Random states and the rates that the package ``neuralmoves`` gives them, of ``rates.npy``."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from izoo.emissions.classes import CLASSES

RATES = Path(__file__).with_name("rates.npy")
STATES_PER_CLASS = 200
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
    """Arrays ``[99, 200]``; ``temperature_c`` and ``humidity_pct`` are ``[99, 1]``."""

    speed_mps: np.ndarray
    accel_mps2: np.ndarray
    grade_pct: np.ndarray
    moves_class: np.ndarray
    temperature_c: np.ndarray
    humidity_pct: np.ndarray
    rate_gps: np.ndarray


def states() -> tuple[np.ndarray, ...]:
    """Return speed, acceleration and grade ``[99, 200]`` and weather ``[99, 1]``; a quarter are standing still."""
    generator = np.random.default_rng(0)
    shape = (len(CLASSES), STATES_PER_CLASS)
    speed = np.maximum(generator.uniform(-10.0, 30.0, shape), 0.0)
    accel = generator.uniform(-4.5, 2.6, shape)
    grade = generator.uniform(-10.0, 10.0, shape)
    temperature = generator.uniform(-10.0, 40.0, (len(CLASSES), 1))
    humidity = generator.uniform(10.0, 100.0, (len(CLASSES), 1))
    return speed, accel, grade, temperature, humidity


@functools.lru_cache(maxsize=1)
def reference() -> Reference:
    """Return the states with their rates."""
    speed, accel, grade, temperature, humidity = (array.astype(np.float32) for array in states())
    classes = np.broadcast_to(np.arange(len(CLASSES))[:, None], speed.shape)
    return Reference(speed, accel, grade, classes, temperature, humidity, np.load(RATES))
