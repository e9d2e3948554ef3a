"""The help page of a command whose options are a dataclass: their defaults, and what its docstring says of them."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from izoo import tasks
from izoo.conf.choices import TAKES_OWN, groups
from izoo.options import to_mapping, written

if TYPE_CHECKING:
    from izoo.cli.option_command import OptionCommand

FLAGS = """
Flags:
  -h, --help      this page; of other choices' options too, as in --help algo=ddpg
  -m, --multirun  run once for each combination of comma-separated values, as in seed=0,1,2
  --cfg           print the resolved options and stop; with -m, those of every combination"""
ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)


def overview(command: OptionCommand) -> str:
    """Return the first part of a help page, which takes no PyTorch: usage, examples, choices and tasks."""
    cls, place = command.config_class(), f" {command.place.upper()}" if command.place else ""
    lines = [command.summary, "", f"Usage: python -m izoo.{command.name}{place} [option=value ...]", "", "Examples:"]
    lines += [*(f"  python -m {example}" for example in command.examples), FLAGS]
    own = {field.name for field in dataclasses.fields(cls)}
    chosen = {group: [*names] for group, names in groups().items() if group.partition(".")[0] in own}
    if chosen:
        lines += ["", "Choices:"]
    for group, names in chosen.items():
        lines.append(f"  {group}={' | '.join(names + ['module:name'] * (group in TAKES_OWN))}")
    if hasattr(cls, "role"):
        lines += ["", "Tasks, or module:NAME; what is known to learn there in brackets:"]
        for name, task in tasks.tasks().items():
            if not name.endswith(tasks.PAPER):
                lines += _wrapped(f"  task={name}: {task.about} [{task.learns}]")
        lines += _wrapped(f"  task=NAME{tasks.PAPER}: any of these as in the paper: its decisions and reward.")
    return "\n".join(lines)


def options(config: Any) -> str:
    """Return the second part: every option with its value and meaning."""
    return "\n".join(["", "Options, with their defaults:", *_describe(config, "")])


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 110, subsequent_indent="      ")


def _describe(config: Any, prefix: str) -> Iterator[str]:
    """Yield the options of a group, then its groups."""
    meanings = attribute_docs(type(config))
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    nested = {name: value for name, value in values.items() if dataclasses.is_dataclass(value)}
    for name, value in values.items():
        if name not in nested and (name != "name" or not prefix):
            yield f"  {prefix}{name}={written(to_mapping(value))}"
            yield from _wrapped(f"      {meanings.get(name, '')}")
    for name, value in nested.items():
        yield from ("", f"{prefix}{name}{f'={value.name}' if hasattr(value, 'name') else ''}:")
        yield from _describe(value, f"{prefix}{name}.")


def attribute_docs(owner: type) -> dict[str, str]:
    """Return what is said of each attribute of a class, by name.

    It is said in the ``Attributes:`` sections of the class's docstring and its bases', or by ``help`` in a field's
    metadata.
    """
    docs: dict[str, str] = {}
    for part in reversed(owner.__mro__[:-1]):
        section = inspect.cleandoc(part.__doc__ or "").partition("Attributes:\n")[2].partition("\n\n")[0]
        for names, text in ATTRIBUTE.findall(section):
            # "null" is what can be typed where Python says None.
            meaning = " ".join(text.split()).replace("``None``", "null").replace("``", "")
            docs |= dict.fromkeys(names.split(", "), meaning)
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    return docs | {field.name: field.metadata["help"] for field in fields if "help" in field.metadata}
