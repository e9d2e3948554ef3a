"""The learning curve can be read: labels stand apart, and legends cover no curve."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path

import pytest

from izoo.training.paired import KEPT, SAVED
from izoo.training.plots import PAIRED_PANELS, PANELS, VALIDATION_PANELS, draw_compared, draw_learning_curve
from izoo.training.records import MetricsTable


def table(path: Path, columns: list[str], frames_per_row: int) -> MetricsTable:
    made = MetricsTable(path)
    for k in range(1, 41):
        made.append({"frames": k * frames_per_row, **dict.fromkeys(columns, 0.5 + 0.01 * k)})
    return MetricsTable.read(path)


@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize("frames_per_row", [50, 3_900, 1_234_567])
def test_labels_stand_apart_and_legends_outside(tmp_path: Path, frames_per_row: int, paired: bool) -> None:
    compared = [name for panel in PAIRED_PANELS for name, _ in panel]
    assert compared == [*SAVED.values(), KEPT], "they are the columns of metrics.csv"
    metrics = table(tmp_path / "m.csv", [*(name for name, _ in PANELS), *compared * paired], frames_per_row)
    validated = [name for panel in VALIDATION_PANELS for name, _ in panel]
    figure = draw_learning_curve(metrics, "run", table(tmp_path / "v.csv", validated, frames_per_row))
    figure.canvas.draw()
    assert len(figure.axes) == (8 if paired else 6)
    for axes in figure.axes:
        low, high = axes.get_xlim()
        shown = [
            label for tick, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True) if low <= tick <= high
        ]
        boxes = [label.get_window_extent() for label in shown]
        assert len(boxes) > 2
        assert all(left.x1 + 4 < right.x0 for left, right in itertools.pairwise(boxes)), [s.get_text() for s in shown]
        legend = axes.get_legend()
        assert legend is None or not legend.get_window_extent().overlaps(axes.get_window_extent())
    assert sum(axes.get_legend() is not None for axes in figure.axes) == (4 if paired else 2)


def test_validations_have_their_intervals(tmp_path: Path) -> None:
    metrics = table(tmp_path / "m.csv", [name for name, _ in PANELS], 50)
    validated = MetricsTable(tmp_path / "v.csv")
    plain = dict.fromkeys((name for panel in VALIDATION_PANELS for name, _ in panel), 0.1)
    validated.append({"frames": 500, **plain})
    validated.append({"frames": 1000, **plain, "benefit_low": 0.02, "benefit_high": 0.15})
    figure = draw_learning_curve(metrics, "run", validated)
    lines = [segment for axes in figure.axes for part in axes.collections for segment in part.get_segments()]
    assert [segment.tolist() for segment in lines] == [[[1000.0, 2.0], [1000.0, 15.0]]]


def test_several_runs_of_a_choice_are_a_band_and_their_mean(tmp_path: Path) -> None:
    """Constant returns -1, -2 and -6; the third run has come half as far, and a fourth has not begun."""
    tables = []
    for number, (value, batches) in enumerate([(-1.0, 40), (-2.0, 40), (-6.0, 20), (0.0, 0)]):
        made = MetricsTable(tmp_path / f"{number}.csv")
        for k in range(1, batches + 1):
            made.append({"frames": 100 * k, "return": value, "emission_g_per_vehicle": 80.0})
        tables.append(made)
    figure = draw_compared({"ppo": tables, "ddpg": tables[:1]}, "training")
    panel = figure.axes[0]
    (area,) = panel.collections
    corners = area.get_paths()[0].vertices
    assert (corners[:, 1].min(), corners[:, 1].max()) == (-6.0, -1.0)
    mean, single = panel.lines
    assert mean.get_ydata() == pytest.approx([-3.0] * 100) and single.get_ydata() == pytest.approx([-1.0] * 33)
    assert mean.get_xdata()[-1] == corners[:, 0].max() == 2000.0, "as far as all of them have come"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ppo, 3 runs", "ddpg"]


def test_long_names_of_choices_leave_room_for_the_panels(tmp_path: Path) -> None:
    made = table(tmp_path / "m.csv", ["return", "emission_g_per_vehicle"], 50)
    figure = draw_compared({f"a{'x' * 300}1": [made], f"a{'x' * 300}2": [made], "short": [made]}, "sweep")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        figure.canvas.draw()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [(name[0], name[-1], len(name)) for name in names] == [("a", "1", 40), ("a", "2", 40), ("s", "t", 5)]
    assert all(axes.get_window_extent().width > 0.2 * figure.bbox.width for axes in figure.axes)
