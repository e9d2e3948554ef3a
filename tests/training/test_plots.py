"""Learning curves: what is drawn of a run and of several, and that labels and legends can be read."""

from pathlib import Path

import pytest

from izoo.metrics.figures import FIGURES
from izoo.training.loggers import MetricsTable
from izoo.training.plots import COMPARED, curves, draw


def table(path: Path, columns: list[str], frames_per_row: int) -> MetricsTable:
    made = MetricsTable(path)
    for k in range(1, 41):
        made.append({"frames": k * frames_per_row, **dict.fromkeys(columns, 0.5 + 0.01 * k)})
    return MetricsTable.read(path)


def test_validations_come_first_with_their_intervals(tmp_path: Path) -> None:
    metrics = table(tmp_path / "m.csv", ["return"], 50)
    validated = MetricsTable(tmp_path / "v.csv")
    validated.append({"frames": 500, "co2_saved": 1.0, "unserved": 3.0})
    validated.append({"frames": 1000, "co2_saved": 10.0, "unserved": 3.0, "co2_saved_low": 2.0, "co2_saved_high": 15.0})
    charts = curves({"run": [(metrics, validated)]})
    assert [chart.name for chart in charts] == ["curve-validation-co2-saved", "curve-return"]
    assert FIGURES["co2_saved"].label in charts[0].title and charts[0].alt.endswith("run ends at 10.")
    (axes, _) = draw(charts).axes
    segments = [segment.tolist() for part in axes.collections for segment in part.get_segments()]
    assert segments == [[[1000.0, 2.0], [1000.0, 15.0]]]
    several = curves({"run": [(metrics, validated), (metrics, validated)]})[0]
    assert all(series.low is None for series in several.series if series.kind == "line"), "a band says it"


def test_the_steps_of_imitation_are_shaded(tmp_path: Path) -> None:
    metrics = MetricsTable(tmp_path / "m.csv")
    for k in range(1, 11):
        metrics.append({"frames": 100 * k, "return": -1.0, **({"loss_imitation": 2.0} if k < 4 else {})})
    figure = draw(curves({"run": [(metrics, None)]}))
    assert figure.axes[0].patches[0].get_extents().transformed(figure.axes[0].transData.inverted()).x1 == 300.0
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["imitation", "run"]


def test_several_runs_of_a_choice_are_a_band_and_their_mean(tmp_path: Path) -> None:
    """Constant returns -1, -2 and -6; the third run has come half as far, and a fourth has not begun."""
    tables = []
    for number, (value, batches) in enumerate([(-1.0, 40), (-2.0, 40), (-6.0, 20), (0.0, 0)]):
        made = MetricsTable(tmp_path / f"{number}.csv")
        for k in range(1, batches + 1):
            made.append({"frames": 100 * k, "return": value, "emission_g_per_vehicle": 80.0})
        tables.append(made)
    choices = {"ppo": [(made, None) for made in tables], "ddpg": [(tables[0], None)]}
    first, _ = curves(choices, COMPARED)
    (area,) = (series for series in first.series if series.kind == "band")
    assert (min(area.low), max(area.high)) == (-6.0, -1.0)  # type: ignore[arg-type]
    mean, single = (series for series in first.series if series.kind == "line" and not series.faint)
    assert list(mean.y) == pytest.approx([-3.0] * 100) and list(single.y) == pytest.approx([-1.0] * 40)  # type: ignore[arg-type]
    assert list(mean.x)[-1] == list(area.x)[-1] == 2000.0, "as far as all of them have come"  # type: ignore[arg-type]
    figure = draw([first])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ppo", "ddpg"]


def test_running_means_are_over_a_fifth_of_the_values(tmp_path: Path) -> None:
    made = MetricsTable(tmp_path / "m.csv")
    for k in range(10):
        made.append({"frames": k + 1, "return": float(k)})
    (chart,) = curves({"run": [(made, None)]})
    assert list(chart.series[0].y) == [0.0, *(k - 0.5 for k in range(1, 10))]  # type: ignore[arg-type]
