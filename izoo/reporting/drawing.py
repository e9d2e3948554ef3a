"""What the figures of a report share: their form, colours, axes and words."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from izoo.evaluation.policies import UNCOMMANDED
from izoo.reporting.scored import Scored

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f4fa0", "#8c564b")
"""Okabe and Ito's colours, which colour-blind readers can tell apart, and two more."""
QUIET = "#8a8f98"


@dataclass(frozen=True)
class Figure:
    """A figure of the page.

    Attributes:
        name: its place in the page, ``[a-z0-9-]``.
        title: above it; may be empty.
        caption: under it.
        alt: what it shows, in words, for those who do not see it.
        data, layout: for plotly.js; text in them is already escaped.
        height_px: of the figure.
    """

    name: str
    title: str
    caption: str
    alt: str
    data: list[dict[str, Any]]
    layout: dict[str, Any]
    height_px: int = 320


def colours(scored: Sequence[Scored]) -> dict[str, str]:
    """Return a colour per policy; weights before training have that of the trained ones, the uncommanded CV is grey."""
    families = {s.name: s.name.removesuffix("_untrained") for s in scored if s.entry.policy != UNCOMMANDED}
    found = {family: PALETTE[k % len(PALETTE)] for k, family in enumerate(dict.fromkeys(families.values()))}
    return {s.name: found.get(families.get(s.name, ""), QUIET) for s in scored}


def axis(title: str, **options: Any) -> dict[str, Any]:
    """Return an axis with its title and further ``options`` of plotly.js."""
    return {"title": {"text": escaped(title)}, "zeroline": False, "automargin": True, **options}


def error_bars(estimates: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the intervals of estimates (fractions) as error bars in %."""
    above = [in_percent(_minus(e["high"], e["value"])) for e in estimates]
    below = [in_percent(_minus(e["value"], e["low"])) for e in estimates]
    return {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1.6, "width": 4}


def in_percent(value: float | None) -> float | None:
    """Return a fraction in %; ``None`` stays."""
    return None if value is None else round(100.0 * value, 4)


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def in_words(estimate: dict[str, Any]) -> str:
    """Return an estimate (a fraction) with its n."""
    return "unknown" if estimate["value"] is None else f"{100.0 * estimate['value']:.1f} % (n = {estimate['n']})"


def escaped(text: str) -> str:
    """Escape what plotly.js would otherwise read as markup."""
    return html.escape(text, quote=False)
