"""Human drivers: IDM parameters drawn per driver from a calibrated log-normal population.

The built-in population is ``idm_population.json``, whose ``source`` entry names its origin. v0 is drawn with the
others, but the speed limit is used instead.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from izoo.contexts.population import IDM_PARAMETERS, DriverPopulation, read_population
from izoo.emissions.classes import LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS

HEAVY_TYPES = (LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS)


@dataclass(frozen=True)
class Drivers:
    """IDM parameters of ``N`` drivers, each ``[N]`` float64.

    Attributes:
        min_gap_m: standstill gap s0.
        tau_s: time headway T.
        accel_mps2: maximal acceleration alpha.
        decel_mps2: comfortable deceleration beta.
    """

    min_gap_m: np.ndarray
    tau_s: np.ndarray
    accel_mps2: np.ndarray
    decel_mps2: np.ndarray


@functools.lru_cache(maxsize=1)
def built_in_population() -> DriverPopulation:
    """Return the population that ships with izoo."""
    return read_population(Path(__file__).parent / "idm_population.json")


@functools.lru_cache(maxsize=8)
def mean_and_factor(population: DriverPopulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean ``[2, 5]`` and Cholesky factor ``[2, 5, 5]`` of the logs, of light (row 0) and heavy drivers."""
    return np.array(population.log_mean), np.linalg.cholesky(np.array(population.log_cov))


def sample_drivers(
    generator: np.random.Generator, source_type: np.ndarray, population: DriverPopulation | None = None
) -> Drivers:
    """Draw one driver per vehicle.

    Driver ``k`` depends on the generator's state, on ``k`` and on vehicle ``k``'s type alone.

    Args:
        generator: source of randomness.
        source_type: ``[N]``; 32 and 42 have heavy drivers, the others light ones.
        population: what they are drawn from; ``None``: the built-in one.
    """
    mean, factor = mean_and_factor(built_in_population() if population is None else population)
    row = np.isin(source_type, HEAVY_TYPES).astype(np.int64)
    normal = generator.standard_normal((len(source_type), len(IDM_PARAMETERS)))
    _, min_gap, tau, accel, decel = np.exp(mean[row] + np.einsum("nij,nj->ni", factor[row], normal)).T
    return Drivers(min_gap, tau, accel, decel)
