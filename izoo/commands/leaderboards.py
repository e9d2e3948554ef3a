"""What ``python -m izoo.leaderboard`` does: check leaderboard files, and merge them into one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from izoo import __version__
from izoo.commands.subcommands import Subcommand, SubcommandCommand
from izoo.console import plain
from izoo.errors import IzooError
from izoo.files import os_reason, write_json

EXIT_MARKED = 1
FIGURES = (
    ("mean benefit,\nexact gate", "exact", "mean"),
    ("whole region", "region_exact", "mean"),
    ("over\nuncommanded,\nno gate", "over_uncommanded", "mean"),
    ("demand, over\nuncommanded", "demand_over_uncommanded", "mean"),
    ("demand\nserved", "served", "policy"),
)
"""Columns of a leaderboard: label, part and name of :data:`izoo.evaluation.aggregates.FIGURES`."""


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
    from izoo.reporting import submissions

    merged = submissions.merge(checked)
    try:
        write_json(options.out, merged)
    except OSError as error:
        raise IzooError(f"cannot write {options.out}: {os_reason(error)}; choose another file with --out.") from error
    _print_leaderboard(merged)
    print(f"Leaderboard: {options.out}", flush=True)


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


def _checked(files: Sequence[Path]) -> list[Any]:
    print(f"izoo {__version__} leaderboard", flush=True)
    paths = _submissions(files)
    from izoo.evaluation.provenance import versions
    from izoo.reporting import submissions

    reference = versions()
    return [submissions.check(submissions.read_submission(path), str(path), reference) for path in paths]


def _submissions(paths: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.glob("*.json")) if path.is_dir() else [path]
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
    from rich.markup import escape
    from rich.text import Text

    from izoo.envs.config import SIMULATOR_NAMES
    from izoo.evaluation.show import figure_table, intervals_in_words, stacked

    console = Console()
    for group in merged["groups"]:
        protocol = group["protocol"]
        title = f"{protocol['title']} ({protocol['protocol']}, {protocol['form']}, horizon {protocol['horizon_s']:g} s)"
        table = figure_table(escape(plain(title)), "rank, policy", [label for label, _, _ in FIGURES])
        lines = [*group["ranked"], *group["marked"]]
        for line in lines:
            n = line["n"]
            played = SIMULATOR_NAMES[line["simulator"]]
            about = f"{n['approaches']} approaches on {played}, training seeds: {n['train_seeds']}"
            figures = (line["aggregates"]["all"].get(part, {}).get(name) for _, part, name in FIGURES)
            entry = Text(f"{line.get('rank', '-')} {plain(line['policy']['name'])}\n{about}")
            table.add_row(entry, *map(stacked, figures))
        console.print(table)
        trained = [line["n"]["train_seeds"] for line in lines if line["policy"]["kind"] == "trained"]
        console.print(intervals_in_words([line["n"]["intersections"] for line in lines], trained), highlight=False)
        for line in lines:
            for text in [*line["marks"], *line["notes"]]:
                note = plain(f"  {line['policy']['name']} ({line['source']}): {text}")
                console.print(note, highlight=False, markup=False, soft_wrap=True)


LEADERBOARD = SubcommandCommand(
    "leaderboard",
    "Check, merge and draw leaderboard files.",
    (
        Subcommand("validate", "say what is wrong with each file", _validate_arguments, _validate),
        Subcommand("merge", "rank the files, by protocol", _merge_arguments, _merge),
        Subcommand("draw", "draw what they saved, by protocol", _draw_arguments, _draw),
    ),
)
