"""Commands whose options are written ``option=value``: the first line, help, sweeps, and what Hydra reads of the words.

A group such as ``algo=ddpg`` takes the place of all its options; ``task=NAME`` changes the defaults of what belongs to
a task; every other word changes one option. What is heavy is imported late, so that a command says something at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import itertools
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from izoo import __version__
from izoo.console import exit_code, survives_lost_output
from izoo.errors import IzooError, unknown_choice
from izoo.files import usable_paths
from izoo.options import from_mapping, quoted, to_mapping

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

    from izoo.tasks import Task

T = TypeVar("T")
Defaults = Callable[[Mapping[str, Any]], Mapping[str, Any]]
SHORT = {"-h": "--help", "-m": "--multirun", "-v": "verbose=true"}
FLAGS = ("--help", "--multirun", "--cfg")
GOES_ON = "the same command goes on where it stopped"
OF_THE_COMMAND = ("emit", "drain_s")
"""Settings of the environment that say what a command needs, whatever the task."""


@dataclass(frozen=True)
class OptionCommand:
    """A command ``python -m izoo.<name>`` whose options are a dataclass.

    Attributes:
        name: as it is run.
        summary: one sentence for ``--help``.
        examples: command lines for ``--help``, without ``python -m``.
        config: ``module:name`` of the dataclass of its options.
        work: ``module:name`` of what is called with the options.
        defaults: ``module:name`` of other defaults (:func:`compose_config`).
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
        words = [SHORT.get(word, word) for word in (sys.argv[1:] if argv is None else argv)]
        # Idle OpenMP threads would otherwise spin on the cores that the simulators need.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would announce every replay buffer
        run = self._run if {"--help", "--cfg"} & {*words} else survives_lost_output()(self._run)
        return exit_code(self.name, lambda: run(words), self.stopped)

    def config_class(self) -> Any:
        """Import and return the dataclass of the options."""
        return pkgutil.resolve_name(self.config)

    def compose(self, words: Sequence[str]) -> Any:
        """Return the options that words, without flags and sweeps, stand for."""
        defaults = None if self.defaults is None else pkgutil.resolve_name(self.defaults)
        return compose_config(self.config_class(), self.named(words), defaults)

    def named(self, words: Sequence[str]) -> list[str]:
        """Return words that are no flags, each as ``option=value``."""
        found = [f"{self.place}={quoted(word)}" if self.place and "=" not in word else word for word in words]
        if sum(word.startswith(f"{self.place}=") for word in found) > 1:
            raise IzooError(f"give one folder: python -m izoo.{self.name} FOLDER.")
        return found

    @usable_paths()
    def _run(self, words: Sequence[str]) -> int:
        print(f"izoo {__version__} {self.name}", flush=True)
        Path.cwd()  # PyTorch ends the process where the current folder has been removed
        flags = {word for word in words if word.startswith("-")}
        options = [word for word in words if word not in flags]
        for flag in flags.difference(FLAGS):
            raise unknown_choice("flag", flag, FLAGS)
        if "--help" in flags:
            from izoo.cli import help_page

            print(help_page.overview(self), flush=True)  # before PyTorch is loaded for an algorithm's options
            print(help_page.options(self.compose(options)))
            return 0
        configs = self._sweep(options) if "--multirun" in flags else [self.compose(options)]
        if "--cfg" in flags:
            import yaml

            print(yaml.safe_dump_all(map(to_mapping, configs), sort_keys=False), end="")
            return 0
        work = pkgutil.resolve_name(self.work)
        for number, config in enumerate(configs, 1):
            if len(configs) > 1:
                print(f"Run {number} of {len(configs)}", flush=True)
            work(config)
        return 0

    def _sweep(self, words: Sequence[str]) -> list[Any]:
        """Return the options of every run of a sweep; runs that would share a folder get folders inside it."""
        configs = [self.compose(combination) for combination in combinations(self.named(words))]
        if not configs:
            raise IzooError("the sweep has no values; give one or more, as in seed=0,1.")
        for config in configs:  # what cannot be read ends the sweep before anything is trained
            if hasattr(config, "contexts"):
                config.contexts.build()
        if len({getattr(config, "run_dir", number) for number, config in enumerate(configs)}) == len(configs):
            return configs
        if any(config.resume for config in configs):
            raise IzooError("a run is resumed once; leave its sweep out.")
        sweep = f"runs/{datetime.now():%Y-%m-%d_%H-%M-%S}-sweep"
        labels = [f"{number}-{config.algo.name}-seed{config.seed}" for number, config in enumerate(configs)]
        return [
            dataclasses.replace(config, run_dir=f"{config.run_dir or sweep}/{label}")
            for config, label in zip(configs, labels, strict=True)
        ]


