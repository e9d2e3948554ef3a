"""Commands that have subcommands with paths and flags, as ``izoo.contexts`` and ``izoo.leaderboard``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from izoo.console import exit_code
from izoo.files import usable_paths

Run = Callable[[argparse.Namespace], int | None]
Argument = tuple[tuple[str, ...], dict[str, Any]]


def argument(*names: str, **options: Any) -> Argument:
    """Return what :meth:`argparse.ArgumentParser.add_argument` is called with."""
    return names, options


class SubcommandCommand:
    """A command ``python -m izoo.<name>`` with subcommands.

    Args:
        name: as it is run.
        summary: one sentence for ``--help``.
    """

    def __init__(self, name: str, summary: str) -> None:
        self.name = name
        self._parser = argparse.ArgumentParser(prog=f"python -m izoo.{name}", description=summary)
        self._subparsers = self._parser.add_subparsers(dest="command", required=True)

    def command(self, help: str, *arguments: Argument) -> Callable[[Run], Run]:
        """Register a function, of the parsed options, as the subcommand of its name; it may return an exit code.

        What is slow to import is imported by it, so that each says something at once.
        """

        def register(run: Run) -> Run:
            subparser = self._subparsers.add_parser(run.__name__.strip("_"), help=help, description=help)
            for names, options in arguments:
                subparser.add_argument(*names, **options)
            subparser.set_defaults(run=run)
            return run

        return register

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run a subcommand and return its exit code, 2 for input that cannot be used, or 130 when it was stopped."""
        return exit_code(self.name, lambda: _run(self._parser.parse_args(argv)))


@usable_paths()
def _run(options: argparse.Namespace) -> int:
    return options.run(options) or 0
