"""What ``python -m izoo.leaderboard`` does: check leaderboard files, merge them into one, and show them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from izoo import __version__
from izoo.cli.subcommands import SubcommandCommand, argument
from izoo.console import plain, survives_lost_output
from izoo.errors import IzooError
from izoo.files import read_text, write_text

EXIT_MARKED = 1


LEADERBOARD = SubcommandCommand("leaderboard", "Check, merge, draw and tabulate leaderboard files.")
FILES = argument("files", type=Path, nargs="+", help="leaderboard files, or folders that hold some (*.json)")


@LEADERBOARD.command("say what is wrong with each file", FILES)
def _validate(options: argparse.Namespace) -> int:
    """Say what is wrong with each file; return 1 where something was found to mark."""
    print(f"izoo {__version__} leaderboard", flush=True)
    found = _read(options.files)
    for entry in found:
        print(f"{plain(entry.source)}: " + ("marked" if entry.marks else "in order"))
        for word, texts in (("mark", entry.marks), ("note", entry.notes)):
            for text in texts:
                print(f"  {word}: {plain(text)}")
    return EXIT_MARKED if any(entry.marks for entry in found) else 0


@LEADERBOARD.command(
    "rank the files, by task",
    FILES,
    argument("--out", type=Path, default=Path("leaderboard.json"), help="the leaderboard's file"),
)
@survives_lost_output()
def _merge(options: argparse.Namespace) -> None:
    from rich.console import Console

    from izoo.report import leaderboard

    merged = leaderboard.merge(_read(options.files))
    if options.out.exists() and not _is_merged(options.out):  # it would take the place of an entry, perhaps
        raise IzooError(f"{options.out} is there and is not a merged leaderboard; choose another file with --out.")
    write_text(options.out, json.dumps(merged, allow_nan=False) + "\n")
    console = Console()
    for group in merged["groups"]:
        console.print(leaderboard.board(group).rich(console.width))
        for line in _said(group):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    print(f"Leaderboard: {options.out}", flush=True)


def _said(group: Mapping[str, Any]) -> list[str]:
    marks = [
        plain(f"  {line['name']} ({line['source']}): {text}")
        for line in group["entries"]
        for text in (*line["marks"], *line["notes"])
    ]
    return [*marks, *([plain(group["summary"]["verdict"])] if group.get("summary") else [])]


@LEADERBOARD.command(
    "draw what they saved, by task",
    FILES,
    argument("--out", type=Path, default=Path("leaderboard.png"), help="the picture's file, a PNG"),
)
@survives_lost_output()
def _draw(options: argparse.Namespace) -> None:
    if options.out.suffix.lower() != ".png":
        raise IzooError(f"--out is {options.out}, but the picture is a PNG; give a name that ends so, such as all.png.")
    from izoo.report import leaderboard

    leaderboard.draw(_read(options.files), options.out)
    print(f"Picture: {options.out}", flush=True)


@LEADERBOARD.command("print them as tables in Markdown", FILES)
def _table(options: argparse.Namespace) -> None:
    """Print nothing but the tables in Markdown, so that they can be put where they belong."""
    from izoo.report import leaderboard

    texts = []
    for group in leaderboard.merge(_read(options.files))["groups"]:
        shown = leaderboard.board(group)
        texts += [plain(f"{shown.title}:"), shown.markdown(), *_said(group)]
    print("\n\n".join(texts))


def _read(paths: Sequence[Path]) -> list[Any]:
    files = _paths(paths)
    from izoo.report import leaderboard

    return [leaderboard.read_entry(path) for path in files]


def _paths(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and those in the folders but for merged leaderboards."""
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise IzooError(f"{path} does not exist; give leaderboard files, or folders that hold some.")
        inside = [file for file in sorted(path.glob("*.json")) if not _is_merged(file)] if path.is_dir() else [path]
        if not inside:
            raise IzooError(f"{path} holds no leaderboard file; give leaderboard files, or folders that hold some.")
        found += inside
    return found


def _is_merged(path: Path) -> bool:
    """Whether a file is what ``merge`` writes, and so not an entry."""
    try:
        return bool(json.loads(read_text(path))["format"].startswith("izoo-leaderboard-merged-"))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False
