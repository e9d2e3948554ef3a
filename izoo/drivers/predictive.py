"""Posterior predictive checks: does the model, with what was learnt, drive as the drivers did?

Two kinds. *Step by step*, from every observed state: do the intervals for the next speed hold as many observations as
they should? *Driving on*: each driver, with parameters from the posterior and noise, drives behind its recorded leader
as long as it followed it; do summaries of whole drives agree?
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from izoo.drivers.idm import SMALLEST_GAP_M, next_speed
from izoo.drivers.laplace_fit import NOISE_FLOOR_MPS2
from izoo.drivers.mcmc import Draws
from izoo.drivers.model import total_noise
from izoo.drivers.trajectories import Following

REPLICAS = 100
INTERVALS = (0.5, 0.9)
EXTREME = 0.01
"""A summary as far out as this share of replicas, on either side, is not reproduced."""
MOVING_MPS = 2.0


@dataclass(frozen=True)
class Check:
    """A summary of the data, compared with those of the replicas.

    Attributes:
        name: what is summarised, with its unit.
        observed: the data's value.
        replicas: ``[R]``.
    """

    name: str
    observed: float
    replicas: np.ndarray

    @property
    def share_above(self) -> float:
        """Share of replicas above the data, ties counting half: a Bayesian p-value, extreme near 0 and 1."""
        return float(np.mean(self.replicas > self.observed) + 0.5 * np.mean(self.replicas == self.observed))

    @property
    def reproduced(self) -> bool:
        """Whether the data look like a replica."""
        return EXTREME <= self.share_above <= 1.0 - EXTREME


@dataclass(frozen=True)
class Predictions:
    """All checks of one class, and what pictures need.

    Attributes:
        coverage: per interval of :data:`INTERVALS`, the share of next speeds that it holds.
        ranks: ``[steps]`` of the observed next speed among its predictions, in [0, 1]; uniform if all is well.
        autocorrelation: of residuals of consecutive steps; the model says 0; any below the floor count little.
        checks: of whole drives.
        speeds, gaps: ``[R, D, N]`` of the replicas that drove on, before each step.
    """

    coverage: dict[float, float]
    ranks: np.ndarray
    autocorrelation: float
    checks: tuple[Check, ...]
    speeds: np.ndarray
    gaps: np.ndarray


def predict(data: Following, draws: Draws, seed: int) -> Predictions:
    """Make all checks with :data:`REPLICAS` draws from the posterior."""
    x, log_noise = (draws.values[name].reshape(-1, *draws.values[name].shape[2:]) for name in ("x", "log_noise"))
    chosen = np.random.default_rng(seed).choice(len(x), REPLICAS, replace=len(x) < REPLICAS)
    keys = jax.random.split(jax.random.PRNGKey(seed), REPLICAS)
    arrays, continues = data.arrays(), jnp.asarray(data.continues)
    mean, scatter, speeds, gaps, changes = (
        np.asarray(value) for value in _replicate(x[chosen], log_noise[chosen], keys, arrays, continues, data.step_s)
    )
    used = data.used
    ranks = (scatter < data.next_speed_mps).mean(axis=0) + 0.5 * (scatter == data.next_speed_mps).mean(axis=0)
    ranks = ranks[used]
    coverage = {share: float(np.mean(np.abs(ranks - 0.5) <= share / 2.0)) for share in INTERVALS}
    residual = data.next_speed_mps - mean.mean(axis=0)
    pairs = data.continues[:, 1:] & used[:, 1:] & used[:, :-1]
    one, other = residual[:, :-1][pairs], residual[:, 1:][pairs]
    # Residuals below the floor of the noise are the rounding of a file, and say nothing of its drivers.
    least = (NOISE_FLOOR_MPS2 * data.step_s) ** 2
    scale = max(np.sqrt(np.mean(one**2) * np.mean(other**2)), least) if len(one) else least
    autocorrelation = float(np.mean(one * other) / scale) if len(one) else 0.0
    observed = _summaries(data.speed_mps, data.gap_m, data.next_speed_mps - data.speed_mps, data)
    replicas = [_summaries(s, g, c, data) for s, g, c in zip(speeds, gaps, changes, strict=True)]
    checks = tuple(
        Check(name, value, np.array([replica[name] for replica in replicas])) for name, value in observed.items()
    )
    return Predictions(coverage, ranks, autocorrelation, checks, speeds, gaps)


def _summaries(speed: np.ndarray, gap: np.ndarray, change: np.ndarray, data: Following) -> dict[str, float]:
    """Summaries of drives ``[D, N]``; ``change`` is the speed's over the step."""
    used = data.used
    moving = used & (speed > MOVING_MPS)
    accel = change[used] / data.step_s
    headway = gap[moving] / speed[moving] if moving.any() else np.zeros(1)
    return {
        "mean speed, m/s": float(speed[used].mean()),
        "spread of acceleration, m/s2": float(accel.std()),
        "strongest braking (1 %), m/s2": float(np.quantile(accel, 0.01)),
        "strongest acceleration (99 %), m/s2": float(np.quantile(accel, 0.99)),
        "median gap, m": float(np.median(gap[used])),
        "median time gap, s": float(np.median(headway)),
        "small time gap (5 %), s": float(np.quantile(headway, 0.05)),
    }


@functools.partial(jax.jit, static_argnums=5)
def _replicate(
    x: Array, log_noise: Array, keys: Array, arrays: tuple[Array, ...], continues: Array, step_s: float
) -> tuple[Array, ...]:
    """Return per replica the mean and a draw of the next speed, and speeds, gaps and changes of driving on."""
    speed, gap, leader, _, _ = (jnp.asarray(array) for array in arrays)
    leader_after = jnp.concatenate([leader[:, 1:], leader[:, -1:]], axis=1)

    def one(x: Array, log_noise: Array, key: Array) -> tuple[Array, ...]:
        mean = next_speed(x[:, None, :], speed, gap, leader, step_s)
        noise = jax.random.normal(key, (2, *speed.shape)) * (total_noise(log_noise)[:, None] * step_s)
        drawn = jnp.maximum(mean + noise[0], 0.0)

        def drive(state: tuple[Array, Array], place: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple]:
            begin_speed, begin_gap, lead, lead_after, goes_on, disturbance = place
            v = jnp.where(goes_on, state[0], begin_speed)
            s = jnp.where(goes_on, state[1], begin_gap)
            after = jnp.maximum(next_speed(x, v, s, lead, step_s) + disturbance, 0.0)
            gap_after = jnp.maximum(s + (lead_after - after) * step_s, SMALLEST_GAP_M)
            return (after, gap_after), (v, s, after - v)

        columns = (speed.T, gap.T, leader.T, leader_after.T, continues.T, noise[1].T)
        _, (v, s, change) = jax.lax.scan(drive, (speed[:, 0], gap[:, 0]), columns)
        return mean, drawn, v.T, s.T, change.T

    return jax.vmap(one)(x, log_noise, keys)
