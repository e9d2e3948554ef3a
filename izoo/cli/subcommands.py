"""Commands that have subcommands with paths and flags, as ``izoo.contexts`` and ``izoo.leaderboard``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from izoo.console import exit_code
from izoo.files import usable_paths


class Subcommand(NamedTuple):
    """A subcommand: its name, one line of help, what adds its arguments, and what it does.

    ``run`` may return an exit code. What is slow to import is imported by it, so that each says something at once.
    """

    name: str
    help: str
    arguments: Callable[[argparse.ArgumentParser], object]
    run: Callable[[argparse.Namespace], int | None]


@dataclass(frozen=True)
class SubcommandCommand:
    """A command ``python -m izoo.<name>`` with subcommands.

    Attributes:
        name: as it is run.
        summary: one sentence for ``--help``.
        subcommands: in the order of ``--help``.
    """

    name: str
    summary: str
    subcommands: tuple[Subcommand, ...]

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run a subcommand and return its exit code, 2 for input that cannot be used, or 130 when it was stopped."""
        parser = argparse.ArgumentParser(prog=f"python -m izoo.{self.name}", description=self.summary)
        subparsers = parser.add_subparsers(dest="command", required=True)
        for command in self.subcommands:
            subparser = subparsers.add_parser(command.name, help=command.help, description=command.help)
            command.arguments(subparser)
            subparser.set_defaults(run=command.run)
        return exit_code(self.name, lambda: _run(parser.parse_args(argv)))


@usable_paths()
def _run(options: argparse.Namespace) -> int:
    return options.run(options) or 0
