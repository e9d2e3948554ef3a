"""A quick first fit: the most likely parameters of every driver, how well the data fix them, and a rough population.

It tells the sampler where the posterior lies and how wide it is in every direction (:mod:`izoo.drivers.model`); no
result is taken from it.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from izoo.drivers.idm import next_speed
from izoo.drivers.trajectories import Following

TYPICAL = (15.0, 2.0, 1.2, 1.2, 1.6)
"""v0 m/s, s0 m, T s, alpha and beta m/s^2 of a driver in town: the medians of the prior, and where the fit begins."""
FIRST_SPREAD = 0.4
FIRST_NOISE_MPS2 = 0.3
NOISE_FLOOR_MPS2 = 0.05
"""Added to every driver's noise, in squares. Recorded trajectories are not more exact; simulated ones, which are, would
otherwise bind the sampler to the kinks of the IDM."""
ROUNDS, FITS_PER_ROUND = 12, 4

Arrays = tuple[Array, ...]
"""Speed, gap, leader speed, next speed and used, each ``[D, N]``."""
State = tuple[Array, Array, Array, Array]
"""Parameters and noise of the drivers, mean and covariance of their population."""


class LaplaceFit(NamedTuple):
    """What the first fit found out about ``D`` drivers.

    Attributes:
        information: ``[D, 5, 5]`` curvature of each driver's log-likelihood around its peak (Gauss-Newton).
        pull: ``[D, 5]``: the quadratic log-likelihood is ``pull @ x - x @ information @ x / 2``.
        log_noise: ``[D]`` log of the residual acceleration's standard deviation, the floor taken out.
        noise_information: ``[D]`` curvature of the log-likelihood along ``log_noise``; 0 where the floor hides it.
        steps: ``[D]`` how many steps each driver has.
        log_mean, log_cov: ``[5]`` and ``[5, 5]`` of a rough population.
        mean_root: ``[5, 5]`` lower triangular root of the posterior covariance of ``log_mean``, were ``log_cov`` known.
        vague: ``[5]`` share of that variance which is not knowing the drivers; 1: the data do not tell them apart.
    """

    information: Array
    pull: Array
    log_noise: Array
    noise_information: Array
    steps: Array
    log_mean: Array
    log_cov: Array
    mean_root: Array
    vague: Array


def fit_laplace(data: Following) -> LaplaceFit:
    """Fit every driver by damped Gauss-Newton, drawn towards a population that is estimated along the way."""
    return _fit(data.arrays(), data.step_s)


@functools.partial(jax.jit, static_argnums=1)
def _fit(arrays: Arrays, step_s: float) -> LaplaceFit:
    count, size = arrays[0].shape[0], len(TYPICAL)
    steps = jnp.sum(arrays[-1], axis=1)
    mean, covariance = jnp.log(jnp.array(TYPICAL)), jnp.eye(size) * FIRST_SPREAD**2

    def one_round(state: State, nothing: None) -> tuple[State, None]:
        theta, noise, mean, covariance = state
        precision = jnp.linalg.inv(covariance)

        def improve(fit: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            return _improve(*fit, noise, mean, precision, arrays, step_s), None

        theta = jax.lax.scan(improve, (theta, jnp.full(count, 1e-3)), None, length=FITS_PER_ROUND)[0][0]
        information, _, squares = _curvature(theta, noise, arrays, step_s)
        noise = jnp.maximum(noise * jnp.sqrt(squares / steps), NOISE_FLOOR_MPS2)
        mean = theta.mean(axis=0)
        unknown = jnp.linalg.inv(information + precision).mean(axis=0)
        centred = theta - mean
        return (theta, noise, mean, centred.T @ centred / count + unknown + 1e-6 * jnp.eye(size)), None

    first = (jnp.tile(mean, (count, 1)), jnp.full(count, FIRST_NOISE_MPS2), mean, covariance)
    (theta, noise, mean, covariance), _ = jax.lax.scan(one_round, first, None, length=ROUNDS)
    information, gradient, _ = _curvature(theta, noise, arrays, step_s)
    pull = gradient + jnp.einsum("dij,dj->di", information, theta)
    precision = jnp.linalg.inv(covariance)
    of_drivers = jnp.linalg.inv(information + precision)
    # What a driver says of the mean is worth (log_cov + information^-1)^-1, written without inverting the information.
    worth = jnp.sum(precision - precision @ of_drivers @ precision, axis=0)
    mean_root = jnp.linalg.cholesky(jnp.linalg.inv(worth + jnp.eye(size)))
    unknown = of_drivers.mean(axis=0)
    vague = jnp.clip(jnp.diag(unknown) / jnp.diag(covariance), 0.0, 1.0)
    above = jnp.maximum(noise**2 - NOISE_FLOOR_MPS2**2, 0.05 * NOISE_FLOOR_MPS2**2)
    # The log of a standard deviation is known with information 2 n; here, of the part that is not the floor.
    # Noise below the floor leaves no trace: the likelihood is flat there.
    seen = noise > NOISE_FLOOR_MPS2
    noise_information = jnp.where(seen, 2.0 * steps * (above / noise**2) ** 2, 0.0)
    return LaplaceFit(
        information, pull, 0.5 * jnp.log(above), noise_information, steps, mean, covariance, mean_root, vague
    )


def _curvature(theta: Array, noise: Array, arrays: Arrays, step_s: float) -> tuple[Array, Array, Array]:
    """Return information ``[D, 5, 5]``, gradient ``[D, 5]`` and the sum ``[D]`` of squared residuals over noise."""

    def residual(parameters: Array) -> Array:
        return _residual(parameters, noise, arrays, step_s)

    value = residual(theta)

    def slope(axis: Array) -> Array:
        return jax.jvp(residual, (theta,), (jnp.broadcast_to(axis, theta.shape),))[1]

    slopes = jax.vmap(slope)(jnp.eye(theta.shape[-1]))
    information = jnp.einsum("idn,jdn->dij", slopes, slopes)
    return information, -jnp.einsum("idn,dn->di", slopes, value), jnp.sum(value**2, axis=1)


def _residual(theta: Array, noise: Array, arrays: Arrays, step_s: float) -> Array:
    speed, gap, leader_speed, after, used = arrays
    error = next_speed(theta[:, None, :], speed, gap, leader_speed, step_s) - after
    return jnp.where(used, error / (noise[:, None] * step_s), 0.0)


def _improve(
    theta: Array, damping: Array, noise: Array, mean: Array, precision: Array, arrays: Arrays, step_s: float
) -> tuple[Array, Array]:
    """Take one Levenberg-Marquardt step per driver, where it helps; return the parameters and the new damping."""

    def loss(parameters: Array, squares: Array) -> Array:
        away = parameters - mean
        return squares + jnp.einsum("di,ij,dj->d", away, precision, away)

    information, gradient, squares = _curvature(theta, noise, arrays, step_s)
    matrix = information + precision
    diagonal = jnp.einsum("dii->di", matrix)[..., None] * jnp.eye(theta.shape[-1])
    slope = gradient - (theta - mean) @ precision
    step = jnp.linalg.solve(matrix + damping[:, None, None] * diagonal, slope[..., None])[..., 0]
    proposal = theta + jnp.clip(step, -0.5, 0.5)
    after = jnp.sum(_residual(proposal, noise, arrays, step_s) ** 2, axis=1)
    better = loss(proposal, after) < loss(theta, squares)
    return jnp.where(better[:, None], proposal, theta), jnp.where(better, damping * 0.2, damping * 10.0)
