"""A population of human drivers: the log-normal distribution that every driver's IDM parameters are drawn from.

A context holds the numbers themselves, not the file that they came from. So it is the same context on any machine, and
another one as soon as a number changes. :mod:`izoo.traffic.drivers` draws from a population.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from izoo.errors import IzooError
from izoo.files import read_text

DRIVER_CLASSES = ("light", "heavy")
IDM_PARAMETERS = ("v0_mps", "s0_m", "T_s", "alpha_mps2", "beta_mps2")
"""Desired speed, standstill gap, time headway, maximal acceleration, comfortable deceleration: the order everywhere."""
LEGAL_MEDIANS = ((1.0, 70.0), (0.1, 20.0), (0.1, 10.0), (0.05, 10.0), (0.05, 20.0))
"""Per parameter: outside, a median is a wrong unit rather than a driver."""
MAX_LOG_SD = 2.0
"""A driver in twenty would lie more than fifty times above or below the median."""
MAX_FILE_BYTES = 10_000_000

Row = tuple[float, ...]


@dataclass(frozen=True)
class DriverPopulation:
    """Mean and covariance of the log of the five IDM parameters, per class of drivers.

    Attributes:
        log_mean: ``[2][5]``; row 0 light drivers, row 1 heavy ones, columns as in :data:`IDM_PARAMETERS`.
        log_cov: ``[2][5][5]``; symmetric and positive definite.
    """

    log_mean: tuple[Row, ...]
    log_cov: tuple[tuple[Row, ...], ...]

    def __post_init__(self) -> None:
        size = len(IDM_PARAMETERS)
        for name, shape in (("log_mean", (2, size)), ("log_cov", (2, size, size))):
            try:
                values = np.array(getattr(self, name), np.float64)
            except (TypeError, ValueError, OverflowError):
                values = np.zeros(0)
            if values.shape != shape:
                raise IzooError(
                    f"a population of drivers needs numbers in {name}, {' x '.join(map(str, shape[1:]))} for each of "
                    f"{' and '.join(DRIVER_CLASSES)}."
                )
            # Lists come from JSON; equal populations must hash alike whatever they were made from.
            object.__setattr__(self, name, _tuples(values.tolist()))
        for name, mean, matrix in zip(DRIVER_CLASSES, np.array(self.log_mean), np.array(self.log_cov), strict=True):
            _check(name, mean, matrix)

    @property
    def content_hash(self) -> str:
        """SHA-256 over the numbers."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def read_population(path: str | Path) -> DriverPopulation:
    """Read a population from JSON: ``{"classes": {"light": {"log_mean": [5], "log_cov": [5][5]}, "heavy": ...}}``.

    Other entries, such as those about a calibration, are not read, but for ``"converged": false``: such a file is
    refused.

    Raises:
        IzooError: the file cannot be read, or holds no population.
    """
    path = Path(path)
    try:
        content = json.loads(read_text(path, MAX_FILE_BYTES))
        classes = [content["classes"][name] for name in DRIVER_CLASSES]
        means, covariances = (tuple(entry[key] for entry in classes) for key in ("log_mean", "log_cov"))
        converged = content.get("converged", True)
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"it holds no drivers ({error!r})"
        raise IzooError(
            f"cannot read the drivers {path}: {reason}; give a file that `python -m izoo.drivers calibrate` wrote."
        ) from None
    if converged is not True:
        raise IzooError(f"the calibration that wrote {path} did not converge; calibrate again with more draws.")
    try:
        return DriverPopulation(means, covariances)
    except IzooError as error:
        raise IzooError(f"{path}: {error}") from None


def _tuples(values: Any) -> Any:
    return tuple(map(_tuples, values)) if isinstance(values, list) else values


def _check(name: str, mean: np.ndarray, matrix: np.ndarray) -> None:
    """Raise :class:`IzooError` unless the numbers are a log-normal distribution of drivers."""
    if not (np.isfinite(mean).all() and np.isfinite(matrix).all()):
        raise IzooError(f"{name} drivers have a number that is not finite.")
    for parameter, value, (low, high) in zip(IDM_PARAMETERS, mean, LEGAL_MEDIANS, strict=True):
        if not np.log(low) <= value <= np.log(high):
            raise IzooError(
                f"the median {parameter} of {name} drivers is exp({value:g}); it must lie in [{low:g}, {high:g}]. "
                "log_mean holds natural logarithms."
            )
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12):
        raise IzooError(f"log_cov of {name} drivers is not symmetric.")
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise IzooError(f"log_cov of {name} drivers is not positive definite.")
    if np.sqrt(np.diag(matrix)).max() > MAX_LOG_SD:
        raise IzooError(f"log_cov of {name} drivers has a standard deviation above {MAX_LOG_SD:g}.")
