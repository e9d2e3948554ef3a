"""Whether calibration finds what it should: ``python -m izoo.benchmarks.calibration out=FOLDER``.

Per data set a population is drawn, the environment simulates its drivers at a signal, and the calibration is asked for
the population. Sets that the folder has with the same options are not run again.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.cli.calibrate import check_packages
from izoo.cli.option_command import GOES_ON, OptionCommand
from izoo.contexts.population import IDM_PARAMETERS, DriverPopulation
from izoo.envs.model_version import MODEL_VERSION
from izoo.files import make_absolute
from izoo.options import CheckedOptions
from izoo.results.rows_file import Key, Row, RowsFile

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


@dataclass(frozen=True)
class CalibrationConfig(CheckedOptions):
    """Options of the study.

    Attributes:
        out: folder of the results.
        sets: data sets.
        drivers: light drivers of each.
        speed_noise_mps: white noise that is added to every speed, as a camera would.
        warmup, draws: iterations per chain before it counts, and that count.
    """

    out: str = "calibration"
    sets: int = 20
    drivers: int = 50
    speed_noise_mps: float = 0.0
    warmup: int = 200
    draws: int = 400
    ranges = (("sets", 1, 1000), ("drivers", 5, 200), ("speed_noise_mps", 0.0, 1.0, "m/s"))

    def __post_init__(self) -> None:
        super().__post_init__()
        make_absolute(self, "out")


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


def simulate(population: DriverPopulation, number: int, speed_noise_mps: float) -> pd.DataFrame:
    """Return the trajectories of human drivers of a population; to every speed, white noise is added."""
    import torch
    from tensordict import TensorDict, TensorDictBase

    from izoo.contexts.procedural import procedural_context
    from izoo.contexts.source import episode_seed
    from izoo.envs import EcoDrivingEnv, EnvConfig
    from izoo.envs.views.trajectories import trajectory_table
    from izoo.results.playing import run_episode
    from izoo.results.policies import as_policy

    context = procedural_context(
        adoption=0.0, inflow_vph_per_lane=INFLOW_VPH, lane_length_m=LANE_M, speed_limit_mps=LIMIT_MPS
    ).replace(drivers=population)
    config, seen = EnvConfig(emit=("vehicles",), horizon_s=HORIZON_S), []
    uncommanded = as_policy("uncommanded", config).policy

    def watched(state: TensorDictBase) -> TensorDictBase:
        seen.append(state["vehicles"].clone())
        return uncommanded(state)

    with contextlib.closing(EcoDrivingEnv(config=config)) as env:
        run_episode(env, watched, context, episode_seed(number, 0))
    table = trajectory_table(TensorDict({"next": {"vehicles": torch.stack(seen)}}, [len(seen)]))
    noise = np.random.default_rng([number, 1]).standard_normal(len(table))
    return table.assign(speed_mps=(table["speed_mps"] + speed_noise_mps * noise).clip(lower=0.0))


def recover(number: int, drivers: int, chains: Any, speed_noise_mps: float = 0.0) -> list[Row]:
    """Simulate and calibrate one data set; return a row per quantity: its ``name``, what is ``true`` and what was found
    (``mean``, and ``low`` and ``high`` of the 90 % interval), with :data:`NUMBERS` of the set and ``converged``.
    """
    from izoo.drivers.estimate import estimate, finite
    from izoo.drivers.trajectories import ReadConfig, read_following

    population = true_population(number)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectories.csv")
        simulate(population, number, speed_noise_mps).to_csv(path, index=False)
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
    from izoo.training.plots import QUIET, Chart, Series, save
    from izoo.training.plots import draw as draw_charts

    charts = []
    for kind in KINDS[:2]:
        for parameter in MEDIAN_RANGES:
            of = rows[rows["name"] == f"{kind} {parameter}"]
            ends = [of["true"].min(), of["true"].max()]
            found = Series(of["true"], of["mean"], kind="points", low=list(of["low"]), high=list(of["high"]))
            marks = [Series(ends, ends, colour=QUIET), found]
            charts.append(Chart(f"{kind}-{parameter}", f"{kind} of {parameter}", marks, "true", "calibrated"))
    save(draw_charts(charts), path)


def run(config: CalibrationConfig) -> pd.DataFrame:
    """Run the sets that the folder lacks, sum all of them up, and return their rows."""
    check_packages()
    from izoo.drivers.mcmc import SamplerConfig

    chains, out = SamplerConfig(config.warmup, config.draws), Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    columns = (*SETTINGS, "name", "converged", *NUMBERS)
    kept = RowsFile(out / SETS_FILE, columns, ("name",), ("set", "drivers", "warmup", "draws")).read()
    settings = config.drivers, config.speed_noise_mps, config.warmup, config.draws, MODEL_VERSION

    def make(_: Key, number: int) -> list[Row]:
        return recover(number, config.drivers, chains, config.speed_noise_mps)

    rows = pd.DataFrame(kept.fill(SETTINGS, {(number, *settings): number for number in range(config.sets)}, make))
    for last in rows.drop_duplicates("set").to_dict("records"):
        said = "chains that do not move"
        if pd.notna(last["worst_r_hat"]) and pd.notna(last["least_ess"]):
            said = f"worst R-hat {last['worst_r_hat']:.3f}, least ESS {last['least_ess']:.0f}"
        print(f"set {last['set']}: {last['seconds']:.0f} s, {said}{'' if last['converged'] else ', not converged'}")
    print(summarise(rows))
    draw(rows, out / "recovery.png")
    return rows


COMMAND = OptionCommand(
    name="benchmarks.calibration",
    summary="Simulate drivers that are known, calibrate on them, and say how often the truth is found.",
    examples=("izoo.benchmarks.calibration out=FOLDER", "izoo.benchmarks.calibration out=FOLDER sets=5 drivers=30"),
    config="izoo.benchmarks.calibration:CalibrationConfig",
    work="izoo.benchmarks.calibration:run",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