def parse(words: Sequence[str]) -> list[Override]:
    """Parse ``option=value`` words; values that Hydra's grammar cannot read, such as odd paths, are taken literally.

    Raises:
        IzooError: a word is not of that form.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser, found = OverridesParser.create(), []
    for word in words:
        name, equals, value = word.partition("=")
        for attempt in (word, f"{name}={quoted(value)}") if equals else ():
            with contextlib.suppress(HydraException):
                found.append(parser.parse_override(attempt))
                break
        else:
            raise IzooError(f"{word!r} is not of the form option=value; --help lists the options.")
    return found


def combinations(words: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the words of every run of a sweep, such as ``seed=0,1``."""
    several = [
        [f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()]
        if override.is_sweep_override()
        else [str(override.input_line)]
        for override in parse(words)
    ]
    return list(itertools.product(*several))


def compose_config(cls: type[T], words: Sequence[str], defaults: Defaults | None = None) -> T:
    """Compose ``option=value`` words into the dataclass ``cls``.

    Args:
        cls: options of a command.
        words: without sweeps.
        defaults: given the written options by name, returns values by group and name, such as those of a run that is
            resumed, for what is not written.

    Raises:
        IzooError: an option or choice is unknown, or a value is refused.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from izoo import tasks
    from izoo.algos.learners import registry
    from izoo.conf.choices import choose, groups

    named = {}
    for override in parse(words):
        word, key = override.input_line, override.key_or_group
        if override.is_sweep_override():
            raise IzooError(
                f"{word!r} gives several values; add -m to run once for each, or quote it: {key}=\"'...'\"."
            )
        named[key] = override.value()
    values: dict[str, Any] = to_mapping(cls())
    chosen = {key: str(name) for key, name in named.items() if key in groups() and key.partition(".")[0] in values}
    if hasattr(cls, "role") and named.get("task") is not None:
        _merge(values, _of_task(cls, tasks.make(str(named["task"]))))
    if "algo" in chosen:
        _merge(values, registry.run_options(chosen["algo"]))
    _merge(values, {} if defaults is None else defaults(named))
    for group, name in chosen.items():
        choice = choose(group, name)
        _merge(values, functools.reduce(lambda inner, above: {above: inner}, reversed(group.split(".")), choice))
        _merge(values, {"env": getattr(choice, "sets", {})} if "env" in values else {})
    paths = [*_paths(values)]
    try:
        found = OmegaConf.create(values)
        for key, value in named.items():
            if key not in chosen:
                if key not in paths:
                    raise _unknown(key, paths)
                OmegaConf.update(found, key, value, merge=False)
        return from_mapping(cls, OmegaConf.to_container(found, resolve=True))  # type: ignore[arg-type]
    except OmegaConfBaseException as error:
        raise IzooError(f"the options do not fit together: {str(error).splitlines()[0]}") from error


def _of_task(cls: Any, task: Task) -> dict[str, Any]:
    """Return what a task sets, of the options that a command has."""
    env = {name: value for name, value in to_mapping(task.env).items() if name not in OF_THE_COMMAND}
    found = {"contexts": getattr(task, cls.role), "env": env}
    if cls.role == "train":
        return {**found, "action": task.action, **task.training}
    return {**found, "num_contexts": task.test_contexts, "seeds": task.test_episodes}


def _merge(values: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Change nested ``values``; a dataclass takes the place of a whole group."""
    for name, value in changes.items():
        if isinstance(value, Mapping) and isinstance(values.get(name), dict):
            _merge(values[name], value)
        else:
            values[name] = to_mapping(value)


def _unknown(key: str, paths: Sequence[str]) -> IzooError:
    """Return the error for an unknown option, which names the nearest, or the choices that have it."""
    from izoo.conf.choices import groups

    above, _, last = key.rpartition(".")
    having = [f"{above}={name}" for name, make in groups().get(above, {}).items() if last in to_mapping(make())]
    alike = (last, "".join(part[:1] for part in last.split("_")))  # the initials: learning_rate is lr
    near = [path for path in paths if path.rpartition(".")[2] in alike] or difflib.get_close_matches(key, paths, 1, 0.5)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    hint = f" It is an option of {' and '.join(having)}." if having else hint
    beside = [path for path in paths if path.rpartition(".")[0] == above] or [path for path in paths if "." not in path]
    return IzooError(f"unknown option {key!r}; choose one of: {', '.join(beside)}.{hint}")


def _paths(node: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield every option and group of options."""
    for name, value in node.items():
        yield f"{prefix}{name}"
        if isinstance(value, Mapping):
            yield from _paths(value, f"{prefix}{name}.")
