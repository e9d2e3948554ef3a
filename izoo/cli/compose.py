"""From words on a command line to a dataclass: Hydra parses them, and choices come from the dataclasses.

A group such as ``algo=ddpg`` takes the place of all its options; ``task=NAME`` changes the defaults of what belongs to
a task; every other word changes one option.
"""

from __future__ import annotations

import difflib
import functools
import itertools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from izoo import tasks
from izoo.algos.learners import registry
from izoo.conf.choices import choose, groups
from izoo.conf.mapping import from_mapping, to_mapping
from izoo.conf.quoting import quoted
from izoo.errors import IzooError

T = TypeVar("T")
Defaults = Callable[[Mapping[str, Any]], Mapping[str, Any]]
FOLDERS = ("run_dir", "out")
"""Options that name a folder to write."""
OF_THE_COMMAND = ("emit", "drain_s")
"""Settings of the environment that say what a command needs, whatever the task."""


def parse(words: Sequence[str]) -> list[Override]:
    """Parse ``option=value`` words; values that Hydra's grammar cannot read, such as odd paths, are taken literally.

    Raises:
        IzooError: a word is not of that form.
    """
    parser, overrides = OverridesParser.create(), []
    for word in words:
        name, equals, value = word.partition("=")
        for attempt in (word, f"{name}={quoted(value)}"):
            try:
                overrides.append(parser.parse_override(attempt))
                break
            except HydraException:
                continue
        else:
            equals = ""
        if not equals:
            raise IzooError(f"{word!r} is not of the form option=value; --help lists the options.")
    return overrides


def combinations(words: Sequence[str]) -> list[list[str]]:
    """Return the words of every run of a sweep, such as ``seed=0,1``."""
    several = [
        [f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()]
        if override.is_sweep_override()
        else [str(override.input_line)]
        for override in parse(words)
    ]
    return [list(combination) for combination in itertools.product(*several)]


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
    overrides = parse(words)
    for override in overrides:
        if override.is_sweep_override():
            word, key = override.input_line, override.key_or_group
            raise IzooError(
                f"{word!r} gives several values; add -m to run once for each, or quote it: {key}=\"'...'\"."
            )
    named = {override.key_or_group: override.value() for override in overrides}
    values: dict[str, Any] = to_mapping(cls())  # type: ignore[call-arg]
    chosen = {key: str(value) for key, value in named.items() if key in groups() and key in _paths(values)}
    if hasattr(cls, "role") and named.get("task") is not None:
        _merge(values, _of_task(cls, tasks.make(str(named["task"]))))
    if "algo" in chosen:
        _merge(values, registry.run_options(chosen["algo"]))
    _merge(values, {} if defaults is None else defaults(named))
    for group, name in chosen.items():
        choice = choose(group, name)
        *above, last = group.split(".")
        functools.reduce(operator.getitem, above, values)[last] = to_mapping(choice)
        _merge(values, {"env": getattr(choice, "sets", {})} if "env" in values else {})
    try:
        found = OmegaConf.create(values)
        for key, value in named.items():
            if key not in chosen:
                if key not in _paths(values):
                    raise _unknown(key, [*_paths(values)])
                OmegaConf.update(found, key, value, merge=False)
        return from_mapping(cls, OmegaConf.to_container(found, resolve=True))  # type: ignore[arg-type]
    except OmegaConfBaseException as error:
        raise IzooError(f"the options do not fit together: {str(error).splitlines()[0]}") from error


def _of_task(cls: Any, task: tasks.Task) -> dict[str, Any]:
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
    above, _, last = key.rpartition(".")
    having = [f"{above}={name}" for name, make in groups().get(above, {}).items() if last in to_mapping(make())]
    initials = "".join(part[:1] for part in last.split("_"))  # of learning_rate
    leaves = {path.rpartition(".")[2]: path for path in reversed(paths)}
    alike = (last, initials, *difflib.get_close_matches(last, leaves, 1, 0.75))
    near = [*difflib.get_close_matches(key, paths, 1, 0.8), *(leaves[name] for name in alike if name in leaves)]
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
