"""Human drivers: IDM parameters drawn per driver from a calibrated log-normal population.

The built-in population is ``idm_population.json``, whose ``source`` entry names its origin. v0 is drawn with the
others, but the speed limit is used instead.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from izoo.contexts.population import IDM_PARAMETERS, DriverPopulation, read_population
from izoo.emissions.classes import LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS

HEAVY_TYPES = (LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS)


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
) -> np.ndarray:
    """Draw one driver per vehicle; return minimal gaps, headways, accelerations and decelerations, ``[4, N]``.

    Driver ``k`` depends on the generator's state, on ``k`` and on vehicle ``k``'s type alone.

    Args:
        generator: source of randomness.
        source_type: ``[N]``; 32 and 42 have heavy drivers, the others light ones.
        population: what they are drawn from; ``None``: the built-in one.
    """
    mean, factor = mean_and_factor(built_in_population() if population is None else population)
    row = np.isin(source_type, HEAVY_TYPES).astype(np.int64)
    normal = generator.standard_normal((len(source_type), len(IDM_PARAMETERS)))
    return np.exp(mean[row] + np.einsum("nij,nj->ni", factor[row], normal)).T[1:]
