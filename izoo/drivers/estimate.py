"""From drivers who follow leaders to a population: fit, sample, judge, check, and write what izoo reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin

from izoo.contexts.population import IDM_PARAMETERS
from izoo.drivers.laplace_fit import fit_laplace
from izoo.drivers.mcmc import Draws, SamplerConfig, sample
from izoo.drivers.model import total_noise
from izoo.drivers.predictive import Predictions, predict
from izoo.drivers.recorded_pairs import CLASSES
from izoo.drivers.trajectories import Following
from izoo.traffic.drivers import built_in_population

MAX_R_HAT, MIN_ESS = 1.02, 200.0
MAX_DIVERGING = 0.01
INTERVAL = 0.9
APPLIES_TO = {"light": "light (source types 21, 31)", "heavy": "heavy (source types 32, 42)"}


@dataclass(frozen=True)
class Quantity:
    """One number of the population: what the posterior says of it, and whether the chains agree.

    Attributes:
        name: ``median T_s``, ``spread T_s`` (standard deviation of the log) or ``correlation T_s s0_m``.
        mean, low, high: of the posterior; 90 % lie between ``low`` and ``high``.
        r_hat: potential scale reduction of the halves of the chains; 1 when they agree; NaN where they do not move.
        ess: how many independent draws the chains are worth; NaN likewise.
    """

    name: str
    mean: float
    low: float
    high: float
    r_hat: float
    ess: float

    @property
    def converged(self) -> bool:
        """Whether the chains agree, and are long enough."""
        return bool(self.r_hat <= MAX_R_HAT and self.ess >= MIN_ESS)


@dataclass(frozen=True)
class Estimate:
    """The calibration of one class.

    Attributes:
        data, draws, predictions: what it was made from, and the posterior.
        quantities: of the population.
        driver_r_hat: the worst R-hat of a driver's parameter.
        log_mean, log_cov: ``[5]`` and ``[5, 5]``: posterior means.
    """

    data: Following
    draws: Draws
    predictions: Predictions
    quantities: tuple[Quantity, ...]
    driver_r_hat: float
    log_mean: np.ndarray
    log_cov: np.ndarray

    @property
    def diverging(self) -> int:
        """Draws whose trajectory went wrong."""
        return int(self.draws.diverging.sum())

    @property
    def converged(self) -> bool:
        """Whether the result can be trusted as a description of the posterior."""
        few = self.diverging <= MAX_DIVERGING * self.draws.diverging.size
        return few and all(quantity.converged for quantity in self.quantities)


def estimate(data: Following, config: SamplerConfig, report: Callable[[float], None] = lambda share: None) -> Estimate:
    """Calibrate one class of drivers.

    Args:
        data: their steps.
        config: of the chains.
        report: is told, now and then, which share of the sampling is done.
    """
    # For the whole process: a setting of one thread would not reach those of the chains. Noise-free data fix a driver's
    # parameters to parts in a thousand of the population's spread, which single precision does not resolve.
    jax.config.update("jax_enable_x64", True)
    draws = sample(data, fit_laplace(data), config, report)
    predictions = predict(data, draws, config.seed)
    with np.errstate(invalid="ignore", divide="ignore"):
        quantities = tuple(_quantity(name, values) for name, values in _population(draws).items())
        driver_r_hat = float(np.max(split_gelman_rubin(draws.values["x"])))
    log_mean = draws.values["log_mean"].mean(axis=(0, 1))
    return Estimate(data, draws, predictions, quantities, driver_r_hat, log_mean, draws.log_cov.mean(axis=(0, 1)))


def _population(draws: Draws) -> dict[str, np.ndarray]:
    """Return the numbers of the population, each ``[chains, draws]``."""
    mean, sd, correlation = (draws.values[name] for name in ("log_mean", "log_sd", "correlation"))
    found = {f"median {name}": np.exp(mean[..., k]) for k, name in enumerate(IDM_PARAMETERS)}
    found |= {f"spread {name}": sd[..., k] for k, name in enumerate(IDM_PARAMETERS)}
    for row in range(len(IDM_PARAMETERS)):
        for column in range(row):
            name = f"correlation {IDM_PARAMETERS[column]} {IDM_PARAMETERS[row]}"
            found[name] = correlation[..., row, column]
    found["median noise_mps2"] = np.asarray(total_noise(draws.values["noise_mean"]))
    found["spread noise_mps2"] = draws.values["noise_sd"]
    return found


def _quantity(name: str, values: np.ndarray) -> Quantity:
    low, high = np.quantile(values, [(1.0 - INTERVAL) / 2.0, (1.0 + INTERVAL) / 2.0])
    r_hat, ess = float(split_gelman_rubin(values)), float(effective_sample_size(values))
    return Quantity(name, float(values.mean()), float(low), float(high), r_hat, ess)


def to_content(estimates: Mapping[str, Estimate], config: SamplerConfig, source: str) -> dict[str, Any]:
    """Return the JSON content that :func:`izoo.contexts.population.read_population` reads, and how it came about.

    A class that was not calibrated has the built-in drivers.
    """
    built_in = built_in_population()
    classes = {}
    for k, name in enumerate(CLASSES):
        of_class = estimates.get(name)
        mean, covariance = built_in.log_mean[k], built_in.log_cov[k]
        if of_class is not None:
            mean, covariance = of_class.log_mean, of_class.log_cov  # type: ignore[assignment]
        classes[name] = {
            "applies_to": APPLIES_TO[name],
            "calibrated": of_class is not None,
            "log_mean": [float(f"{value:.9g}") for value in mean],
            "log_cov": [[float(f"{value:.9g}") for value in row] for row in covariance],
        }
    return {
        "source": source,
        "converged": all(of_class.converged for of_class in estimates.values()),
        "parameters": list(IDM_PARAMETERS),
        "classes": classes,
        "calibration": {name: _provenance(of_class, config) for name, of_class in estimates.items()},
    }


def finite(value: float, digits: int) -> float | int | None:
    """Return a number with so many decimals; ``None``, as JSON has it, where chains that do not move give none."""
    return round(value, digits or None) if math.isfinite(value) else None


def _provenance(result: Estimate, config: SamplerConfig) -> dict[str, Any]:
    return {
        "drivers": len(result.data.drivers),
        "minutes": round(result.data.minutes, 1),
        "step_s": result.data.step_s,
        "chains": config.chains,
        "warmup": config.warmup,
        "draws": config.draws,
        "seed": config.seed,
        "diverging": result.diverging,
        "coverage_of_next_speeds": {
            f"{share:g}": round(held, 3) for share, held in result.predictions.coverage.items()
        },
        "quantities": {
            quantity.name: {
                "mean": float(f"{quantity.mean:.5g}"),
                "interval_90": [float(f"{quantity.low:.5g}"), float(f"{quantity.high:.5g}")],
                "r_hat": finite(quantity.r_hat, 4),
                "ess": finite(quantity.ess, 0),
            }
            for quantity in result.quantities
        },
    }
