"""Summaries as tables: one model, written for the console, in Markdown and in HTML.

Columns and formats of figures come from :data:`izoo.metrics.figures.FIGURES`; nothing else declares them.
"""

from __future__ import annotations

import dataclasses
import html
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from izoo.console import counted, plain
from izoo.envs import SIMULATORS
from izoo.metrics.cell import Cell
from izoo.metrics.figures import FIGURES, HEADLINE
from izoo.metrics.pairing import BASELINES, HUMAN, UNCOMMANDED
from izoo.metrics.summary import BLOCKS, MIN_EPISODE_SEEDS

FIRST_ROWS = 6
SAVED = HEADLINE[0]
BESIDE = ("unserved",)
"""Levels that stand in the row of an entry; all others are shown on request."""
SLOWER = "slower"
WIDTH = 80
ABREAST = 6
"""Policies that stand side by side in a table of levels."""


@dataclass(frozen=True)
class Row:
    """A row: its label, and a cell or a word per further column."""

    label: str
    cells: tuple[Cell | str, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: above it.
        columns: headings, that of the labels first.
        groups: heading (may be empty) and rows of each group; empty groups are not shown.
    """

    title: str
    columns: tuple[str, ...]
    groups: tuple[tuple[str, tuple[Row, ...]], ...]

    @classmethod
    def of(cls, title: str, columns: Iterable[str], rows: Iterable[Sequence[Any]]) -> Table:
        """Return a table of one group; a row is its label and its cells, and what is no :class:`Cell` becomes text."""
        lines = [Row(str(row[0]), tuple(c if isinstance(c, Cell) else str(c) for c in row[1:])) for row in rows]
        return cls(title, tuple(columns), (("", tuple(lines)),))

    @property
    def rows(self) -> list[Row]:
        """All rows."""
        return [row for _, rows in self.groups for row in rows]

    def first(self, most: int) -> Table:
        """Return the table with its first rows alone."""
        groups, left = [], most
        for heading, rows in self.groups:
            groups.append((heading, rows[: max(left, 0)]))
            left -= len(rows)
        return dataclasses.replace(self, groups=tuple(groups))

    def rich(self, width: int = WIDTH) -> RichTable:
        """Return the table for a terminal; intervals stand below their values where a line would be too long."""
        columns = range(1, len(self.columns))
        texts = [[plain(row.label), *(_text(cell, stacked=False) for cell in row.cells)] for row in self.rows]
        if sum(2 + _width([text[k] for text in texts]) for k in range(len(self.columns)) if texts) > width:
            texts = [[plain(row.label), *(_text(cell, stacked=True) for cell in row.cells)] for row in self.rows]
        headings = list(self.columns)
        if sum(2 + _width([headings[k], *(text[k] for text in texts)]) for k in range(len(headings))) > width:
            for k in columns:
                most = _width([text[k] for text in texts] or [headings[k]])
                headings[k] = "\n".join(
                    textwrap.fill(h, max(most, 1), break_long_words=False) for h in headings[k].split("\n")
                )
        taken = sum(2 + _width([headings[k], *(text[k] for text in texts)]) for k in columns)
        shown = RichTable(title=Text(plain(self.title)), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        shown.padding = (0, 1, 0, 0)
        longest = _width([headings[0], *(text[0] for text in texts)])
        shown.add_column(Text(headings[0]), overflow="fold", min_width=min(longest, max(8, width - taken - 2)))
        for heading in headings[1:]:
            shown.add_column(Text(_text(heading)), justify="right", no_wrap=True)
        found = iter(texts)
        for heading, rows in self.groups:
            if heading and rows:
                shown.add_row(Text(plain(heading), style="italic"))
            for _ in rows:
                shown.add_row(*map(Text, next(found)))
            shown.add_section()
        return shown

    def show(self, console: Console | None = None) -> None:
        """Print the table."""
        console = console or Console()
        console.print(self.rich(console.width))

    def markdown(self) -> str:
        """Return the table in Markdown, without its title."""
        lines = [_line(self.columns), "|---" * len(self.columns) + "|"]
        for heading, rows in self.groups:
            lines += [_line([f"*{_marked(heading)}*", *[""] * (len(self.columns) - 1)])] if heading and rows else []
            lines += [_line([_marked(row.label), *map(str, row.cells)]) for row in rows]
        return "\n".join(lines)

    def html(self) -> str:
        """Return the table in HTML, escaped."""
        head = "".join(f'<th scope="col">{_escaped(heading)}</th>' for heading in self.columns)
        body = ""
        for heading, rows in self.groups:
            if heading and rows:
                body += f'<tr class="group"><th colspan="{len(self.columns)}">{_escaped(heading)}</th></tr>'
            for row in rows:
                cells = "".join(f"<td>{_small(cell)}</td>" for cell in row.cells)
                body += f'<tr><th scope="row">{_escaped(row.label)}</th>{cells}</tr>\n'
        caption = f"<caption>{_escaped(self.title)}</caption>" if self.title else ""
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table>"


def print_summary(summary: Mapping[str, Any], verbose: bool = False, console: Console | None = None) -> None:
    """Print the headline of a summary, with ``verbose`` everything else, and the verdict."""
    console = console or Console()
    first, *others = [*shown_first(summary), *(details(summary) if verbose else [])]
    (first if verbose else first.first(FIRST_ROWS)).show(console)
    if not verbose and len(first.rows) > FIRST_ROWS:
        console.print(f"The first {FIRST_ROWS} of {len(first.rows)} rows; -v shows all.", highlight=False)
    for table in others:
        table.show(console)
    for text in (counts(summary), *cautions(summary), summary["verdict"]):
        console.print(Text(plain(text)))


def markdown(summary: Mapping[str, Any]) -> str:
    """Return everything that :func:`print_summary` prints, in Markdown."""
    parts = []
    for table in [*shown_first(summary), *details(summary)]:
        parts += [f"{_marked(table.title)}:", table.markdown()]
    return "\n\n".join([*parts, *map(_marked, (counts(summary), *cautions(summary), summary["verdict"]))]) + "\n"


def shown_first(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables that are always shown, the headline first."""
    further = {"gaps": gaps, "cities": cities}
    return [headline(summary), *(table(summary) for key, table in further.items() if summary[key])]


def headline(summary: Mapping[str, Any]) -> Table:
    """Return the first table: figures of the only entry, or a row per entry."""
    names = compared(summary)
    if len(names) > 1:
        return entries(summary)
    if not names:
        return Table("No policy beside the baselines", ("figure",), ())
    return _of_entry(summary, names[0], HEADLINE, FIRST_ROWS)


def entries(summary: Mapping[str, Any]) -> Table:
    """Return a row per entry with the main figures of the main block, best first; slower entries stand apart."""
    first, slower = (
        tuple(entry_row(summary, name) for name in ranking(summary) if is_slower(summary, name) == k)
        for k in (False, True)
    )
    title = f"{summary['task'] or 'Entries'}: {summary['block']} intersections, over {UNCOMMANDED} but for one column"
    return Table(title, entry_columns(), (("", first), (SLOWER, slower)))


def ranking(summary: Mapping[str, Any]) -> list[str]:
    """Return the entries by CO2 saved over uncommanded, slower ones last."""

    def place(name: str) -> tuple[bool, float]:
        saved = figure_cell(summary["entries"][name], SAVED, UNCOMMANDED, summary["block"]).value
        return is_slower(summary, name), math.inf if saved is None else -saved

    return sorted(summary["entries"], key=place)


def is_slower(summary: Mapping[str, Any], name: str) -> bool:
    """Whether the delay of an entry is shown to be above that of uncommanded."""
    return bool(summary["entries"][name].get("slower"))


def entry_columns() -> tuple[str, ...]:
    """Headings of :func:`entries`."""
    paired = [FIGURES[f].label for f in HEADLINE if FIGURES[f].paired]
    return (
        "entry",
        *paired,
        f"{FIGURES[SAVED].label}, over {HUMAN}",
        "gain, lose",
        *(FIGURES[f].label for f in BESIDE),
    )


def entry_row(summary: Mapping[str, Any], name: str) -> Row:
    """Return the row of an entry in :func:`entries`."""
    entry, block = summary["entries"][name], summary["block"]
    cells: list[Cell | str] = [figure_cell(entry, f, UNCOMMANDED, block) for f in HEADLINE if FIGURES[f].paired]
    cells += [figure_cell(entry, SAVED, HUMAN, block), _shares(entry, block)]
    label = name + (f" ({entry['train_seeds']} seeds)" if entry.get("train_seeds", 0) > 1 else "")
    return Row(label, (*cells, *(figure_cell(entry, f, UNCOMMANDED, block) for f in BESIDE)))


def gaps(summary: Mapping[str, Any]) -> Table:
    """Return the CO2 saved on training contexts and on test contexts, and how much more it is on the former."""
    figure, rows = FIGURES[SAVED], []
    for name in ranking(summary):
        if name in summary["gaps"]:
            gap, here = (
                summary["gaps"][name],
                figure_cell(summary["entries"][name], SAVED, UNCOMMANDED, summary["block"]),
            )
            rows.append((name, Cell.of(gap["training"], figure), here, Cell.of(gap["gap"], figure, "points")))
    title = f"Generalisation gap, {figure.label} over {UNCOMMANDED}"
    return Table.of(title, ("entry", "training contexts", "test contexts", "gap"), rows)


def cities(summary: Mapping[str, Any]) -> Table:
    """Return a row per city: the main figures of the only entry, or the CO2 that each saves, best first."""
    entries, rows = next(iter(summary["cities"].values())), []
    names = [name for name in ranking(summary) if name in entries][:ABREAST]
    figures = [f for f in HEADLINE if FIGURES[f].paired] if len(names) == 1 else [SAVED]
    for city, entries in summary["cities"].items():
        n = max(entry["intersections"] for entry in entries.values())
        cells = [Cell.of(entries[name]["figures"][f], FIGURES[f]) for name in names for f in figures]
        rows.append((city, n, *cells))
    labels = [FIGURES[f].label for f in figures]
    title, headings = ("By city", labels) if len(names) == 1 else (f"{labels[0]} by city", names)
    return Table.of(f"{title}, over {UNCOMMANDED}", ("city", f"{summary['block']} intersections", *headings), rows)


def details(summary: Mapping[str, Any]) -> list[Table]:
    """Return what the headline leaves out: every figure of every entry, and the differences between entries."""
    tables = [_of_entry(summary, name, tuple(FIGURES)) for name in compared(summary)]
    names = sorted(summary["entries"], key=BASELINES.__contains__)
    tables += [_levels(summary, names[k : k + ABREAST]) for k in range(0, len(names), ABREAST)]
    return [*tables, *([pairwise(summary)] if summary["pairwise"] else [])]


def pairwise(summary: Mapping[str, Any]) -> Table:
    """Return the differences between entries, with p-values after Holm's correction."""
    figure, rows = FIGURES[SAVED], []
    for pair in summary["pairwise"]:
        p = pair["p_holm"]
        shown = "-" if p is None else f"{p:.3f}" if p >= 0.001 else "< 0.001"
        points = Cell.of(pair["difference"], figure, "points")
        rows.append((f"{pair['x']} - {pair['y']}", points, shown, pair["verdict"]))
    title = f"Differences in {figure.label}, {summary['block']} intersections"
    return Table.of(title, ("pair", "difference", "p (Holm)", "verdict"), rows)


def compared(summary: Mapping[str, Any]) -> list[str]:
    """Names of the entries that are no baselines."""
    return [name for name in summary["entries"] if name not in BASELINES]


def counts(summary: Mapping[str, Any]) -> str:
    """Say on what the figures rest."""
    n = summary["n"]
    text = f"{counted(n['contexts'], 'context')} on {counted(n['intersections'], 'intersection')}, "
    text += f"{counted(n['eval_seeds'], 'episode seed')}, {n['episodes']} episodes, "
    text += f"played on {' and '.join(SIMULATORS[name].label for name in summary['simulators'])}. "
    if n["intersections"] == 1:
        text += (
            f"Brackets: 95 % intervals over the {n['eval_seeds']} episode seeds of this intersection (Student's t of "
            f"paired seeds, from {MIN_EPISODE_SEEDS} on); they say nothing of other intersections or training seeds."
        )
    else:
        text += "Interquartile means over intersections; brackets: 95 % intervals."
    if any(entry.get("slower") for entry in summary["entries"].values()):
        text += f" Slower: the delay is shown to be above that of {UNCOMMANDED}."
    if n["left_out"]:
        some, more = ", ".join(n["left_out"][:3]), ", ..." if len(n["left_out"]) > 3 else ""
        text += f" Without demand, and left out: {len(n['left_out'])} ({some}{more})."
    return text


def cautions(summary: Mapping[str, Any]) -> list[str]:
    """Say of which policies figures are in part those of the simulator's driver."""
    shares = {
        name: figure_cell(summary["entries"][name], "nan_share", UNCOMMANDED, "all") for name in compared(summary)
    }
    return [
        f"{name}: {share.number} of its commands were NaN; the simulator drove those vehicles."
        for name, share in shares.items()
        if share.value
    ]


def _of_entry(summary: Mapping[str, Any], name: str, figures: Sequence[str], most: int | None = None) -> Table:
    """Return figures of an entry, over each baseline and as levels, with and without saturation."""
    entry = summary["entries"][name]
    blocks = [b for b in BLOCKS if any(b in of and of[b]["intersections"] for of in entry["against"].values())]
    blocks = [b for b in blocks if b != "all"] or blocks
    paired = [f for f in figures if FIGURES[f].paired]
    against = [b for b in BASELINES if b in entry["against"]]
    rows: list[tuple[str, list[Cell | str]]] = [
        (f"{FIGURES[f].label}, over {b}", [figure_cell(entry, f, b, block) for block in blocks])
        for b in against
        for f in paired
        if most is None or b == against[0] or f == SAVED
    ]
    if most is not None:
        levels = [f for f in figures if not FIGURES[f].paired]
        rows += [(FIGURES[f].label, [_beside(summary, name, f, block) for block in blocks]) for f in levels]
    else:
        for b in against:
            of = entry["against"][b]
            for key in ("mean", "median"):
                label = f"{FIGURES[SAVED].label}, over {b}: {key}"
                rows.append(
                    (label, [Cell.of({"value": of.get(block, {}).get(key)}, FIGURES[SAVED]) for block in blocks])
                )
            label = f"intersections that gain, lose over 1 %, over {b}"
            rows.append((label, [_shares(entry, block, b) for block in blocks]))
    found = [entry["against"][b] for b in against]
    n = [max((of[block]["intersections"] for of in found if block in of), default=0) for block in blocks]
    headings = (f"{block} (n = {number})" for block, number in zip(blocks, n, strict=True))
    task = f" on {summary['task']}" if summary["task"] else ""
    return Table.of(f"{name}{task}", ("figure", *headings), [(label, *cells) for label, cells in rows[:most]])


def _levels(summary: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return the levels of policies side by side, in the main block."""
    figures, entries = [f for f in FIGURES if not FIGURES[f].paired], [summary["entries"][name] for name in names]
    block = summary["block"]
    rows = [(FIGURES[f].label, *(figure_cell(of, f, UNCOMMANDED, block) for of in entries)) for f in figures]
    return Table.of(f"Levels, {summary['block']} intersections", ("figure", *names), rows)


def _beside(summary: Mapping[str, Any], name: str, figure: str, block: str) -> Cell:
    """A level of an entry, with that of the uncommanded CVs."""
    entries = (summary["entries"].get(policy, {}) for policy in (name, UNCOMMANDED))
    own, other = (figure_cell(entry, figure, UNCOMMANDED, block) for entry in entries)
    return dataclasses.replace(own, note="" if other.value is None else f"{UNCOMMANDED} {other.number}")


def figure_cell(entry: Mapping[str, Any], figure: str, baseline: str, block: str) -> Cell:
    """A figure of an entry over a baseline, or its level where it compares with nothing."""
    declared = FIGURES[figure]
    if not declared.paired:
        level = entry.get("levels", {}).get(block, {}).get(figure)
        return Cell(level, unit=declared.unit, digits=declared.digits)
    found = entry["against"].get(baseline, {}).get(block, {}).get("figures", {}).get(figure)
    return Cell(unit=declared.unit) if found is None else Cell.of(found, declared)


def _shares(entry: Mapping[str, Any], block: str, baseline: str = UNCOMMANDED) -> str:
    found = entry["against"].get(baseline, {}).get(block, {})
    shares = [found.get(name) for name in ("gain_share", "lose_share")]
    return "-" if None in shares else ", ".join(f"{100.0 * share:.0f} %" for share in shares)  # type: ignore[operator]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _text(cell: Cell | str, stacked: bool = False) -> str:
    """A cell for a terminal, with its interval below it where they are stacked."""
    text = f"{cell.number}\n{cell.interval}".rstrip() if stacked and isinstance(cell, Cell) else str(cell)
    return "\n".join(plain(line) for line in text.split("\n"))


def _width(texts: Sequence[str]) -> int:
    return max(len(line) for text in texts for line in text.split("\n"))


def _marked(text: str) -> str:
    """Text in which Markdown obeys nothing that somebody wrote into a name."""
    return "".join(f"\\{c}" if c in "\\`*_[]<>|#" else c for c in plain(text))


def _escaped(text: str) -> str:
    return html.escape(plain(text))


def _small(cell: Cell | str) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    return _escaped(cell.number) + (f"<small>{_escaped(cell.interval)}</small>" if cell.interval else "")
