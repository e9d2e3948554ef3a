"""Whether calibration finds what it should: ``python -m izoo.benchmarks.calibration --out FOLDER [--sets 20]``.

Per data set a population is drawn, the environment simulates its drivers at a signal, ``write_trajectories`` writes
what it saw, and the calibration is asked for the population. ``--speed-noise`` adds what a camera would. Sets that the
folder has with the same options are not run again, so the benchmark can be stopped and continued.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.cli.calibrate import check_packages
from izoo.console import exit_code, unheard
from izoo.contexts.population import IDM_PARAMETERS, DriverPopulation
from izoo.envs import MODEL_VERSION
from izoo.errors import check_range
from izoo.files import replacing, usable_paths
from izoo.results.rows_file import Row, RowsFile

LIMIT_MPS = 16.0
LANE_M, INFLOW_VPH, HORIZON_S = 1200.0, 600.0, 900.0
MEDIAN_RANGES = {"s0_m": (1.5, 3.0), "T_s": (0.6, 1.6), "alpha_mps2": (0.8, 1.8), "beta_mps2": (1.2, 2.5)}
SPREAD_RANGE = (0.1, 0.25)
KINDS = ("median", "spread", "correlation")
SETS_FILE = "sets.csv"
SETTINGS = ("set", "drivers", "speed_noise_mps", "warmup", "draws", "model_version")
"""Which data set, and how it was made and calibrated."""
NUMBERS = ("minutes", "seconds", "processor_seconds", "worst_r_hat", "least_ess", "true", "mean", "low", "high")
"""The minutes are those that drivers were followed for; the seconds are those that the calibration took."""


def true_population(number: int) -> DriverPopulation:
    """Draw the population of a data set; v0 is of no effect in the environment, where the limit rules."""
    generator = np.random.default_rng([number, 0])
    medians = [LIMIT_MPS, *(generator.uniform(low, high) for low, high in MEDIAN_RANGES.values())]
    spreads = np.array([0.1, *generator.uniform(*SPREAD_RANGE, len(MEDIAN_RANGES))])
    factor = generator.standard_normal((len(medians), 3 * len(medians)))
    covariance = factor @ factor.T
    scale = spreads / np.sqrt(np.diag(covariance))
    covariance = scale[:, None] * covariance * scale
    mean, both = tuple(np.log(medians).tolist()), tuple(map(tuple, covariance.tolist()))
    return DriverPopulation((mean, mean), (both, both))


def truth(population: DriverPopulation) -> dict[str, float]:
    """Return the true values of what a calibration estimates, as far as the environment's traffic depends on them."""
    mean, covariance = np.array(population.log_mean[0]), np.array(population.log_cov[0])
    sd = np.sqrt(np.diag(covariance))
    names = list(enumerate(IDM_PARAMETERS))
    found = {f"median {name}": float(np.exp(mean[k])) for k, name in names}
    found |= {f"spread {name}": float(sd[k]) for k, name in names[1:]}
    for row, name in names[1:]:
        for column, other in names[1:row]:
            found[f"correlation {other} {name}"] = float(covariance[row, column] / (sd[row] * sd[column]))
    return found


def simulate(population: DriverPopulation, number: int, path: Path, speed_noise_mps: float) -> None:
    """Write the trajectories of human drivers of a population; to every speed, white noise is added."""
    from izoo.contexts.procedural import procedural_context
    from izoo.envs import EcoDrivingEnv, EnvConfig
    from izoo.envs.views.trajectories import write_trajectories

    context = procedural_context(
        adoption=0.0, inflow_vph_per_lane=INFLOW_VPH, lane_length_m=LANE_M, speed_limit_mps=LIMIT_MPS
    ).replace(drivers=population)
    env = EcoDrivingEnv(context, config=EnvConfig(emit=("vehicles",), horizon_s=HORIZON_S), seed=number)
    try:
        rollout = env.rollout(env.config.control_steps)
    finally:
        env.close()
    table = pd.read_csv(write_trajectories(rollout, path))
    generator = np.random.default_rng([number, 1])
    seen = table["speed_mps"] + speed_noise_mps * generator.standard_normal(len(table))
    table["speed_mps"] = seen.clip(lower=0.0)
    table.to_csv(path, index=False)


def recover(number: int, drivers: int, chains: Any, speed_noise_mps: float = 0.0) -> list[Row]:
    """Simulate and calibrate one data set; return a row per quantity: its ``name``, what is ``true`` and what was found
    (``mean``, and ``low`` and ``high`` of the 90 % interval), with :data:`NUMBERS` of the set and ``converged``.
    """
    from izoo.drivers.estimate import estimate, finite
    from izoo.drivers.trajectories import ReadConfig, read_following

    population = true_population(number)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectories.csv")
        simulate(population, number, path, speed_noise_mps)
        classes, _ = read_following([path], ReadConfig(max_drivers=drivers, seed=number))
    data = classes["light"]
    began, worked = time.monotonic(), time.process_time()
    result = estimate(data, chains)
    found = {quantity.name: quantity for quantity in result.quantities}
    shared = {
        "minutes": data.minutes / len(data.drivers),
        "seconds": time.monotonic() - began,
        "processor_seconds": time.process_time() - worked,
        "converged": result.converged,
        "worst_r_hat": finite(float(np.max([quantity.r_hat for quantity in result.quantities])), 4),
        "least_ess": finite(float(np.min([quantity.ess for quantity in result.quantities])), 0),
    }
    return [
        {**shared, "name": name, "true": value, **{end: getattr(found[name], end) for end in ("mean", "low", "high")}}
        for name, value in truth(population).items()
    ]


