"""What ``python -m izoo.leaderboard`` does: check leaderboard files, merge them into one, and show them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo import __version__
from izoo.commands.subcommands import Subcommand, SubcommandCommand
from izoo.console import plain
from izoo.errors import IzooError
from izoo.files import os_reason, read_text, write_json

if TYPE_CHECKING:
    from rich.table import Table

EXIT_MARKED = 1
BENEFITS = (("mean benefit,\nexact gate", "exact"), ("over uncommanded,\nno gate", "over_uncommanded"))
"""Columns of a leaderboard: label, and part of :data:`izoo.evaluation.aggregates.FIGURES`."""
FORMS = (("to stop line", ""), ("whole region", "region_"), ("whole demand", "demand_"))
"""Lines of an entry: whose CO2 is counted, and how the parts that do so begin."""


def _validate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", type=Path, nargs="+", help="submissions, or folders that hold some (*.json)")


def _validate(options: argparse.Namespace) -> int:
    """Say what is wrong with each file; return 1 where something was found to mark."""
    checked = _checked(options.files)
    for item in checked:
        _print_checked(item)
    return EXIT_MARKED if any(item.marks for item in checked) else 0


def _merge_arguments(parser: argparse.ArgumentParser) -> None:
    _validate_arguments(parser)
    parser.add_argument("--out", type=Path, default=Path("leaderboard.json"), help="the leaderboard's file")


def _merge(options: argparse.Namespace) -> None:
    checked = _checked(options.files)
    if options.out.exists() and not _is_merged(options.out):  # it would take the place of a submission, perhaps
        raise IzooError(f"{options.out} is there and is no merged leaderboard; choose another file with --out.")
    from izoo.reporting import submissions

    merged = submissions.merge(checked)
    try:
        write_json(options.out, merged)
    except OSError as error:
        raise IzooError(f"cannot write {options.out}: {os_reason(error)}; choose another file with --out.") from error
    _print_leaderboard(merged)
    print(f"Leaderboard: {options.out}", flush=True)


def _is_merged(path: Path) -> bool:
    """Whether a file is what ``merge`` writes, and so no submission."""
    from izoo.reporting.submissions import MERGED_FORMAT

    try:
        return bool(json.loads(read_text(path))["format"] == MERGED_FORMAT)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _draw_arguments(parser: argparse.ArgumentParser) -> None:
    _validate_arguments(parser)
    parser.add_argument("--out", type=Path, default=Path("leaderboard.png"), help="the picture's file, a PNG")
    parser.add_argument("--histograms", action="store_true", help="the paper's histograms, a panel per file")


def _draw(options: argparse.Namespace) -> None:
    if options.out.suffix.lower() != ".png":
        raise IzooError(f"--out is {options.out}, but the picture is a PNG; give a name that ends so, such as all.png.")
    checked = _checked(options.files)
    from izoo.reporting import submissions
    from izoo.reporting.histogram_picture import draw_histograms
    from izoo.reporting.standing import draw_standing

    try:
        if options.histograms:
            draw_histograms(checked, options.out)
        else:
            draw_standing(submissions.merge(checked), options.out)
    except OSError as error:
        raise IzooError(f"cannot write {options.out}: {os_reason(error)}; choose another file with --out.") from error
    print(f"Picture: {options.out}", flush=True)


def _table_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print a table in Markdown, a row per file, as under Results on the benchmark's page. All files must come from "
        "the same test episodes, and one of them must be that of uncommanded CVs. Figures are in percent and computed "
        "from the files' rows; intervals are over intersections and, from four training seeds on, over training seeds "
        "as well."
    )
    _validate_arguments(parser)
    help_text = "file of uncommanded CVs to compare with, if it is to have no row"
    parser.add_argument("--uncommanded", type=Path, metavar="FILE", help=help_text)


def _table(options: argparse.Namespace) -> None:
    """Print nothing but the table, so that it can be put where it belongs."""
    checked = _read(_submissions(options.files))
    uncommanded = None if options.uncommanded is None else _read([options.uncommanded])[0]
    from izoo.reporting.markdown_table import markdown_table

    print(markdown_table(checked, uncommanded), flush=True)


def _checked(files: Sequence[Path]) -> list[Any]:
    print(f"izoo {__version__} leaderboard", flush=True)
    return _read(_submissions(files))


def _read(paths: Sequence[Path]) -> list[Any]:
    from izoo.evaluation.provenance import versions
    from izoo.reporting import submissions

    reference = versions()
    return [submissions.check(submissions.read_submission(path), str(path), reference) for path in paths]


def _submissions(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and those in the folders but for merged leaderboards."""
    found: list[Path] = []
    for path in paths:
        inside = [file for file in sorted(path.glob("*.json")) if not _is_merged(file)] if path.is_dir() else [path]
        if not inside:
            raise IzooError(f"{path} holds no leaderboard file; a benchmark writes them into leaderboard/.")
        if not inside[0].exists():
            raise IzooError(f"{path} does not exist; give leaderboard files, or folders that hold some.")
        found += inside
    return found


