"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from izoo.training.records import MetricsTable

PANELS = (
    ("return", "return per episode"),
    ("emission_g_per_vehicle", "CO2 per vehicle, g"),
    ("throughput_veh_per_episode", "vehicles through per episode"),
    ("stopped_time_s_per_vehicle", "stopped time per vehicle, s"),
)
SMOOTHING_POINTS = 20


def learning_curve(table: MetricsTable, path: Path, title: str) -> None:
    """Draw return, emission, throughput and stopped time against environment steps, and save it as PNG.

    Thin lines are single batches; thick ones their running mean over a fifth of the points, at most 20.
    """
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    for axes, (name, label) in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
        frames, values = table.series(name)
        axes.plot(frames, values, color="tab:blue", alpha=0.3, linewidth=1)
        axes.plot(frames, _running_mean(values), color="tab:blue", linewidth=2)
        axes.set_xlabel("environment steps")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    partial = path.with_suffix(".partial")
    figure.savefig(partial, format="png", dpi=110)
    partial.replace(path)


def _running_mean(values: list[float]) -> list[float]:
    width = max(1, min(SMOOTHING_POINTS, len(values) // 5))
    return [sum(part) / len(part) for end in range(1, len(values) + 1) if (part := values[max(0, end - width) : end])]