def summarise(rows: pd.DataFrame) -> str:
    """Return coverage of the 90 % intervals, and errors of the medians, over the data sets."""
    sets = rows.drop_duplicates("set")
    minutes, work = sets[["minutes", "processor_seconds"]].median()
    lines = [
        f"{len(sets)} data sets, {sets['converged'].sum()} converged; median: {sets['drivers'].iloc[0]} drivers of "
        f"{minutes:.1f} minutes behind a leader, {work:.0f} s of processor time",
        f"{'':34} {'inside 90 %':>12} {'mean error':>11} {'typical error':>14}",
    ]
    held = (rows["low"] <= rows["true"]) & (rows["true"] <= rows["high"])
    for name, part in rows.groupby("name", sort=False):
        share = name.startswith("correlation")
        errors = part["mean"] - part["true"] if share else part["mean"] / part["true"] - 1.0
        form = ("+11.2f", "14.2f") if share else ("+11.1%", "14.1%")
        typical = float(np.sqrt(np.mean(errors**2)))
        lines.append(f"{name:34} {held[part.index].mean():12.0%} {errors.mean():{form[0]}} {typical:{form[1]}}")
    for kind in KINDS:
        of = held[rows["name"].str.startswith(kind)]
        lines.append(f"all {kind}s: {of.mean():.1%} of {len(of)} intervals hold the truth")
    return "\n".join([*lines, f"all: {held.mean():.1%} of {len(held)} intervals hold the truth"])


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Draw what was recovered over what is true, with 90 % intervals, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(MEDIAN_RANGES))
    for column, parameter in enumerate(MEDIAN_RANGES):
        for row, kind in enumerate(KINDS[:2]):
            chosen = rows[rows["name"] == f"{kind} {parameter}"]
            true, mean, low, high = (chosen[key].to_numpy(float) for key in ("true", "mean", "low", "high"))
            axis = axes[row, column]
            axis.errorbar(true, mean, [mean - low, high - mean], fmt="o", markersize=4, color="#0072b2", linewidth=1)
            ends = [true.min(), true.max()]
            axis.plot(ends, ends, color="#333333", linewidth=1)
            axis.set(title=f"{kind} of {parameter}", xlabel="true", ylabel="calibrated" if column == 0 else "")
    with replacing(path, durable=False) as partial:
        figure.savefig(partial, dpi=90, format="png")


@usable_paths()
@unheard()
def run(options: argparse.Namespace) -> int:
    """Run the sets that the folder lacks, and summarise all of it."""
    print("izoo benchmarks.calibration", flush=True)
    check_range("--sets", options.sets, 1, 1000)
    check_range("--drivers", options.drivers, 5, 200)
    check_range("--speed-noise", options.speed_noise, 0.0, 1.0, "m/s")
    check_packages()
    from izoo.drivers.mcmc import SamplerConfig

    chains = SamplerConfig(options.warmup, options.draws)
    options.out.mkdir(parents=True, exist_ok=True)
    columns = (*SETTINGS, "name", "converged", *NUMBERS)
    kept = RowsFile(options.out / SETS_FILE, columns, ("name",), ("set", "drivers", "warmup", "draws")).read()
    wanted = []
    for number in range(options.sets):
        key = (number, options.drivers, options.speed_noise, options.warmup, options.draws, MODEL_VERSION)
        own = [row for row in kept.rows if tuple(row[name] for name in SETTINGS) == key]
        if not own:
            found = recover(number, options.drivers, chains, options.speed_noise)
            own = [{**dict(zip(SETTINGS, key, strict=True)), **row} for row in found]
            kept.add(own)
        wanted += own
        last, r_hat, ess = own[0], own[0]["worst_r_hat"], own[0]["least_ess"]
        said = "chains that do not move" if None in (r_hat, ess) else f"worst R-hat {r_hat:.3f}, least ESS {ess:.0f}"
        print(
            f"set {number}: {last['seconds']:.0f} s, {said}{'' if last['converged'] else ', not converged'}", flush=True
        )
    rows = pd.DataFrame(wanted)
    print(summarise(rows))
    draw(rows, options.out / "recovery.png")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m izoo.benchmarks.calibration", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; existing ones are kept")
    parser.add_argument("--sets", type=int, default=20, help="data sets; default: 20")
    parser.add_argument("--drivers", type=int, default=50, help="light drivers of each; default: 50")
    parser.add_argument("--speed-noise", type=float, default=0.0, help="m/s, added to every speed; default: 0")
    parser.add_argument("--warmup", type=int, default=200, help="iterations per chain before it counts; default: 200")
    parser.add_argument("--draws", type=int, default=400, help="iterations per chain that count; default: 400")
    return exit_code("benchmarks.calibration", lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    sys.exit(main())
