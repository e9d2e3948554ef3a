"""``python -m izoo.drivers calibrate``: a population of human drivers from trajectories of one's own."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from izoo import __version__
from izoo.cli.subcommands import SubcommandCommand, argument
from izoo.console import Progress, survives_lost_output
from izoo.contexts.population import read_population
from izoo.errors import IzooError
from izoo.files import os_reason, write_json

if TYPE_CHECKING:
    from izoo.drivers.estimate import Estimate

EXIT_NOT_CONVERGED = 1
PACKAGES = ("jax", "numpyro")
NOISY, MEMORY = -0.2, 0.3
"""Correlations of consecutive residuals: white noise in the speeds makes -0.5."""


DRIVERS = SubcommandCommand("drivers", "Calibrate a population of human drivers on trajectories.")
main = DRIVERS.main


@DRIVERS.command(
    "estimate the population that drivers in trajectories were drawn from",
    argument("files", type=Path, nargs="+", metavar="FILE", help="trajectories: CSV, or SUMO's XML"),
    argument("--out", type=Path, required=True, metavar="JSON", help="the population; pictures lie beside it"),
    argument("--step-s", type=float, help="use steps of this length; default: 0.5 s where the file allows it"),
    argument("--default-length-m", type=float, help="of all vehicles, where the file does not say it"),
    argument("--heavy-from-m", type=float, default=6.5, help="longer vehicles are heavy; default: 6.5"),
    argument("--max-drivers", type=int, default=200, help="of each class, drawn from more; default: 200"),
    argument("--warmup", type=int, default=200, help="iterations per chain before it counts; default: 200"),
    argument("--draws", type=int, default=400, help="iterations per chain that count; default: 400"),
    argument("--chains", type=int, default=4, help="default: 4"),
    argument("--seed", type=int, default=0, help="of the chains and of --max-drivers; default: 0"),
)
@survives_lost_output()
def calibrate(options: argparse.Namespace) -> int:
    """Calibrate, print, draw and write; return 0, or 1 where the chains did not converge."""
    print(f"izoo {__version__} drivers {options.command}", flush=True)
    check_out(options.out)
    check_packages()
    from izoo.drivers.trajectories import ReadConfig, read_following

    names = ("step_s", "default_length_m", "heavy_from_m", "max_drivers", "seed")
    read_config = ReadConfig(**{name: getattr(options, name) for name in names})
    print(f"reading {', '.join(map(str, options.files))}", flush=True)
    classes, notes = read_following(options.files, read_config)
    for note in notes:
        print(f"note: {note}")
    from izoo.drivers.estimate import estimate, to_content
    from izoo.drivers.mcmc import SamplerConfig
    from izoo.drivers.posterior_figure import draw_estimate

    config = SamplerConfig(options.warmup, options.draws, options.chains, options.seed)
    results = {}
    for name, data in classes.items():
        print(
            f"{name}: {len(data.drivers)} drivers, {data.minutes:.1f} minutes in steps of {data.step_s:g} s", flush=True
        )
        print("compiling the model", flush=True)
        with Progress(100, unit="%") as progress:
            results[name] = estimate(data, config, _in_per_cent(progress))
        print(describe(name, results[name]), flush=True)
    source = f"calibrated by izoo {__version__} on {', '.join(path.name for path in options.files)}"
    content = to_content(results, config, source)
    out = options.out if content["converged"] else not_converged_out(options.out)
    written = [out]
    try:
        write_json(out, content)
        for name, result in results.items():
            png = out.with_suffix(f".{name}.png")
            draw_estimate(result, f"{len(result.data.drivers)} {name} drivers", png)
            written.append(png)
    except OSError as error:
        raise IzooError(f"cannot write {error.filename or out}: {os_reason(error)}; choose another.") from None
    print(f"wrote {', '.join(map(str, written))}")
    for name in ("light", "heavy"):
        if name not in results:
            print(f"{name} drivers: too few in the data; the built-in {name} population stands in the file.")
    if not content["converged"]:
        print(
            "NOT CONVERGED: the file says so and is refused by contexts.drivers. Give --draws and --warmup twice as "
            "much; if that does not help, the data do not fix these numbers: give more drivers, or more braking.",
            flush=True,
        )
        if out != options.out:
            print(f"{options.out} holds drivers of before and stays as it was.", flush=True)
        return EXIT_NOT_CONVERGED
    print(f"drive with it: python -m izoo.train contexts.drivers={options.out}")
    return 0


def check_out(path: Path) -> None:
    """Refuse a place that the result cannot be written to, before any work is done."""
    if path.suffix != ".json":
        raise IzooError(f"--out is {path}; give the name of a file that ends in .json.")
    if path.is_dir() or not path.parent.is_dir():
        raise IzooError(f"--out is {path}, which is a folder or lies in none; give a file in a folder that exists.")


def check_packages() -> None:
    """Raise :class:`IzooError` where the packages of the extra are not installed."""
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise IzooError(f"calibration needs {' and '.join(missing)}: python -m pip install 'izoo[calibrate]'.")


def not_converged_out(path: Path) -> Path:
    """Return where a result that nobody may drive with is written: beside a file that contexts accept, not over it."""
    try:
        read_population(path)
    except IzooError:
        return path
    return path.with_suffix(".not-converged.json")


def describe(name: str, result: Estimate) -> str:
    """Return the result of one class as text: the population, the chains, and the predictive checks."""
    lines = [f"{name} drivers", f"  {'':34} {'mean':>8}  {'90 % interval':>19}  {'R-hat':>6} {'ESS':>6}"]
    for quantity in result.quantities:
        mark = "" if quantity.converged else "  NOT CONVERGED"
        interval = f"{quantity.low:.4g} to {quantity.high:.4g}"
        numbers = f"{quantity.mean:8.4g}  {interval:>19}  {quantity.r_hat:6.3f} {quantity.ess:6.0f}"
        lines.append(f"  {quantity.name:34} {numbers}{mark}")
    correlation = result.predictions.autocorrelation
    draws = result.draws.diverging.size
    lines.append(f"  worst R-hat of a driver {result.driver_r_hat:.3f}; {result.diverging} of {draws} draws diverged")
    held = ", ".join(f"{share:.0%}: {value:.1%}" for share, value in result.predictions.coverage.items())
    lines += [
        "  posterior predictive checks",
        f"    next speeds inside their interval: {held}",
        f"    correlation of consecutive residuals: {correlation:+.2f} (the model says 0){_remark(correlation)}",
        f"    {'driving on behind the leader':36} {'data':>8} {'model':>8}  share of replicas above the data",
    ]
    for check in result.predictions.checks:
        mark = "" if check.reproduced else "  not reproduced"
        numbers = f"{check.observed:8.3g} {check.replicas.mean():8.3g}  {check.share_above:.2f}"
        lines.append(f"    {check.name:36} {numbers}{mark}")
    return "\n".join(lines)


def _remark(correlation: float) -> str:
    """Say what a correlation of consecutive residuals means, where it is far from 0."""
    if correlation < NOISY:
        return "; SPEEDS ARE NOISY: smooth them over a second before, or alpha comes out too large"
    return "; drivers have memory, and intervals are too narrow" if correlation > MEMORY else ""


def _in_per_cent(progress: Progress) -> Callable[[float], None]:
    """Return what takes the share of the work that is done."""
    return lambda share: progress.update(round(100 * share))
