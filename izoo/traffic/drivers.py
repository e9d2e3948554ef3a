"""How people drive: IDM parameters drawn per driver from a calibrated log-normal population.

``idm_population.json`` holds the mean and covariance of the log of (v0, s0, T, alpha, beta), per vehicle class; its
``source`` entry says where the numbers come from. v0 is drawn with the others but not used: the speed limit rules.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from izoo.emissions.classes import LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS

HEAVY_TYPES = (LIGHT_COMMERCIAL_TRUCK, TRANSIT_BUS)
PARAMETERS = 5


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
def population() -> tuple[np.ndarray, np.ndarray]:
    """Return the mean ``[2, 5]`` and Cholesky factor ``[2, 5, 5]`` of the logs, of light (row 0) and heavy drivers."""
    classes = json.loads((Path(__file__).parent / "idm_population.json").read_text(encoding="utf-8"))["classes"]
    mean = np.array([classes[name]["log_mean"] for name in ("light", "heavy")])
    covariance = np.array([classes[name]["log_cov"] for name in ("light", "heavy")])
    return mean, np.linalg.cholesky(covariance)


def sample_drivers(generator: np.random.Generator, source_type: np.ndarray) -> Drivers:
    """Draw one driver per vehicle.

    Driver ``k`` depends on the generator's state, on ``k`` and on vehicle ``k``'s type alone.

    Args:
        generator: source of randomness.
        source_type: ``[N]``; 32 and 42 have heavy drivers, the others light ones.
    """
    mean, factor = population()
    row = np.isin(source_type, HEAVY_TYPES).astype(np.int64)
    normal = generator.standard_normal((len(source_type), PARAMETERS))
    _, min_gap, tau, accel, decel = np.exp(mean[row] + np.einsum("nij,nj->ni", factor[row], normal)).T
    return Drivers(min_gap, tau, accel, decel)
