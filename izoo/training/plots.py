"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from izoo.training.records import MetricsTable

PANELS = (
    ("return", "return per episode"),
    ("emission_g_per_vehicle", "CO2 per vehicle, g"),
    ("throughput_veh_per_episode", "vehicles through per episode"),
    ("stopped_time_s_per_vehicle", "stopped time per vehicle, s"),
)
VALIDATION_PANELS = (
    (("benefit", "benefit over human driving"), ("benefit_over_uncommanded", "benefit over uncommanded CVs")),
    (("throughput_kept", "approaches that kept their throughput"),),
)
SMOOTHING_POINTS = 20


def learning_curve(table: MetricsTable, path: Path, title: str, validation: MetricsTable | None = None) -> None:
    """Draw return, emission, throughput and stopped time against environment steps, and save it as PNG.

    Thin lines are single batches; thick ones their running mean over a fifth of the points, at most 20. Where the run
    has validated, two more panels show the benefit and the share of approaches that kept their throughput.
    """
    validated = validation is not None and bool(validation.rows)
    figure = Figure(figsize=(14 if validated else 10, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    grid = figure.subplots(2, 3 if validated else 2)
    if validated:
        _validation_panels(list(grid[:, 2]), validation)  # type: ignore[arg-type]
    for axes, (name, label) in zip(grid[:, :2].flat, PANELS, strict=True):
        frames, values = table.series(name)
        axes.plot(frames, values, color="tab:blue", alpha=0.3, linewidth=1)
        axes.plot(frames, _running_mean(values), color="tab:blue", linewidth=2)
        axes.set_xlabel("environment steps")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    partial = path.with_suffix(".partial")
    figure.savefig(partial, format="png", dpi=110)
    partial.replace(path)


def _validation_panels(panels: list[Axes], table: MetricsTable) -> None:
    for axes, columns in zip(panels, VALIDATION_PANELS, strict=True):
        for (name, label), colour in zip(columns, ("tab:green", "tab:gray"), strict=False):
            frames, values = table.series(name)
            axes.plot(frames, [100.0 * value for value in values], "o-", markersize=4, color=colour, label=label)
        axes.set_xlabel("environment steps")
        axes.set_ylabel("validation, %")
        axes.legend()
        axes.grid(alpha=0.3)
    best = [int(row["frames"]) for row in table.rows if row.get("best") == "1"]
    if best:
        panels[0].axvline(best[-1], color="tab:green", alpha=0.3, linestyle="--")


def _running_mean(values: list[float]) -> list[float]:
    width = max(1, min(SMOOTHING_POINTS, len(values) // 5))
    return [sum(part) / len(part) for end in range(1, len(values) + 1) if (part := values[max(0, end - width) : end])]