def _print_checked(item: Any) -> None:
    print(f"{plain(item.source)}: " + ("marked" if item.marks else "in order"))
    for word, texts in (("mark", item.marks), ("note", item.notes)):
        for text in texts:
            print(f"  {word}: {plain(text)}")


def _print_leaderboard(merged: dict[str, Any]) -> None:
    from rich.console import Console

    from izoo.evaluation.show import intervals_in_words

    console = Console()
    for group in merged["groups"]:
        lines = [*group["ranked"], *group["marked"]]
        console.print(leaderboard_table(group))
        trained = [line["n"]["train_seeds"] for line in lines if line["policy"]["kind"] == "trained"]
        console.print(intervals_in_words([line["n"]["intersections"] for line in lines], trained), highlight=False)
        for line in lines:
            for text in [*line["marks"], *line["notes"]]:
                note = plain(f"  {line['policy']['name']} ({line['source']}): {text}")
                console.print(note, highlight=False, markup=False, soft_wrap=True)


def leaderboard_table(group: Mapping[str, Any]) -> Table:
    """Return a group of :func:`izoo.reporting.submissions.merge` as a table for 80 columns: an entry takes a few lines,
    one for each of :data:`FORMS`.
    """
    from rich.markup import escape
    from rich.text import Text

    from izoo.evaluation.show import figure_table, percent

    protocol = group["protocol"]
    title = f"{protocol['title']} ({protocol['protocol']}, {protocol['form']}, horizon {protocol['horizon_s']:g} s)"
    table = figure_table(escape(plain(title)), "rank,\npolicy", ["CO2 counted", *(label for label, _ in BENEFITS)])
    for line in [*group["ranked"], *group["marked"]]:
        found = line["aggregates"]["all"]
        forms = [each for each in FORMS if f"{each[1]}{BENEFITS[0][1]}" in found]
        columns = [
            [percent(found[part]["mean"]) if part in found else "-" for part in (form + benefit for _, form in forms)]
            for _, benefit in BENEFITS
        ]
        entry = Text(f"{line.get('rank', '-')} {plain(line['policy']['name'])}\n{_about(line)}")
        table.add_row(entry, *("\n".join(cells) for cells in ([label for label, _ in forms], *columns)))
        table.add_section()  # an empty line
    return table


def _about(line: Mapping[str, Any]) -> str:
    """What stands below the name of an entry: how it was tested, and how much of the demand was served."""
    from izoo.envs.config import SIMULATOR_NAMES
    from izoo.evaluation.show import stacked

    n = line["n"]
    tested = f"{n['approaches']} approaches on {SIMULATOR_NAMES[line['simulator']]}\ntraining seeds: {n['train_seeds']}"
    served = line["aggregates"]["all"].get("served", {}).get("policy")
    return f"{tested}\ndemand served: {stacked(served)}"


LEADERBOARD = SubcommandCommand(
    "leaderboard",
    "Check, merge, draw and tabulate leaderboard files.",
    (
        Subcommand("validate", "say what is wrong with each file", _validate_arguments, _validate),
        Subcommand("merge", "rank the files, by protocol", _merge_arguments, _merge),
        Subcommand("draw", "draw what they saved, by protocol", _draw_arguments, _draw),
        Subcommand("table", "print what they saved as a table in Markdown", _table_arguments, _table),
    ),
)
