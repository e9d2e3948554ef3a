"""``python -m izoo``, and the script ``izoo``: list the commands, or run one (``izoo train task=busy_lane``)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from izoo import __version__
from izoo.console import exit_code
from izoo.errors import unknown_choice

COMMANDS = {
    "train": ("izoo.train", "train a policy, then compare it with human driving"),
    "evaluate": ("izoo.evaluate", "compare a policy with human driving and uncommanded vehicles"),
    "report": ("izoo.report.__main__", "show results as a page, or the runs of a sweep as a table"),
    "leaderboard": ("izoo.leaderboard", "check leaderboard files and merge them"),
    "collect": ("izoo.collect", "store what a policy experiences, for offline learning"),
    "contexts": ("izoo.contexts.__main__", "list, draw, import and build intersections"),
    "zoo": ("izoo.zoo.__main__", "trained policies that ship, and exports of your own"),
    "drivers": ("izoo.drivers.__main__", "calibrate human drivers on trajectories"),
    "benchmarks.campaign": ("izoo.benchmarks.campaign.__main__", "train, test and compare what an experiment lists"),
    "benchmarks.twin": ("izoo.benchmarks.twin", "how far the twin and SUMO agree"),
    "benchmarks.calibration": ("izoo.benchmarks.calibration", "whether calibration finds drivers that are known"),
    "benchmarks.speed": ("izoo.benchmarks.speed", "how fast environments, training and emissions are here"),
}
"""Module and meaning of every command."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; without one, list them."""
    words = list(sys.argv[1:] if argv is None else argv)
    return exit_code("", lambda: _run(words))


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "--version"):
        print(f"izoo {__version__}", flush=True)
        if words != ["--version"]:
            print("\nUsage: izoo COMMAND ...; izoo COMMAND --help says more. Commands:")
            print("\n".join(f"  {name:23} {meaning}" for name, (_, meaning) in COMMANDS.items()))
        return 0
    name = words.pop(0)
    if name not in COMMANDS:
        raise unknown_choice("command", name, COMMANDS)
    return importlib.import_module(COMMANDS[name][0]).main(words)


if __name__ == "__main__":
    sys.exit(main())
