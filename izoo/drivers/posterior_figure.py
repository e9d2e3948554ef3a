"""One picture per class of drivers: what was learnt of the population, and whether it drives as the drivers did."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from izoo.drivers.estimate import Estimate
from izoo.drivers.predictive import Predictions
from izoo.files import replacing

LABELS = (
    "desired speed v0, m/s",
    "standstill gap s0, m",
    "time headway T, s",
    "max. acceleration alpha, m/s²",
    "comfortable deceleration beta, m/s²",
)
DATA, MODEL, FIRM = "#333333", "#0072b2", "#d55e00"
BINS = 30
SHOWN_REPLICAS = 20


def draw_estimate(estimate: Estimate, title: str, path: Path) -> None:
    """Write the picture of one class as PNG."""
    figure = Figure(figsize=(13.0, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    axes = figure.subplots(3, 3)
    for k, label in enumerate(LABELS):
        _parameter(axes.flat[k], estimate, k, label)
    _ranks(axes.flat[5], estimate.predictions)
    _accelerations(axes.flat[6], estimate)
    _drive(axes.flat[7], axes.flat[8], estimate)
    with replacing(path, durable=False) as partial:
        figure.savefig(partial, dpi=100, format="png")


def _parameter(axes: Axes, estimate: Estimate, k: int, label: str) -> None:
    """The drivers' posterior means, and the population that they were drawn from with its uncertainty."""
    drivers = np.exp(estimate.draws.values["x"][..., k].mean(axis=(0, 1)))
    mean, sd = (estimate.draws.values[name][..., k].ravel() for name in ("log_mean", "log_sd"))
    middle, spread = mean.mean(), max(sd.mean(), 0.01)
    low = min(np.log(drivers).min(), middle - 3.0 * spread)
    high = max(np.log(drivers).max(), middle + 3.0 * spread)
    grid = np.exp(np.linspace(low, high, 200))
    step = max(1, len(mean) // 200)
    wide = np.maximum(sd[::step], 0.002)[:, None]
    density = np.exp(-0.5 * ((np.log(grid) - mean[::step, None]) / wide) ** 2) / (grid * wide * np.sqrt(2.0 * np.pi))
    lower, upper = np.quantile(density, [0.05, 0.95], axis=0)
    axes.fill_between(grid, lower, upper, color=FIRM, alpha=0.25, linewidth=0, label="population, 90 %")
    axes.plot(grid, np.median(density, axis=0), color=FIRM, linewidth=1.2)
    top = 1.1 * float(np.quantile(upper, 0.98))
    axes.plot(drivers, np.full(len(drivers), 0.03 * top), "|", color=MODEL, markersize=9, label="drivers")
    axes.set_ylim(0.0, top)
    axes.set(xlabel=label, yticks=[])
    if k == 0:
        axes.legend(fontsize="small")


def _ranks(axes: Axes, predictions: Predictions) -> None:
    axes.hist(predictions.ranks, bins=20, range=(0.0, 1.0), density=True, color=MODEL, alpha=0.35)
    axes.axhline(1.0, color=DATA, linewidth=1.0)
    held = ", ".join(f"{share:.0%} interval holds {value:.0%}" for share, value in predictions.coverage.items())
    axes.set(xlabel="rank of the next speed among its predictions", ylabel="density", title=held)
    axes.title.set_fontsize("small")


def _accelerations(axes: Axes, estimate: Estimate) -> None:
    data, predictions = estimate.data, estimate.predictions
    observed = (data.next_speed_mps - data.speed_mps)[data.used] / data.step_s
    low, high = np.quantile(observed, [0.001, 0.999])
    edges = np.linspace(low, high, BINS + 1)
    axes.hist(observed, bins=edges.tolist(), density=True, histtype="step", color=DATA, label="data")
    both = data.used[:, :-1] & data.continues[:, 1:]
    shown = [
        np.histogram((v[:, 1:] - v[:, :-1])[both] / data.step_s, bins=edges, density=True)[0]
        for v in predictions.speeds
    ]
    lower, upper = np.quantile(shown, [0.05, 0.95], axis=0)
    axes.fill_between(
        edges, [*lower, lower[-1]], [*upper, upper[-1]], step="post", color=MODEL, alpha=0.35, label="model"
    )
    axes.set(xlabel="acceleration, m/s²", yscale="log", ylabel="density")
    axes.legend(fontsize="small")


def _drive(speed: Axes, gap: Axes, estimate: Estimate) -> None:
    """The longest drive behind one leader: recorded, and driven by replicas of that driver."""
    data, predictions = estimate.data, estimate.predictions
    row, first, last = longest_drive(data.used, data.continues)
    time_s = np.arange(last - first) * data.step_s
    pairs = ((speed, data.speed_mps, predictions.speeds), (gap, data.gap_m, predictions.gaps))
    for axes, recorded, replicas in pairs:
        for replica in replicas[:SHOWN_REPLICAS]:
            axes.plot(time_s, replica[row, first:last], color=MODEL, alpha=0.25, linewidth=0.8)
        axes.plot(time_s, recorded[row, first:last], color=DATA, linewidth=1.5, label="recorded")
    speed.plot(
        time_s, data.leader_speed_mps[row, first:last], color=FIRM, linewidth=1.0, linestyle="--", label="leader"
    )
    speed.set(xlabel=f"time of driver {data.drivers[row]}, s", ylabel="speed, m/s")
    gap.set(xlabel="time, s", ylabel="gap, m")
    speed.legend(fontsize="small")


def longest_drive(used: np.ndarray, continues: np.ndarray) -> tuple[int, int, int]:
    """Return the row, the first place and the end of the longest run of steps that continue each other."""
    best = (0, 0, 1)
    for row in range(len(used)):
        starts = [*np.flatnonzero(used[row] & ~continues[row]).tolist(), int(used[row].sum())]
        for first, last in itertools.pairwise(starts):
            if last - first > best[2] - best[1]:
                best = (row, first, last)
    return best
