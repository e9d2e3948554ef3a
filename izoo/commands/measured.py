"""Rebuilt Salt Lake City beside measured intersections: features, human driving, and signal plans.

The measured intersections are those of a folder of the published dataset. Human driving is simulated with demand from
all approaches at peak, in the published weather, in as many rebuilt intersections as there are measured ones.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from izoo.commands.pictures import check_png
from izoo.contexts.cities import rebuilt as cities
from izoo.contexts.cities.compare import feature_table
from izoo.contexts.cities.copula import FEATURES
from izoo.contexts.cities.weather import WEATHER_PUBLISHED
from izoo.contexts.context import Context
from izoo.contexts.spec import IntersectionSpec
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_range
from izoo.evaluation.runner import evaluate_policy
from izoo.networks.dataset.intersections import load_specs
from izoo.networks.signals.search import plan_delay_s, search_plan

CITY = "salt_lake_city"
SAMPLE_SEED = 1
OUTCOMES = {
    "emission_g_per_vehicle": ("emission_g", "crossed"),
    "emission_g_per_vehicle_step": ("emission_g", "vehicle_steps"),
    "crossed_per_episode": ("crossed", None),
    "travel_time_s": ("travel_time_s", "crossed"),
    "waiting_at_the_end": ("waiting", None),
}
"""Quantities of human driving per approach and episode: numerator and denominator among the metrics."""
CRITICAL = 1.358
"""Times ``sqrt(1/n + 1/m)``: the Kolmogorov-Smirnov distance that equal distributions exceed in 5 % of samples."""


@dataclass(frozen=True)
class Comparison:
    """Values per approach, of measured and of rebuilt intersections, by quantity; and delays of signal plans.

    Attributes:
        intersections: how many were measured, and how many rebuilt ones were simulated.
        quantities: per quantity the measured values ``[n]`` and the rebuilt ones ``[m]``.
        delay_s: ``[I, 2]`` estimated mean delay at peak with the published and with the searched plan.
        search_s: ``[I]`` duration of the search.
    """

    intersections: int
    quantities: Mapping[str, tuple[np.ndarray, np.ndarray]]
    delay_s: np.ndarray
    search_s: np.ndarray


def compare(path: Path, seeds: int = 1, horizon_s: float = 1000.0, num_workers: int = 2) -> Comparison:
    """Compare the measured intersections under ``path`` with rebuilt Salt Lake City.

    Args:
        path: a folder of the published dataset.
        seeds: episodes per intersection.
        horizon_s: length of an episode, warm-up included.
        num_workers: worker processes; 0 simulates in this process.
    """
    check_range("--seeds", seeds, 1, 10**6)
    check_range("--num-workers", num_workers, 0, 1024)
    config = EnvConfig(horizon_s=horizon_s)
    measured, rebuilt = load_specs(path), list(cities.get(CITY))
    if any(spec.source != "dataset" for spec in measured):
        raise IzooError(f"{path} holds no measured intersections; give a folder of the published dataset.")
    tables = feature_table(measured), feature_table(rebuilt)
    # Nets hold limits with two decimals; without rounding, equal ones would differ in the third.
    speed = FEATURES.index("speed_limit_mps")
    for table in tables:
        table[:, speed] = table[:, speed].round(1)
    quantities = {name: (tables[0][:, k], tables[1][:, k]) for k, name in enumerate(FEATURES)}
    generator = np.random.default_rng(SAMPLE_SEED)
    count = min(len(measured), len(rebuilt))
    sample = [rebuilt[int(index)] for index in generator.choice(len(rebuilt), count, replace=False)]
    driven = [_drive(specs, config, seeds, num_workers) for specs in (measured, sample)]
    quantities |= {name: (driven[0][name], driven[1][name]) for name in OUTCOMES}
    delays, durations = zip(*(_plans(spec) for spec in measured), strict=True)
    return Comparison(count, quantities, np.array(delays), np.array(durations))


def _drive(specs: list[IntersectionSpec], config: EnvConfig, seeds: int, num_workers: int) -> dict[str, np.ndarray]:
    """Simulate human driving; return the outcomes per approach, means over seeds."""
    temperature_c, humidity_pct = WEATHER_PUBLISHED[CITY]
    contexts = [
        Context(spec, adoption=0.0, season=None, temperature_c=temperature_c, humidity_pct=humidity_pct)
        for spec in specs
    ]
    contexts = [context for context in contexts if context.demand_approaches]
    table = evaluate_policy("human", contexts, range(seeds), config, num_workers, uncommanded=False)
    table = table[table["flow_vph_per_lane"] > 0.0]
    sums = table.groupby(["context_hash", "approach"])[_columns()].sum()
    return {name: _ratio(sums, *parts, seeds) for name, parts in OUTCOMES.items()}


def _columns() -> list[str]:
    return sorted({name for parts in OUTCOMES.values() for name in parts if name is not None})


def _ratio(sums: pd.DataFrame, numerator: str, denominator: str | None, seeds: int) -> np.ndarray:
    below = sums[denominator].to_numpy(float) if denominator else np.full(len(sums), float(seeds))
    above = sums[numerator].to_numpy(float)
    return above[below > 0.0] / below[below > 0.0]


def _plans(spec: IntersectionSpec) -> tuple[tuple[float, float], float]:
    start = time.perf_counter()
    searched = search_plan(dataclasses.replace(spec, signal_plan=None))
    duration_s = time.perf_counter() - start
    return (plan_delay_s(spec), plan_delay_s(spec, searched)), duration_s


def distance(one: np.ndarray, two: np.ndarray) -> float:
    """Kolmogorov-Smirnov distance: the largest difference between the two cumulative distributions."""
    places = np.union1d(one, two)
    shares = [np.searchsorted(np.sort(values), places, side="right") / len(values) for values in (one, two)]
    return float(np.abs(shares[0] - shares[1]).max())


def noise(one: np.ndarray, two: np.ndarray) -> float:
    """The distance that samples of these sizes from one distribution exceed in 5 % of cases, if independent."""
    return float(CRITICAL * np.sqrt(1.0 / len(one) + 1.0 / len(two)))


def describe(comparison: Comparison) -> str:
    """Return the comparison as a text table."""
    head = f"{'quantity per approach':37}{'n':>5} {'mean':>9} {'10 %':>9} {'50 %':>9} {'90 %':>9}"
    lines = [
        "rebuilt Salt Lake City beside measured intersections; features of all 282, human driving at peak in "
        f"{comparison.intersections}",
        f"{head}   {'distance':>8} {'noise':>6}",
    ]
    for name, (measured, rebuilt) in comparison.quantities.items():
        lines.append(f"{name:28} {'measured':8}{_summary(measured)}")
        end = f"   {distance(measured, rebuilt):8.3f} {noise(measured, rebuilt):6.3f}"
        lines.append(f"{'':28} {'rebuilt':8}{_summary(rebuilt)}{end}")
    published, searched = comparison.delay_s.T
    lines += [
        "distance: Kolmogorov-Smirnov; noise: what equal distributions exceed in 5 % of samples of these sizes",
        f"signal plans of the {len(published)} measured intersections, estimated mean delay at peak (HCM): published "
        f"{published.mean():.1f} s (median {np.median(published):.1f}), searched {searched.mean():.1f} s (median "
        f"{np.median(searched):.1f}); the searched one is no worse in {int((searched <= published + 1e-9).sum())}; "
        f"a search takes {1e3 * np.median(comparison.search_s):.0f} ms (median), "
        f"{1e3 * comparison.search_s.max():.0f} ms at most",
    ]
    return "\n".join(lines)


def _summary(values: np.ndarray) -> str:
    numbers = [values.mean(), *np.quantile(values, (0.1, 0.5, 0.9))]
    return f"{len(values):5} " + " ".join(f"{number:9.4g}" for number in numbers)


def write_csv(comparison: Comparison, path: Path) -> None:
    """Write one line per quantity."""
    rows = []
    for name, (measured, rebuilt) in comparison.quantities.items():
        row: dict[str, object] = {"quantity": name, "measured": len(measured), "rebuilt": len(rebuilt)}
        for kind, values in (("measured", measured), ("rebuilt", rebuilt)):
            row[f"{kind}_mean"] = values.mean()
            row |= {f"{kind}_q{level}": np.quantile(values, level / 100.0) for level in (10, 50, 90)}
        rows.append({**row, "distance": distance(measured, rebuilt), "noise": noise(measured, rebuilt)})
    pd.DataFrame(rows).to_csv(path, index=False, float_format="%.6g")


def write_png(comparison: Comparison, path: Path) -> None:
    """Draw the cumulative distributions."""
    check_png(path)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 6.6), layout="constrained")
    axes = figure.subplots(3, 4).ravel()
    for axis, (name, pair) in zip(axes, comparison.quantities.items(), strict=False):
        for values, label, colour in zip(pair, ("measured", "rebuilt"), ("0.45", "tab:blue"), strict=True):
            axis.ecdf(values, label=label, color=colour, linewidth=1.6)
        axis.set_title(f"{name} (distance {distance(*pair):.2f})", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=100)
