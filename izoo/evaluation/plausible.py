"""Whether the cells of an evaluation table can be what an evaluation wrote: whatever they hold would be summed up."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS

_FINITE = sys.float_info.max
_NOT_NEGATIVE = (0.0, _FINITE)
_ANY = (-_FINITE, _FINITE)
SIGNED = ("return", "reward_sum")
"""Metrics of an episode that may be negative; the others, and all of an approach, are counts and sums of lengths."""
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(APPROACH_METRICS, _NOT_NEGATIVE),
    **{f"episode_{name}": _ANY if name in SIGNED else _NOT_NEGATIVE for name in EPISODE_METRICS},
    **dict.fromkeys(("lane_count", "lane_length_m", "speed_limit_mps", "flow_vph_per_lane", "cycle_s"), _NOT_NEGATIVE),
    "volume_over_capacity": (0.0, float("inf")),  # of an approach without green
    "green_share": (0.0, 1.0),
    "grade": _ANY,
    "adoption": (0.0, 1.0),
    "temperature_c": (-273.15, _FINITE),
    "humidity_pct": (0.0, 100.0),
}
"""Between which values the numbers of a table lie, both ends included; none of them may be missing or NaN."""
NAMED = ("policy", "context", "context_hash", "intersection", "approach")
"""Texts that no row can do without."""
ROW_KEY = ("policy", "context_hash", "seed", "approach")


def check_cells(table: pd.DataFrame, where: Path, text: Sequence[str], whole: Sequence[str], first: int = 2) -> None:
    """Raise :class:`IzooError` naming the first cell that no evaluation writes, or a row that is there twice.

    Args:
        table: as it was read; missing cells are ``None`` or NaN.
        where: the file, for messages.
        text, whole: columns of texts and of whole numbers.
        first: the line of the file that the first row stands in.
    """

    def refuse(row: int, column: str, wanted: str) -> IzooError:
        value = table[column].iloc[row]
        place = f"{where}, line {row + first}"
        return IzooError(
            f"{place}: {column} is {str(value)[:40]!r}; it must be {wanted}. The file was damaged or changed; remove "
            "it and evaluate again."
        )

    for column, (low, high) in RANGES.items():
        values = pd.to_numeric(table[column], errors="coerce").to_numpy(float, na_value=np.nan)
        bad = ~((values >= low) & (values <= high))
        if table[column].dtype == object:  # which counts True as 1
            bad |= table[column].map(lambda value: isinstance(value, bool)).to_numpy(bool)
        if bad.any():
            span = "a number" if (low, high) == _ANY else f"a number from {low:g}"
            raise refuse(int(bad.argmax()), column, span if high >= _FINITE else f"{span} to {high:g}")
    for column in (*whole, *text):
        needed = column in NAMED or column == "seed"
        fits = _is_whole if column in whole else _is_text
        kind = "a whole number from 0 to 2^63 - 1" if column in whole else "a text"
        missing = table[column].isna()
        for row, value in enumerate(table[column].tolist()):
            if needed if missing.iloc[row] else not fits(value):
                raise refuse(row, column, kind)
    double = table.duplicated(list(ROW_KEY)).to_numpy()
    if double.any():
        row = int(double.argmax())
        raise IzooError(f"{where}, line {row + first}: the row is there twice; remove the file and evaluate again.")


def _is_whole(value: Any) -> bool:
    """Whether a cell is a whole number, or the digits of one, that a table can hold."""
    if isinstance(value, str):
        return value.isdecimal() and value.isascii() and len(value) < 20 and int(value) < 2**63
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _is_text(value: Any) -> bool:
    return isinstance(value, str)
