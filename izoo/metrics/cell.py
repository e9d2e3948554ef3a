"""Numbers as they are shown: with their unit, their interval, and as many digits as mean something."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from izoo.metrics.figures import Figure


@dataclass(frozen=True)
class Cell:
    """A number as tables and sentences show it.

    Attributes:
        value: what is shown; ``None``: nothing is known.
        low, high: ends of its interval; ``None``: it has none.
        unit, digits: how it is written.
        signed: whether a gain has a plus.
        note: what stands in the place of an interval.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    digits: int = 1
    signed: bool = False
    note: str = ""

    @classmethod
    def of(cls, found: Mapping[str, Any], figure: Figure, unit: str | None = None) -> Cell:
        """Return an estimate (:class:`izoo.metrics.statistics.Estimate`) as plain values, in the unit of its figure."""
        ends = found["value"], found.get("low"), found.get("high")
        return cls(*ends, figure.unit if unit is None else unit, figure.digits, figure.paired)

    @property
    def number(self) -> str:
        """The value with its unit."""
        if self.value is None:
            return "-"
        text = self._round(self.value)
        return f"{'+' if self.signed and float(text) > 0 else ''}{text}{self.unit and ' ' + self.unit}"

    @property
    def interval(self) -> str:
        """The ends, or the note, in brackets; empty where there are none."""
        if self.note:
            return f"({self.note})"
        return "" if self.low is None or self.high is None else f"[{self._round(self.low)}, {self._round(self.high)}]"

    def __str__(self) -> str:
        return f"{self.number} {self.interval}".rstrip()

    def _round(self, value: float) -> str:
        return f"{round(value, self.digits) + 0.0:.{self.digits}f}"  # no "-0.0"
