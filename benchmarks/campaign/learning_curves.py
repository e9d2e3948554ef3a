"""Cost and savings of a part's training runs, in a table that stays when their folders are deleted."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.files import reading, write_text
from izoo.report import plots
from izoo.report.report_data import TRAIN_FOLDER
from izoo.report.tables import SAVED, Table
from izoo.training import run_folder
from izoo.training.loggers import MetricsTable
from izoo.training.plots import PALETTE, Chart, Line, Series, band
from izoo.training.validation import VALIDATION_FILE

LEARNING_FILE = "learning.csv"
RUN = ["entry", "train_seed"]
DRAWN = {SAVED: ("CO2 saved (%)", (-10.0, 100.0)), plots.DELAY: ("delay added (s)", (-100.0, 20.0))}
"""Figures of the curves, and beyond which values they are cut off: one bad run would hide all others."""
COSTS = {"decisions": ",.0f", "simulated_h": ",.0f", "core_h": ",.2f"}
"""Columns of what a run has spent, and how they are written."""
AGAINST = {"decisions": "decisions", "core_h": "core-hours"}
DASHES = ("-", "--", ":", "-.")
TYPES: dict[str, type] = {"entry": str, "train_seed": int, **dict.fromkeys((*COSTS, *DRAWN), float)}
"""Of the columns of the table."""


def update_learning(folder: Path) -> pd.DataFrame:
    """Bring the table of a part up to date, and return it: what training runs had cost and saved at each validation.

    Rows of deleted runs are kept; rows of existing runs are replaced.

    Returns:
        A row per run and validation, and one for a run's end, in order: ``entry``, ``train_seed``, ``decisions``,
        ``simulated_h`` and ``core_h`` (processor time of training and validations) so far, and the figures of
        :data:`DRAWN`, which are missing where a run ended without a validation. What a run did not record is missing.
    """
    path, table = folder / LEARNING_FILE, pd.DataFrame(columns=list(TYPES))
    if path.exists():
        missing = {name: [""] for name, kind in TYPES.items() if kind is float}
        with reading(path):
            table = pd.read_csv(path, dtype=TYPES, keep_default_na=False, na_values=missing)[list(TYPES)]
    files = sorted((folder / TRAIN_FOLDER).glob(f"*/seed*/{run_folder.METRICS_FILE}"))
    found = [_learned(file.parent) for file in files if file.parent.name.removeprefix("seed").isdecimal()]
    if not any(map(len, found)):
        return table
    new = pd.concat(found)
    gone = ~pd.MultiIndex.from_frame(table[RUN]).isin(pd.MultiIndex.from_frame(new[RUN]))
    table = pd.concat([each for each in (table[gone], new) if len(each)]).sort_values(RUN, kind="stable")
    write_text(path, table.to_csv(index=False, float_format="%.10g"))
    return table


def _learned(run: Path) -> pd.DataFrame:
    """Return the rows of a training run."""
    hours = run_folder.read_config(run).env.horizon_s / 3600.0
    measured, validated = (MetricsTable.read(run / name) for name in (run_folder.METRICS_FILE, VALIDATION_FILE))
    last = measured.series("seconds")[0][-1:]
    at = sorted({*validated.series(SAVED)[0], *last})

    def until(column: str, summed: bool, unit: float = 1.0) -> list[float]:
        frames, values = measured.series(column)
        return list(np.interp(at, frames, np.cumsum(values) if summed else values) * unit) if frames else [np.nan]

    figures = {name: dict(zip(*validated.series(name), strict=True)) for name in DRAWN}
    columns = {
        "entry": [run.parent.name],
        "train_seed": [int(run.name.removeprefix("seed"))],
        "decisions": until("decisions", summed=True),
        "simulated_h": until("episodes", summed=False, unit=hours),
        "core_h": until("processor_s", summed=True, unit=1.0 / 3600.0),
        **{name: [values.get(frames, np.nan) for frames in at] for name, values in figures.items()},
    }
    return pd.DataFrame({name: np.broadcast_to(np.array(values), len(at)) for name, values in columns.items()})


def costs(table: pd.DataFrame) -> Table:
    """Return what training cost, a row per entry, mean over its runs."""
    rows = []
    for name, runs in table.groupby(RUN, sort=False).tail(1).groupby("entry", sort=False):
        spent = [(runs[column].mean(skipna=False), form) for column, form in COSTS.items()]
        rows.append((str(name), len(runs), *("-" if np.isnan(value) else f"{value:{form}}" for value, form in spent)))
    title = "Cost of a training run; core-hours are processor time while it trained"
    return Table.of(title, ("entry", "runs", "decisions", "simulated hours", "core-hours"), rows)


@dataclass(frozen=True)
class _Look:
    """How an entry is drawn, and in the charts of which value of the third factor; ``None``: in all."""

    colour: str
    dash: str
    panel: Any = None


def _look(number: int, dash: int | None = None, panel: Any = None) -> _Look:
    """Return the look of a number; where colours run out, they come again with other dashes."""
    again, colour = divmod(number, len(PALETTE))
    return _Look(PALETTE[colour], DASHES[(again if dash is None else dash) % len(DASHES)], panel)


def _looks(names: Sequence[str], factors: Sequence[Sequence[Any]]) -> dict[str, _Look]:
    """Return the looks of entries; those that combine no values of the factors get colours of their own."""
    looks = {}
    for values in itertools.product(*factors) if factors else ():
        numbers = [of.index(value) for of, value in zip(factors, values, strict=True)]
        dash, panel = (numbers[1] if len(values) > 1 else None), (values[2] if len(values) > 2 else None)
        looks["-".join(map(str, values))] = _look(numbers[0], dash, panel)
    others = [name for name in names if name not in looks]
    first = len(factors[0]) if factors else 0
    return looks | {name: _look(first + number) for number, name in enumerate(others)}


def draw_curves(table: pd.DataFrame, grid: Mapping[str, Mapping[str, Any]] | None = None) -> list[Chart]:
    """Return charts of what validations found: a line per entry, with a band over its training seeds.

    Args:
        table: of :func:`update_learning`.
        grid: values of each factor by name. Of entries that combine them, the first factor's value says the colour, the
            second one's the dashes, and the third one's the chart; other entries stand in every chart. Without a grid,
            charts against core-hours are added.
    """
    factors = [list(values) for values in (grid or {}).values()]
    looks = _looks(list(dict.fromkeys(table["entry"])), factors)
    panels = factors[2] if len(factors) > 2 else [None]
    drawn = itertools.product(["decisions"] if factors else AGAINST, panels, DRAWN)
    charts = [_chart(table, looks, cost, panel, column) for cost, panel, column in drawn]
    return [chart for chart in charts if chart.series]


def _chart(table: pd.DataFrame, looks: Mapping[str, _Look], cost: str, panel: Any, column: str) -> Chart:
    """Return the chart of a figure against a cost, for a value of the third factor or for all; it may be empty."""
    label, limits = DRAWN[column]
    series: list[Series] = []
    for name, runs in table.dropna(subset=[cost, column]).groupby("entry", sort=False):
        look = looks[str(name)]
        if look.panel in (None, panel):
            lines = [(run[cost].to_numpy(float), run[column].to_numpy(float)) for _, run in runs.groupby("train_seed")]
            shown = str(name) if panel is None else str(name).removesuffix(f"-{panel}")
            series += _marks(lines, shown, look.colour, look.dash)
    values = np.concatenate([np.ravel(one.y) for one in series] or [np.zeros(0)])
    known = values[(limits[0] < values) & (values < limits[1])]
    ends = (max(known.min() - 0.5, limits[0]), min(known.max() + 0.5, limits[1])) if len(known) else None
    place = "-".join([column, *([] if panel is None else [str(panel)]), *([] if cost == "decisions" else [cost])])
    title = label if panel is None else f"{label}, {panel}"
    return Chart(place, title, series, AGAINST[cost], y_range=ends, log_x=True)


def _marks(lines: Sequence[Line], name: str, colour: str, dash: str) -> list[Series]:
    between = band(lines)
    if between is None:
        style: dict[str, Any] = {"name": name, "colour": colour, "dash": dash}
        return [Series(x, y, kind="points" if len(x) == 1 else "line", **style) for x, y in lines if len(x)]
    x, lowest, mean, highest = between
    return [Series(x, mean, name, "band", lowest, highest, colour), Series(x, mean, name, colour=colour, dash=dash)]
