"""``python -m izoo.report``: an evaluation as one HTML page that opens from disk."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from izoo import __version__
from izoo.cli import EXIT_BAD_INPUT
from izoo.errors import IzooError


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m izoo.report", description="Write an evaluation as an HTML page.")
    parser.add_argument("results", type=Path, help="a folder that izoo.evaluate or izoo.train has written")
    parser.add_argument("--out", type=Path, help="the page; by default report.html in that folder")
    parser.add_argument("--title", help="title of the page; by default the folder's name")
    arguments = parser.parse_args(argv)
    print(f"izoo {__version__} report", flush=True)
    from izoo.reporting.page import write_report

    try:
        path = write_report(arguments.results, arguments.out, arguments.title)
    except IzooError as error:
        print(f"izoo report: {error}", file=sys.stderr, flush=True)
        return EXIT_BAD_INPUT
    print(f"Report: {path}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
