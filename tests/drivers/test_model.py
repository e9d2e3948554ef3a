"""The model: one step is the simulator's, the density is the one written down, and a known population is found."""

import contextlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("numpyro", reason="needs izoo[calibrate]")

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from numpyro.infer import util

from izoo.contexts.procedural import procedural_context
from izoo.drivers import model
from izoo.drivers.estimate import Estimate, estimate, to_content
from izoo.drivers.idm import next_speed
from izoo.drivers.laplace_fit import NOISE_FLOOR_MPS2, TYPICAL, LaplaceFit, fit_laplace
from izoo.drivers.mcmc import SamplerConfig, sample
from izoo.drivers.predictive import predict
from izoo.drivers.trajectories import Following, ReadConfig, read_following
from tests.drivers.platoons import MEDIANS, SPREAD, idm_step, platoon_table

jax.config.update("jax_enable_x64", True)


def following(folder: Path, drivers: int, steps: int, **options: float) -> Following:
    path = folder / "pairs.csv"
    platoon_table(drivers, steps, **options).to_csv(path, index=False)  # type: ignore[arg-type]
    return read_following([path], ReadConfig())[0]["light"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Following:
    return following(tmp_path_factory.mktemp("pairs"), 12, 120)


@pytest.fixture(scope="module")
def first_fit(data: Following) -> LaplaceFit:
    return fit_laplace(data)


@pytest.fixture(scope="module")
def found(data: Following) -> Estimate:
    return estimate(data, SamplerConfig(warmup=100, draws=200, chains=2))


@pytest.mark.parametrize("step_s", [0.1, 0.5, 1.0])
def test_one_step_is_that_of_the_intelligent_driver_model(step_s: float) -> None:
    generator = np.random.default_rng(0)
    v, leader = generator.uniform(0.0, 16.0, (2, 200))
    gap = generator.uniform(0.5, 60.0, 200)
    driver = np.exp(np.log(TYPICAL) + 0.3 * generator.standard_normal((200, 5)))
    expected = [idm_step(*state, step_s=step_s) for state in zip(v, gap, leader, driver, strict=True)]
    np.testing.assert_allclose(next_speed(jnp.log(driver), v, gap, leader, step_s), expected, atol=1e-9)


def test_one_step_is_the_simulators(tmp_path: Path) -> None:
    """Behind the intersection nobody has to obey a signal, so every vehicle does what its drawn parameters say."""
    from izoo.envs import EcoDrivingEnv, EnvConfig
    from izoo.envs.views.trajectories import write_trajectories

    context = procedural_context(adoption=0.0, inflow_vph_per_lane=500.0)
    config = EnvConfig(emit=("vehicles",), horizon_s=150.0)
    with contextlib.closing(EcoDrivingEnv(context, config=config)) as env:
        path = write_trajectories(env.rollout(config.control_steps), tmp_path / "trajectories.csv")
        traffic = env.backend.simulation().traffic
    data = read_following([path], ReadConfig())[0]["light"]
    rows = np.array(data.drivers, dtype=int)
    columns = (np.full(len(rows), 16.0), traffic.min_gap_m[rows], traffic.tau_s[rows], traffic.accel_mps2[rows])
    driver = np.log(np.stack([*columns, traffic.decel_mps2[rows]], axis=1))
    predicted = next_speed(driver[:, None], data.speed_mps, data.gap_m, data.leader_speed_mps, 0.5)
    error = np.abs(np.asarray(predicted) - data.next_speed_mps)[data.used]
    assert len(error) > 150
    assert np.quantile(error, 0.98) < 2e-3


@pytest.mark.slow
def test_the_density_is_the_one_written_down_for_any_first_fit(data: Following, first_fit: LaplaceFit) -> None:
    """Coordinates that a worse first fit suggests hold the same posterior: the change of variables is exact."""
    generator = np.random.default_rng(2)
    worse = first_fit._replace(
        information=0.3 * first_fit.information + 2.0 * jnp.eye(5),
        pull=0.5 * first_fit.pull,
        log_noise=first_fit.log_noise + 0.3,
        noise_information=0.1 * first_fit.noise_information,
    )
    for fit in (first_fit, worse):
        difference = []
        for _ in range(3):
            near = {name: jnp.asarray(value) for name, value in model.start(fit).items()}
            place = {name: value + 0.1 * generator.standard_normal(value.shape) for name, value in near.items()}
            values = util.constrain_fn(model.model, (data, fit), {}, place, return_deterministic=True)
            got = -util.potential_energy(model.model, (data, fit), {}, place)
            difference.append(float(got - _written_down(data, values, place, fit)))
        # Constants are left out of the product's density.
        np.testing.assert_allclose(difference, difference[0], atol=1e-6)


def _written_down(data: Following, values: dict, place: dict, first_fit: LaplaceFit) -> float:
    """The model's lines, term by term, and the volumes of the sampler's coordinates."""
    mean, sd, factor = values["log_mean"], values["log_sd"], values["corr_factor"]
    covariance = np.outer(sd, sd) * (factor @ factor.T)
    total = dist.Normal(jnp.log(jnp.array(TYPICAL)), 0.7).log_prob(mean).sum()
    total += dist.HalfNormal(0.5).log_prob(sd).sum() + dist.HalfNormal(0.5).log_prob(values["noise_sd"])
    total += dist.LKJCholesky(5, 2.0).log_prob(factor) + dist.Normal(jnp.log(0.2), 1.5).log_prob(values["noise_mean"])
    total += dist.MultivariateNormal(mean, covariance).log_prob(values["x"]).sum()
    total += dist.Normal(values["noise_mean"], values["noise_sd"]).log_prob(values["log_noise"]).sum()
    for d, driver in enumerate(np.exp(values["x"])):
        scale = 0.5 * np.sqrt(np.exp(2.0 * values["log_noise"][d]) + NOISE_FLOOR_MPS2**2)
        for k in np.flatnonzero(data.used[d]):
            ahead = idm_step(data.speed_mps[d, k], data.gap_m[d, k], data.leader_speed_mps[d, k], driver)
            total += -0.5 * ((data.next_speed_mps[d, k] - ahead) / scale) ** 2 - np.log(scale)

    def constrained(place: dict) -> jnp.ndarray:
        """What the volumes are of: the drivers' values, by the sampler's coordinates."""
        values = util.constrain_fn(model.model, (data, first_fit), {}, place, return_deterministic=True)
        return jnp.concatenate([values["x"].ravel(), values["log_noise"]])

    def of_drivers(z: jnp.ndarray, noise_z: jnp.ndarray) -> jnp.ndarray:
        return constrained({**place, "z": z, "noise_z": noise_z})

    by_z, by_noise = jax.jacobian(of_drivers, argnums=(0, 1))(place["z"], place["noise_z"])
    matrix = jnp.concatenate([by_z.reshape(len(by_z), -1), by_noise], axis=1)
    total += jnp.linalg.slogdet(matrix)[1]
    for name in ("log_sd", "noise_sd"):  # of softplus
        total += jnp.sum(jnp.log(jax.nn.sigmoid(place[f"{name}_raw"])))
    factor_from = dist.biject_to(dist.constraints.corr_cholesky)
    raw = place["corr_factor"]
    return float(total + factor_from.log_abs_det_jacobian(raw, factor_from(raw)).sum())


@pytest.mark.slow
def test_a_known_population_is_found(found: Estimate) -> None:
    assert not found.draws.diverging.any() and found.driver_r_hat < 1.1
    assert max(quantity.r_hat for quantity in found.quantities) < 1.1
    for k, (name, true) in enumerate(MEDIANS.items()):
        # Twelve drivers, so the mean of their logs lies within three standard errors of the population's.
        assert found.log_mean[k] == pytest.approx(np.log(true), abs=3.5 * SPREAD / np.sqrt(12)), name
    noise = next(quantity for quantity in found.quantities if quantity.name == "median noise_mps2")
    assert noise.low < 0.11 and noise.high > 0.1 and noise.high < 0.13


@pytest.mark.slow
def test_predictive_checks_accept_the_model_that_made_the_data(found: Estimate) -> None:
    predictions = found.predictions
    assert predictions.coverage[0.5] == pytest.approx(0.5, abs=0.05)
    assert predictions.coverage[0.9] == pytest.approx(0.9, abs=0.03)
    assert abs(predictions.autocorrelation) < 0.1
    assert sum(check.reproduced for check in predictions.checks) >= len(predictions.checks) - 1


@pytest.mark.slow
def test_predictive_checks_can_fail(found: Estimate, data: Following) -> None:
    """Drivers who react a second late drive on as no IDM does."""
    late = data.next_speed_mps.copy()
    late[:, 2:] = data.next_speed_mps[:, :-2]
    swapped = Following(*[*vars(data).values()][:5], late, data.used, data.continues)
    predictions = predict(swapped, found.draws, 0)
    assert predictions.coverage[0.9] < 0.8
    assert not all(check.reproduced for check in predictions.checks)


@pytest.mark.slow
def test_chains_of_one_seed_are_the_same(data: Following, first_fit: LaplaceFit) -> None:
    config = SamplerConfig(warmup=20, draws=20, chains=2, seed=4)
    reports: list[float] = []
    one, other = (sample(data, first_fit, config, reports.append) for _ in range(2))
    np.testing.assert_array_equal(one.values["log_mean"], other.values["log_mean"])
    assert not np.array_equal(one.values["log_mean"][0], one.values["log_mean"][1])
    assert reports[-1] == 1.0 and reports[: len(reports) // 2] == sorted(reports[: len(reports) // 2])
    assert one.values["x"].shape == (2, 20, 12, 5)


@pytest.mark.slow
def test_a_class_without_data_has_the_built_in_drivers(found: Estimate, tmp_path: Path) -> None:
    from izoo.contexts.population import DriverPopulation
    from izoo.traffic.drivers import built_in_population

    content = to_content({"light": found}, SamplerConfig(), "test")
    classes = content["classes"]
    assert (classes["light"]["calibrated"], classes["heavy"]["calibrated"]) == (True, False)
    population = DriverPopulation(*([classes[name][key] for name in classes] for key in ("log_mean", "log_cov")))
    assert population.log_mean[1] == built_in_population().log_mean[1]
    np.testing.assert_allclose(population.log_mean[0], found.log_mean, rtol=1e-8)
    assert content["converged"] is all(quantity.converged for quantity in found.quantities)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_environments_drivers_are_found() -> None:
    """One data set of the recovery study."""
    from izoo.benchmarks.calibration import recover

    table = pd.DataFrame(recover(0, 30, SamplerConfig(warmup=150, draws=250)))
    assert table["converged"].all()
    held = (table["low"] <= table["true"]) & (table["true"] <= table["high"])
    assert held.mean() >= 0.6
    medians = table[table["name"].str.startswith("median")]
    assert ((medians["mean"] / medians["true"] - 1.0).abs() < 0.12).all()
