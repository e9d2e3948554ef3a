"""The hierarchical Bayesian IDM, with independent noise, after Zhang and Sun (arXiv 2210.03571), in NumPyro.

Driver ``d``'s parameters ``x_d = log (v0, s0, T, alpha, beta)`` are normal around a population mean with a full
covariance, and the speed after a step is normal around what the IDM makes of the speed before it:

    x_d ~ N(mu, diag(sd) R diag(sd)),   R ~ LKJ(2),   sd ~ half-normal(0.5),   mu ~ N(log typical, 0.7)
    v_{t+1} ~ N(IDM(v_t, s_t, v_leader; x_d), (sigma_d^2 + floor^2) * step^2),   log sigma_d ~ N(nu, omega)

**How it is sampled.** Where a driver's data say much, ``x_d`` itself is the easy thing to sample; where they say
little, its distance from the population is; and both meet in one data set (one driver never brakes, none ever drives
freely). So ``x_d`` is written as the Gaussian approximation of its own conditional posterior, which the first fit's
curvature gives for any population, times a standard normal ``z_d``. This is a change of variables with its determinant,
not an approximation: the posterior is that of the lines above.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.typing import ArrayLike

from izoo.drivers.idm import next_speed
from izoo.drivers.laplace_fit import NOISE_FLOOR_MPS2, TYPICAL, LaplaceFit
from izoo.drivers.trajectories import Following

SIZE = len(TYPICAL)
MEAN_SPREAD = 0.7
SD_SCALE = 0.5
LKJ_CONCENTRATION = 2.0
NOISE_MPS2, NOISE_SPREAD, NOISE_SD_SCALE = 0.2, 1.5, 0.5


def model(data: Following, first_fit: LaplaceFit) -> None:
    """Declare the model of one class of drivers."""
    mean = _mean(first_fit)
    sd = _positive("log_sd", dist.HalfNormal(SD_SCALE), jnp.sqrt(jnp.diag(first_fit.log_cov)))
    factor = numpyro.sample("corr_factor", dist.LKJCholesky(SIZE, LKJ_CONCENTRATION))
    nu = numpyro.sample("noise_mean", dist.Normal(jnp.log(NOISE_MPS2), NOISE_SPREAD))
    omega = _positive("noise_sd", dist.HalfNormal(NOISE_SD_SCALE), noise_spread(first_fit))
    count = len(data.drivers)
    z = numpyro.sample("z", dist.Normal().expand([count, SIZE]).to_event(2))
    noise_z = numpyro.sample("noise_z", dist.Normal().expand([count]).to_event(1))

    x, log_volume = driver_parameters(mean, sd, factor, z, first_fit)
    log_noise, noise_volume = driver_noise(nu, omega, noise_z, first_fit)
    numpyro.deterministic("x", x)
    numpyro.deterministic("log_noise", log_noise)
    of_drivers = dist.MultivariateNormal(mean, scale_tril=sd[:, None] * factor).log_prob(x).sum()
    of_noise = dist.Normal(nu, omega).log_prob(log_noise).sum()
    # z and noise_z were given a standard normal, which the densities of x and log_noise replace.
    replaced = dist.Normal().log_prob(z).sum() + dist.Normal().log_prob(noise_z).sum()
    numpyro.factor("drivers", of_drivers + log_volume + of_noise + noise_volume - replaced)

    speed, gap, leader_speed, after, used = data.arrays()
    predicted = next_speed(x[:, None, :], speed, gap, leader_speed, data.step_s)
    scale = total_noise(log_noise) * data.step_s
    squares = jnp.sum(jnp.where(used, (after - predicted) / scale[:, None], 0.0) ** 2)
    numpyro.factor("speeds", -0.5 * squares - jnp.sum(first_fit.steps * jnp.log(scale)))


def total_noise(log_noise: ArrayLike) -> Array:
    """Return the standard deviation of the acceleration's noise, m/s^2, the floor included."""
    return jnp.sqrt(jnp.exp(2.0 * jnp.asarray(log_noise)) + NOISE_FLOOR_MPS2**2)


def _mean(first_fit: LaplaceFit) -> Array:
    """Sample the mean in coordinates in which the first fit makes its posterior round."""
    raw = numpyro.sample("log_mean_raw", dist.ImproperUniform(dist.constraints.real, (), (SIZE,)))
    mean = numpyro.deterministic("log_mean", first_fit.log_mean + first_fit.mean_root @ raw)
    numpyro.factor("log_mean_prior", dist.Normal(jnp.log(jnp.array(TYPICAL)), MEAN_SPREAD).log_prob(mean).sum())
    return mean


