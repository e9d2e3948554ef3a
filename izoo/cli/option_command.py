"""Commands whose options are written ``option=value``: the first line, options, help, and sweeps over several values.

This module imports nothing heavy, so that a command says something at once; PyTorch and SUMO follow.
"""

from __future__ import annotations

import dataclasses
import os
import pkgutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from izoo import __version__
from izoo.cli.help_page import help_text, to_yaml
from izoo.conf.quoting import literal
from izoo.conf.recipes import with_recipe
from izoo.console import EXIT_BAD_INPUT, EXIT_UNFINISHED, exit_code, unheard
from izoo.errors import IzooError, UnfinishedError, unknown_choice
from izoo.files import usable_paths

GOES_ON = "the same command goes on where it stopped"
FOLDERS = ("run_dir", "out")
"""Options that name where a command's results go."""
SHOW = ("--help", "-h", "--cfg", "--version")
"""Flags with which a command only says something."""
FLAGS = (*SHOW, "--multirun", "-m")


@dataclass(frozen=True)
class OptionCommand:
    """A command ``python -m izoo.<name>``.

    Attributes:
        name: also the name of its YAML file in ``izoo/conf``, where its options have choices.
        summary: one sentence for ``--help``.
        examples: command lines for ``--help``, without ``python -m``.
        config: ``module:name`` of the dataclass of the options.
        work: ``module:name`` of what does the work: called with the options and the set of the names of those that were
            written on the command line, once they are known to be good.
        check: ``module:name`` of what refuses paths that cannot be used, called with the options before ``work`` is
            imported; it imports nothing slow.
        place: an option that is given without its name, as in ``izoo.report FOLDER``.
        literal: options whose values are taken as they are written, whatever signs they hold.
        before: ``module:name`` of what returns further words, which count before those that were written; called with
            these, it imports nothing slow.
        stopped: what to say after Ctrl-C beside that it was stopped, such as how to go on.
        recipes: whether ``recipe=NAME`` may stand for other words (:mod:`izoo.conf.recipes`).
    """

    name: str
    summary: str
    examples: tuple[str, ...]
    config: str
    work: str
    check: str | None = None
    place: str | None = None
    literal: tuple[str, ...] = ()
    before: str | None = None
    stopped: str = ""
    recipes: bool = False

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the command and return its exit code (:func:`izoo.console.exit_code`)."""
        words = ["verbose=true" if word == "-v" else word for word in (sys.argv[1:] if argv is None else argv)]
        # Idle OpenMP threads would otherwise spin on the cores that the simulators need.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would announce every replay buffer
        run = self._run if set(words) & set(SHOW) else unheard()(self._run)
        return exit_code(self.name, lambda: run(words), self.stopped)

    def config_class(self) -> type:
        """Import and return the dataclass of the options."""
        return pkgutil.resolve_name(self.config)

    def options(self, words: Sequence[str]) -> list[str]:
        """Return words that are no flags as ``option=value``.

        Raises:
            IzooError: words without a name, and not one for the option that is given so; an unknown recipe.
        """
        if self.recipes:
            words = with_recipe(words)
        if self.before is not None:
            words = [*pkgutil.resolve_name(self.before)(words), *words]
        if self.place is not None:
            # Folders may contain "=": what exists is a folder.
            nameless = [word for word in words if "=" not in word or os.path.exists(word)]  # noqa: PTH110 (any length)
            named = [word for word in words if word not in nameless and word.startswith(f"{self.place}=")]
            if len(nameless) + len(named) != 1:
                what = self.place.upper()
                raise IzooError(
                    f"give one folder {what}, not {len(nameless) + len(named)}: python -m izoo.{self.name} {what}."
                )
            words = [f"{self.place}={word}" if word in nameless else word for word in words]
        return [_quoted(word) if word.partition("=")[0] in self.literal else word for word in words]

    @usable_paths()
    def _run(self, words: Sequence[str]) -> int:
        print(f"izoo {__version__} {self.name}", flush=True)
        flags = [word for word in words if word.startswith("-")]
        for flag in flags:
            if flag not in FLAGS:
                raise unknown_choice("flag", flag, FLAGS)
        if "--version" in flags:
            return 0
        config_class = self.config_class()
        from izoo.conf import compose

        if "--help" in flags or "-h" in flags:
            print(help_text(self, config_class, compose.choices()))
            return 0
        options = self.options([word for word in words if not word.startswith("-")])
        if "-m" in flags or "--multirun" in flags:
            return _multirun(self, config_class, options, show="--cfg" in flags)
        config: Any = compose.compose_config(self.name, config_class, options)
        if "--cfg" in flags:
            print(to_yaml(config), end="")
            return 0
        self._check(config)
        self._work(config, _given(options))
        return 0

    def _check(self, config: Any) -> None:
        if self.check is not None:
            pkgutil.resolve_name(self.check)(config)

    def _work(self, config: Any, given: frozenset[str]) -> None:
        with usable_paths():  # Hydra calls it, in a sweep
            pkgutil.resolve_name(self.work)(config, given)


def _multirun(command: OptionCommand, config_class: type, options: Sequence[str], show: bool) -> int:
    """Run once for each combination, through Hydra's launcher, or ``show`` their options; bad input stops the sweep."""
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    from izoo.conf import compose

    overrides = compose.parse(options, multirun=True)
    compose.register(command.name, config_class)
    compose.check_names(command.name, overrides)
    combinations: list[Any] = compose.check_combinations(command.name, config_class, overrides)
    if show:
        _print_combinations(combinations, compose.MAX_CHECKED)
        return 0
    given = _given(options)
    for name in FOLDERS:
        folders = [folder for config in combinations if (folder := getattr(config, name, None)) is not None]
        if len(set(folders)) < len(folders):
            raise IzooError(
                f"{len(folders)} runs would share the folder {folders[0]}; make {name} differ by an option that does, "
                f"as in {name}='{folders[0]}/${{seed}}'."
            )
    for config in combinations:
        command._check(config)

    def job(composed: DictConfig) -> None:
        try:
            config: Any = compose.to_dataclass(composed, config_class)
            if getattr(config, "run_dir", "") is None:
                output = HydraConfig.get().runtime.output_dir
                config = dataclasses.replace(config, run_dir=output)
            compose.clear()  # the work may compose options, too
            command._work(config, given)
        except (IzooError, UnfinishedError) as error:
            print(f"izoo {command.name}: {error}", file=sys.stderr, flush=True)
            raise SystemExit(EXIT_BAD_INPUT if isinstance(error, IzooError) else EXIT_UNFINISHED) from None

    compose.clear()
    arguments = sys.argv
    sys.argv = [command.name, *(override.input_line or "" for override in overrides), "--multirun"]
    try:
        hydra.main(version_base="1.3", config_path=f"pkg://{compose.CONFIG_MODULE}", config_name=command.name)(job)()
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = arguments
    return 0


def _print_combinations(combinations: Sequence[Any], most: int) -> None:
    """Print the options of every combination as a YAML document; ``most`` is how many are composed."""
    for number, config in enumerate(combinations, 1):
        print(f"---\n# combination {number}\n{to_yaml(config)}", end="")
    if len(combinations) == most:
        print(f"---\n# no more than {most} combinations are shown")


def _given(options: Sequence[str]) -> frozenset[str]:
    return frozenset(word.partition("=")[0].lstrip("+~") for word in options)


def _quoted(word: str) -> str:
    name, _, value = word.partition("=")
    return word if value == "null" else f"{name}={literal(value)}"
