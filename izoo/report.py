"""``python -m izoo.report``: results as one HTML page that opens from disk."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from izoo import __version__
from izoo.console import exit_code
from izoo.errors import IzooError, unknown_choice
from izoo.files import check_folder

HELP = """Write results as one HTML page that opens from disk and asks for nothing else.

Usage: python -m izoo.report RESULTS [option=value ...]

RESULTS is what izoo.evaluate, izoo.train, izoo.benchmarks.generalization or izoo.benchmarks.tradeoffs has written.

Options, with their defaults:
  out=RESULTS/report.html
      The page.
  title=null
      Its title; null: what the folder says, such as "train -> test".
  replay=true
      Show the best and the worst approach of every policy, played again beside the baseline. That takes some seconds
      for each the first time; then they lie in the folder "replays" of the evaluation.
  imports=false
      Import policies that are written module:function for that. Say true only of results that you trust.
  partial=false
      Accept a benchmark that is not finished.

Example: python -m izoo.report results/productivity-small out=report.html"""
_WORDS = {"true": True, "false": False}


@dataclass(frozen=True)
class Options:
    """Options of the command; ``--help`` explains them."""

    results: Path
    out: Path | None = None
    title: str | None = None
    replay: bool = True
    imports: bool = False
    partial: bool = False


def parse(words: Sequence[str]) -> Options:
    """Read the command line.

    Raises:
        IzooError: an unknown option, a value that is none, or not exactly one folder.
    """
    # Folders may contain "=": what names no option and exists is a folder.
    named = [word.partition("=") for word in words if "=" in word and not Path(word).exists()]
    folders = [word for word in words if "=" not in word or Path(word).exists()]
    flags = [word for word in folders if word.startswith("-")]
    if flags:
        raise unknown_choice("flag", flags[0], ["--help", "--version"])
    if len(folders) != 1:
        raise IzooError(f"give one folder of results, not {len(folders)}: python -m izoo.report RESULTS.")
    values: dict[str, str] = {name: value for name, _, value in named}
    for name in values:
        if name not in ("out", "title", "replay", "imports", "partial"):
            raise unknown_choice("option", name, ["out", "title", "replay", "imports", "partial"])
    flagged = {name: _flag(name, values[name]) for name in ("replay", "imports", "partial") if name in values}
    title, out = values.get("title", "null"), values.get("out", "null")
    return Options(
        Path(folders[0]).expanduser(),
        None if out == "null" else Path(out).expanduser(),
        None if title == "null" else title,
        **flagged,
    )


def _flag(name: str, value: str) -> bool:
    if value not in _WORDS:
        raise unknown_choice(f"value of {name}", value, _WORDS)
    return _WORDS[value]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    print(f"izoo {__version__} report", flush=True)
    if {"-h", "--help"} & {*words}:
        print(HELP)
        return 0
    if "--version" in words:
        return 0
    return exit_code("report", lambda: _run(words))


def _run(words: Sequence[str]) -> int:
    options = parse(words)
    check_folder(options.results, "give one that izoo.evaluate, izoo.train or a benchmark has written")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would announce every replay buffer
    from izoo.reporting.page import write_report

    path = write_report(
        options.results,
        options.out,
        options.title,
        replay=options.replay,
        imports=options.imports,
        partial=options.partial,
        note=lambda text: print(text, flush=True),
    )
    print(f"Report: {path} ({path.stat().st_size / 1e6:.1f} MB)", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