def _positive(name: str, prior: dist.Distribution, scale: Array) -> Array:
    """Sample a standard deviation as ``scale`` times the softplus of a real number.

    The data may allow a spread of zero, as of v0 where all obey one limit. Then the logarithm would have a long tail on
    one side and a cliff on the other; softplus is a logarithm for small values and linear for large ones.
    """
    raw = numpyro.sample(f"{name}_raw", dist.ImproperUniform(dist.constraints.real, (), scale.shape))
    value = numpyro.deterministic(name, scale * jax.nn.softplus(raw))
    numpyro.factor(f"{name}_prior", jnp.sum(prior.log_prob(value) + jax.nn.log_sigmoid(raw)))
    return value


def noise_spread(first_fit: LaplaceFit) -> Array:
    """Return how much the first fit's noise differs between drivers; not less than chance would have it."""
    return jnp.sqrt(jnp.var(first_fit.log_noise) + 1.0 / (NOISE_SD_SCALE**-2 + jnp.mean(first_fit.noise_information)))


def driver_parameters(mean: Array, sd: Array, factor: Array, z: Array, first_fit: LaplaceFit) -> tuple[Array, Array]:
    """Return ``x`` ``[D, 5]`` for standard normal ``z``, and the log of the volume that a unit of ``z`` takes in ``x``.

    Given the population and the quadratic log-likelihood of the first fit, ``x_d`` is normal with precision
    ``Sigma^-1 + information_d`` and mean ``precision^-1 (Sigma^-1 mu + pull_d)``.
    """
    inverse = solve_triangular(sd[:, None] * factor, jnp.eye(SIZE), lower=True)
    precision = inverse.T @ inverse
    root = jnp.linalg.cholesky(precision + first_fit.information)
    centre = cho_solve((root, True), (precision @ mean + first_fit.pull)[..., None])[..., 0]
    away = solve_triangular(root, z[..., None], lower=True, trans=1)[..., 0]
    return centre + away, -jnp.sum(jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)))


def driver_noise(nu: Array, omega: Array, z: Array, first_fit: LaplaceFit) -> tuple[Array, Array]:
    """Return ``log sigma`` ``[D]`` and the log-volume, as :func:`driver_parameters` does."""
    precision, information = omega**-2, first_fit.noise_information
    total = precision + information
    centre = (precision * nu + information * first_fit.log_noise) / total
    return centre + z / jnp.sqrt(total), -0.5 * jnp.sum(jnp.log(total))


def start(first_fit: LaplaceFit) -> dict[str, Array]:
    """Return where to begin, in the coordinates of the sampler: the first fit."""
    count = len(first_fit.steps)
    one = jnp.log(jnp.expm1(1.0))
    return {
        "corr_factor": jnp.zeros(SIZE * (SIZE - 1) // 2),
        "log_mean_raw": jnp.zeros(SIZE),
        "log_sd_raw": jnp.full(SIZE, one),
        "noise_mean": jnp.mean(first_fit.log_noise),
        "noise_sd_raw": one,
        "noise_z": jnp.zeros(count),
        "z": jnp.zeros((count, SIZE)),
    }


def scales(first_fit: LaplaceFit) -> dict[str, Array]:
    """Return rough posterior variances of the sampler's coordinates: its mass matrix.

    A spread or a correlation that the data hardly show is about as uncertain as its prior; others shrink with the
    number of drivers.
    """
    count = len(first_fit.steps)
    row, column = jnp.tril_indices(SIZE, -1)
    spread = noise_spread(first_fit) ** 2
    noise_vague = 1.0 / (NOISE_SD_SCALE**-2 + jnp.mean(first_fit.noise_information)) / spread
    noise_worth = first_fit.noise_information / (1.0 + spread * first_fit.noise_information)
    return {
        "corr_factor": 1.0 / count + 0.15 * jnp.maximum(first_fit.vague[row], first_fit.vague[column]),
        "log_mean_raw": jnp.ones(SIZE),
        "log_sd_raw": 2.0 / count + first_fit.vague,
        "noise_mean": 1.0 / (NOISE_SPREAD**-2 + jnp.sum(noise_worth)),
        "noise_sd_raw": 2.0 / count + noise_vague,
        "noise_z": jnp.ones(count),
        "z": jnp.ones((count, SIZE)),
    }
