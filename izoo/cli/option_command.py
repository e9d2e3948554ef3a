"""Commands whose options are written ``option=value``: the first line, help, and sweeps over several values.

This module imports nothing heavy, so that a command says something at once; PyTorch and SUMO follow.
"""

from __future__ import annotations

import dataclasses
import os
import pkgutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from izoo import __version__
from izoo.conf.quoting import quoted
from izoo.console import exit_code, survives_lost_output
from izoo.errors import IzooError, unknown_choice
from izoo.files import usable_paths

LONG = {"-h": "--help", "-m": "--multirun"}
FLAGS = ("--help", "--multirun", "--cfg", "--version")
SHOW = {"-h", "--help", "--cfg", "--version"}
"""Flags whose text is all that a command is for."""
GOES_ON = "the same command goes on where it stopped"


@dataclass(frozen=True)
class OptionCommand:
    """A command ``python -m izoo.<name>`` whose options are a dataclass.

    Attributes:
        name: as it is run.
        summary: one sentence for ``--help``.
        examples: command lines for ``--help``, without ``python -m``.
        config: ``module:name`` of the dataclass of its options.
        work: ``module:name`` of what is called with the options.
        defaults: ``module:name`` of other defaults (:func:`izoo.cli.compose.compose_config`).
        place: an option that is given without its name, as in ``izoo.report FOLDER``.
        stopped: what to say after Ctrl-C besides that it was stopped, such as how to go on.
    """

    name: str
    summary: str
    examples: tuple[str, ...]
    config: str
    work: str
    defaults: str | None = None
    place: str | None = None
    stopped: str = ""

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the command and return its exit code (:func:`izoo.console.exit_code`)."""
        words = sys.argv[1:] if argv is None else argv
        # Idle OpenMP threads would otherwise spin on the cores that the simulators need.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would announce every replay buffer
        run = self._run if SHOW & {*words} else survives_lost_output()(self._run)
        return exit_code(self.name, lambda: run(words), self.stopped)

    def config_class(self) -> Any:
        """Import and return the dataclass of the options."""
        return pkgutil.resolve_name(self.config)

    def compose(self, words: Sequence[str]) -> Any:
        """Return the options that words, without flags and sweeps, stand for."""
        from izoo.cli.compose import compose_config

        defaults = None if self.defaults is None else pkgutil.resolve_name(self.defaults)
        return compose_config(self.config_class(), words, defaults)

    def named(self, words: Sequence[str]) -> list[str]:
        """Return words that are no flags, each as ``option=value``."""
        if self.place is None:
            return list(words)
        words = [word if "=" in word else f"{self.place}={quoted(word)}" for word in words]
        if sum(word.startswith(f"{self.place}=") for word in words) != 1:
            raise IzooError(f"give one folder: python -m izoo.{self.name} {self.place.upper()}.")
        return words

    @usable_paths()
    def _run(self, words: Sequence[str]) -> int:
        print(f"izoo {__version__} {self.name}", flush=True)
        Path.cwd()  # PyTorch ends the process where the current folder has been removed
        flags = {LONG.get(word, word) for word in words if word.startswith("-")}
        options = [word for word in words if not word.startswith("-")]
        if "-v" in flags and hasattr(self.config_class(), "verbose"):
            flags.remove("-v")
            options.append("verbose=true")
        for flag in flags.difference(FLAGS):
            raise unknown_choice("flag", flag, FLAGS)
        if "--version" in flags:
            return 0
        if "--help" in flags:
            from izoo.cli import help_page

            print(help_page.overview(self), flush=True)  # before PyTorch is loaded for an algorithm's options
            print(help_page.options(self.compose(options)))
            return 0
        sweeps, options = "--multirun" in flags, self.named(options)
        configs = self._sweep(options) if sweeps else [self.compose(options)]
        if "--cfg" in flags:
            from izoo.conf.mapping import to_yaml

            print("---\n".join(map(to_yaml, configs)), end="")
            return 0
        work = pkgutil.resolve_name(self.work)
        for number, config in enumerate(configs):
            if sweeps:
                print(f"Run {number + 1} of {len(configs)}", flush=True)
            work(config)
        return 0

    def _sweep(self, words: Sequence[str]) -> list[Any]:
        """Return the options of every run of a sweep, so that one that cannot be used stops all of them.

        Raises:
            IzooError: options cannot be used, or runs would share a folder.
        """
        from izoo.cli.compose import FOLDERS, combinations

        configs = [self.compose(combination) for combination in combinations(words)]
        if not configs:
            raise IzooError("the sweep has no values; give at least one.")
        for config in configs:
            if hasattr(config, "contexts"):
                config.contexts.build()
        for name in FOLDERS:
            folders = [folder for config in configs if (folder := getattr(config, name, None)) is not None]
            if len(set(folders)) < len(folders):
                raise IzooError(
                    f"{len(folders)} runs would share the folder {folders[0]}; make {name} differ by an option that "
                    f"does, as in {name}='{folders[0]}/${{seed}}'."
                )
        if not hasattr(configs[0], "run_dir") or configs[0].run_dir is not None:
            return configs
        sweep = f"runs/{datetime.now():%Y-%m-%d_%H-%M-%S}-sweep"
        named = [f"{sweep}/{number}-{config.algo.name}-seed{config.seed}" for number, config in enumerate(configs)]
        return [dataclasses.replace(config, run_dir=name) for config, name in zip(configs, named, strict=True)]
