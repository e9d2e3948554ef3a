"""``python -m izoo.sweep``: the runs of a sweep side by side."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from izoo import __version__
from izoo.console import exit_code
from izoo.errors import IzooError, unknown_choice
from izoo.files import check_folder

HELP = """Show the runs of a sweep side by side, averaged over their seeds.

Usage: python -m izoo.sweep FOLDER

FOLDER holds training runs at any depth, as izoo.train -m leaves them. The table has a row for every combination of the
options in which the runs differ: benefits over human driving (best and last validation, final evaluation), return,
frames and hours. It is printed, and written to FOLDER/sweep.csv; FOLDER/sweep_runs.csv has a row per run, and
FOLDER/sweep.png shows the learning curves. Runs that have not finished are counted and named.

Example: python -m izoo.train -m algo=ppo,ddpg seed=0,1 && python -m izoo.sweep runs/DATE-sweep"""


def parse(words: Sequence[str]) -> Path:
    """Read the command line: the folder.

    Raises:
        IzooError: a flag is unknown, or there is not exactly one folder.
    """
    flags = [word for word in words if word.startswith("-")]
    if flags:
        raise unknown_choice("flag", flags[0], ["--help", "--version"])
    if len(words) != 1:
        raise IzooError(f"give one folder of runs, not {len(words)}: python -m izoo.sweep FOLDER.")
    return Path(words[0]).expanduser()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    print(f"izoo {__version__} sweep", flush=True)
    if {"-h", "--help"} & {*words}:
        print(HELP)
        return 0
    if "--version" in words:
        return 0
    return exit_code("sweep", lambda: _run(words))


def _run(words: Sequence[str]) -> int:
    folder = parse(words)
    check_folder(folder, "give the folder of a sweep (izoo.train -m ...)")
    from izoo.training.sweeps import report

    print(f"Table: {report(folder)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
