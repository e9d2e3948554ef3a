"""A summary reads the same on a terminal, in Markdown and in HTML."""

import html
import io
import re

import pytest
from rich.console import Console

from izoo.metrics.cell import Cell
from izoo.metrics.figures import FIGURES
from izoo.metrics.summary import summarise
from izoo.report import tables
from izoo.report.plots import forest
from izoo.report.tables import SLOWER, Row, Table
from tests.report.made_tables import SEVERAL, table


def printed(shown: Table, width: int = 80) -> str:
    out = io.StringIO()
    Console(file=out, width=width).print(shown.rich(width))
    return out.getvalue()


def words(text: str) -> list[str]:
    """Numbers and words of a text, in order."""
    return re.findall(r"[\w.]+", text)


@pytest.mark.parametrize("policies", [SEVERAL, {"ppo": (0.06, -1.0, 4)}])
def test_three_media_agree(policies: dict) -> None:
    summary = summarise(table(policies), trained_on=table(policies))
    for shown in (tables.headline(summary), tables.gaps(summary), *tables.details(summary)):
        page = html.unescape(re.sub("<[^>]+>", " ", shown.html().replace("</tr>", "\n")))
        marked = shown.markdown().replace("\\", "")
        for row in shown.rows:
            for cell in row.cells:
                for part in [cell.number, cell.interval] if isinstance(cell, Cell) else [cell]:
                    assert part in page and part in marked
        wide = printed(shown, 400)
        assert words(wide.split("\n", 1)[1]) == [w for w in words(marked) if w != "---"]


def test_the_headline_fits_a_terminal_of_80_columns() -> None:
    for policies in (SEVERAL, {"measured_search": (0.06, -1.0, 1)}):
        summary = summarise(table(policies))
        shown = tables.headline(summary)
        text = printed(shown)
        assert all(len(line) <= 80 for line in text.splitlines()) and "\u2026" not in text
        assert len(policies) > 1 or len(shown.rows) <= 6
        for row in shown.rows:
            assert all(cell.number in text and cell.interval in text for cell in row.cells if isinstance(cell, Cell))


@pytest.mark.parametrize(
    ("policies", "headings"),
    [({"ppo": (0.06, -1.0, 1)}, ("CO2 saved", "delay added")), (SEVERAL, ("ppo", "glide", "cap_0.6"))],
)
def test_several_cities_have_a_row_each(policies: dict, headings: tuple[str, ...]) -> None:
    made = table(policies)
    assert summarise(made)["cities"] == {}
    east = made["context_id"].astype(int) < 8  # places 0 and 4 of them are saturated, as is place 8
    summary = summarise(made.assign(city=east.map({True: "east", False: "west"})))
    shown = tables.cities(summary)
    assert shown.columns == ("city", "unsaturated intersections", *headings)
    assert [(row.label, row.cells[0]) for row in shown.rows] == [("east", "6"), ("west", "3")]
    first = shown.rows[0].cells[1]
    assert isinstance(first, Cell) and first.value == pytest.approx(6.0, abs=1.5) and first.interval
    out = io.StringIO()
    tables.print_summary(summary, console=Console(file=out, width=80))
    assert "east" in out.getvalue() and "east" in tables.markdown(summary)


def test_slower_entries_stand_apart_and_the_best_comes_first() -> None:
    shown = tables.headline(summarise(table(SEVERAL)))
    (_, first), (heading, slower) = shown.groups
    assert [row.label for row in first[:2]] == ["ppo (4 seeds)", "glide"]
    assert heading.startswith("slower") and [row.label for row in slower] == ["cap_0.6"]
    assert first[0].cells[0].value == pytest.approx(6.0, abs=0.3)  # type: ignore[union-attr]


def test_generalisation_gaps_are_shown_where_training_contexts_were_played() -> None:
    test, training = table({"ppo": (0.03, 0.0, 4), "glide": (0.02, 0.0, 1)}), table({"ppo": (0.06, 0.0, 4)})
    summary, out = summarise(test, trained_on=training), io.StringIO()
    tables.print_summary(summary, console=Console(file=out, width=80))
    line = next(line for line in out.getvalue().split("Generalisation gap")[1].splitlines() if "ppo" in line)
    assert re.fullmatch(r" *ppo +\+6\.\d % \[.+\] +\+3\.\d % \[.+\] +\+3\.\d points \[.+\] *", line)
    assert "Generalisation gap" in tables.markdown(summary) and "glide" not in tables.gaps(summary).markdown()
    assert "Generalisation gap" not in tables.markdown(summarise(test))


def test_the_console_ends_with_the_verdict_and_verbose_shows_every_figure() -> None:
    summary = summarise(table(SEVERAL))
    out = io.StringIO()
    tables.print_summary(summary, console=Console(file=out, width=80))
    assert " ".join(out.getvalue().split()).endswith(summary["verdict"])
    assert FIGURES["jerk_mps3"].label not in out.getvalue()
    tables.print_summary(summary, verbose=True, console=Console(file=out, width=200))
    assert all(figure.label in out.getvalue() for figure in FIGURES.values())
    assert "p (Holm)" in out.getvalue() and "median" in out.getvalue()


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (Cell(2.14, 1.0, 3.24, "%", 1, True), "+2.1 % [1.0, 3.2]"),
        (Cell(-0.04, unit="s", signed=True), "0.0 s"),
        (Cell(None, unit="%"), "-"),
        (Cell(12.345, digits=2), "12.35"),
    ],
)
def test_how_numbers_are_written(cell: Cell, text: str) -> None:
    assert str(cell) == text


def test_names_are_shown_as_they_are() -> None:
    name = "[red]a|b[/red] <script> *x* \x1b[2J"
    shown = Table(name, ("entry", "value"), (("", (Row(name, (Cell(1.0),)),)),))
    text = printed(shown, 200)
    assert "[red]a|b[/red]" in text and "\x1b" not in text
    assert "<script>" not in shown.html() and "<script>" in html.unescape(shown.html())
    assert "a\\|b" in shown.markdown() and "\\*x\\*" in shown.markdown()


def test_a_chart_names_slower_entries() -> None:
    groups = (("", (Row("ppo", (Cell(4.0),)),)), (SLOWER, (Row("cap_0.6", (Cell(6.7),)),)))
    assert forest(Table("", ("entry", "CO2 saved"), groups)).rows == ["ppo", "cap_0.6, slower"]


@pytest.mark.parametrize(("widest", "whole"), [(1.5, True), (24.0, False)])
def test_one_wide_interval_does_not_squash_a_chart(widest: float, whole: bool) -> None:
    values = {"ppo": (4.0, 0.5), "mappo": (3.0, 0.6), "ddpg": (1.0, widest), "glide": (9.0, None)}
    rows = [(name, Cell(v) if w is None else Cell(v, v - w, v + w)) for name, (v, w) in values.items()]
    reach = forest(Table.of("", ("entry", "CO2 saved"), rows)).x_range
    assert reach is None if whole else reach == pytest.approx((-0.45, 9.45))
