"""One picture of leaderboard files: what each entry saved, by protocol, beside the published figures."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.console import plain
from izoo.files import replacing
from izoo.reporting.drawing import PALETTE, QUIET
from izoo.reporting.published import PUBLISHED, Published

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import FillStyleType

UNTRAINED = "_untrained"
PANELS = (
    ("over_uncommanded", "mean", "CO2 saved over uncommanded vehicles (%)"),
    ("exact", "ratio_of_sums", "benefit over human driving, ratio of sums (%):\nthe paper's form"),
)
"""Part and name of :data:`izoo.evaluation.aggregates.FIGURES`, and what the axis says."""
FORMS: tuple[tuple[str, str, FillStyleType, str], ...] = (
    ("over_uncommanded", "o", "full", "to the stop line"),
    ("region_over_uncommanded", "o", "none", "whole region"),
    ("demand_over_uncommanded", "s", "none", "whole demand"),
)
"""What the first panel draws, one below the other: part, marker, its filling, and what the legend says."""


def draw_standing(merged: Mapping[str, Any], path: Path) -> None:
    """Write :func:`standing` as PNG."""
    with replacing(path) as partial:
        standing(merged).savefig(partial, dpi=150, format="png")


def standing(merged: Mapping[str, Any]) -> Figure:
    """Draw a leaderboard (:func:`izoo.reporting.submissions.merge`), a row of panels per protocol.

    Args:
        merged: the leaderboard; entries without rank are drawn too.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Drawing

    groups = merged["groups"]
    lines = [_in_order([*group["ranked"], *group["marked"]]) for group in groups]
    heights = [len(each) + 1.5 for each in lines]
    figure = Drawing(figsize=(10.0, 0.33 * sum(heights) + 1.3 * len(groups)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(groups), 2, height_ratios=heights, squeeze=False, sharey="row")
    for row, group, entries in zip(axes, groups, lines, strict=True):
        for panel, (part, name, label) in enumerate(PANELS):
            _panel(row[panel], entries, name, FORMS if panel == 0 else ((part, "o", "full", ""),))
            row[panel].set_xlabel(label)
        row[0].set_title(_title(group["protocol"], entries), loc="left", fontsize=10, parse_math=False)
        _published(row[1], group["protocol"], entries)
    return figure


def published_for(protocol: Mapping[str, Any], known: str = "benefit") -> list[Published]:
    """Return the published results for this protocol of which a figure is ``known``, by default the ratio of sums."""
    if protocol["protocol"] == "systematicity":
        return [each for each in PUBLISHED if each.protocol == "Systematicity" and getattr(each, known) is not None]
    train, test = (str(protocol[role] or protocol["train"]).replace("_", " ").title() for role in ("train", "test"))
    wanted = train if train == test else f"{train} -> {test}"
    return [each for each in PUBLISHED if each.protocol == wanted and getattr(each, known) is not None]


def _in_order(lines: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Trained entries first, then what was not trained; each by what it saved over human driving."""

    def key(line: Mapping[str, Any]) -> tuple[bool, bool, float]:
        name = line["policy"]["name"]
        value = line["aggregates"]["all"]["exact"]["mean"]["value"]
        return line["policy"]["kind"] != "trained", name.endswith(UNTRAINED), -(value or 0.0)

    return sorted(lines, key=key)


def _panel(
    axes: Axes, lines: Sequence[Mapping[str, Any]], name: str, forms: Sequence[tuple[str, str, FillStyleType, str]]
) -> None:
    axes.axvline(0.0, color=QUIET, linewidth=0.8)
    for place, line in enumerate(lines):
        colour = PALETTE[0] if line["policy"]["kind"] == "trained" else QUIET
        for k, (part, marker, filling, _) in enumerate(forms):
            shift = 0.24 * (k - 0.5 * (len(forms) - 1))
            _estimate(axes, line, part, name, place + shift, {"color": colour, "marker": marker, "fillstyle": filling})
    axes.set_yticks(range(len(lines)), labels(lines), parse_math=False)
    axes.set_ylim(len(lines) + 0.9, -0.6)  # with room for a legend below
    axes.grid(axis="x", linewidth=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    drawn = [form for form in forms if form[-1] and any(form[0] in line["aggregates"]["all"] for line in lines)]
    for _, marker, filling, said in drawn:
        axes.plot([], [], marker, color=PALETTE[0], fillstyle=filling, label=said)
    if drawn:
        axes.legend(fontsize=7, loc="lower right")


def _estimate(
    axes: Axes, line: Mapping[str, Any], part: str, name: str, place: float, style: Mapping[str, Any]
) -> None:
    """Draw an estimate with its interval; nothing where there is none, as in files from before there was the part."""
    found = line["aggregates"]["all"].get(part, {}).get(name)
    if found is None or found["value"] is None:
        return
    if found["low"] is not None:
        axes.plot([100.0 * found["low"], 100.0 * found["high"]], [place, place], color=style["color"], linewidth=1.2)
    axes.plot([100.0 * found["value"]], [place], linestyle="", markersize=4.5, markerfacecoloralt="white", **style)


def _published(axes: Axes, protocol: Mapping[str, Any], lines: Sequence[Mapping[str, Any]]) -> None:
    """Mark what the paper's algorithms reached, in the rows of their namesakes."""
    said: str | None = "published (other emission networks,\nall approaches, best of 4 seeds)"
    for each in published_for(protocol):
        assert each.benefit is not None
        mine = (each.algorithm.lower(), f"{each.algorithm.lower()}_paper")
        places = [place for place, line in enumerate(lines) if line["policy"]["name"] in mine]
        if places:
            axes.plot([100.0 * each.benefit] * len(places), places, "D", color=PALETTE[1], markersize=5, label=said)
            axes.legend(fontsize=7, loc="lower right")
            said = None


def labels(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what each entry is called; those that share a name are told apart by how long they were trained."""
    policies = [line["policy"] for line in lines]
    names = [plain(str(policy["name"])).replace("_", " ") for policy in policies]
    return [
        f"{name}, {policy['frames']:,} decisions" if names.count(name) > 1 and policy["kind"] == "trained" else name
        for name, policy in zip(names, policies, strict=True)
    ]


def _title(protocol: Mapping[str, Any], lines: Sequence[Mapping[str, Any]]) -> str:
    approaches = _span({line["n"]["approaches"] for line in lines})
    seeds = _span({line["n"]["train_seeds"] for line in lines if line["policy"]["kind"] == "trained"})
    name = str(protocol["protocol"]).replace("_", " ")
    return f"{name}: {plain(protocol['title']).replace('_', ' ')}; {approaches} approaches, training seeds: {seeds}"


def _span(numbers: Collection[int]) -> str:
    least, most = min(numbers, default=0), max(numbers, default=0)
    return str(most) if least == most else f"{least} to {most}"
