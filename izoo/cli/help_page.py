"""The help page of a command whose options are a dataclass: their defaults, and what its docstring says of them."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from typing import TYPE_CHECKING, Any

from izoo.conf.recipes import RECIPES

if TYPE_CHECKING:
    from izoo.cli.option_command import OptionCommand

HELP_WIDTH = 110


def to_yaml(config: Any) -> str:
    """Return a configuration dataclass as YAML."""
    from omegaconf import OmegaConf

    from izoo.conf.mapping import to_mapping

    return OmegaConf.to_yaml(OmegaConf.create(to_mapping(config)))


def help_text(command: OptionCommand, config_class: type, groups: dict[str, tuple[str, ...]]) -> str:
    """Return the help page: usage, examples, choices, and every option with its default and meaning."""
    place = f" {command.place.upper()}" if command.place else ""
    lines = [command.summary, "", f"Usage: python -m izoo.{command.name}{place} [option=value ...]", "", "Examples:"]
    lines += [f"  python -m {example}" for example in command.examples]
    lines += ["", "Flags:", "  -h, --help      this page", "  -m, --multirun  run once for each combination of"]
    lines[-1] += " comma-separated values, as in seed=0,1,2"
    lines += ["  --cfg           print the resolved options and stop; with -m, those of every combination"]
    default = config_class()
    fields = [field.name for field in dataclasses.fields(config_class)]
    chosen = [name for name in groups if name in fields]
    if chosen:
        lines += ["", "Choices:"]
        lines += [f"  {name}={' | '.join(groups[name])}" for name in chosen]
    if command.recipes:
        lines += ["", "Recipes, sets of options that go together and that others change:"]
        lines += [f"  recipe={name}: {about}" for name, (about, _) in RECIPES.items()]
    note = " (another choice has options of its own: --cfg shows them)" if chosen else ""
    lines += ["", f"Options, with their defaults{note}:"]
    nested = [name for name in fields if dataclasses.is_dataclass(getattr(default, name))]
    lines += _describe({name: getattr(default, name) for name in fields if name not in nested}, "", config_class)
    for name in nested:
        lines += ["", f"{name}:"]
        lines += _describe_group(getattr(default, name), name)
    return "\n".join(lines)


def _describe_group(group: Any, path: str) -> list[str]:
    values = {field.name: getattr(group, field.name) for field in dataclasses.fields(group) if field.name != "name"}
    plain = {key: value for key, value in values.items() if not dataclasses.is_dataclass(value)}
    lines = _describe(plain, f"{path}.", type(group))
    for key, value in values.items():
        if key not in plain:
            lines += _describe_group(value, f"{path}.{key}")
    return lines


def _describe(values: dict[str, Any], prefix: str, owner: type) -> list[str]:
    meanings = attribute_docs(owner)
    lines = []
    for name, value in values.items():
        lines.append(f"  {prefix}{name}={as_word(value)}")
        lines += textwrap.wrap(meanings.get(name, ""), HELP_WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return lines


def as_word(value: Any) -> str:
    """Return a value as it is written on a command line."""
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(as_word(item) for item in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def attribute_docs(owner: type) -> dict[str, str]:
    """Return what is said of each attribute of a class, by name.

    It is said in the ``Attributes:`` sections of the class's docstring and its bases', or by ``help`` in a field's
    metadata.
    """
    docs: dict[str, str] = {}
    for part in reversed(owner.__mro__[:-1]):
        docs.update(_section(inspect.cleandoc(part.__doc__ or "")))
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    return docs | {field.name: field.metadata["help"] for field in fields if "help" in field.metadata}


def _section(text: str) -> dict[str, str]:
    _, _, section = text.partition("Attributes:\n")
    docs: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        head = re.match(r"    (\w+(?:, \w+)*): (.*)", line)
        if head:
            names = [name.strip() for name in head.group(1).split(",")]
            docs.update({name: head.group(2) for name in names})
        elif names and line.startswith("        "):
            docs.update({name: f"{docs[name]} {line.strip()}" for name in names})
        elif line.strip():
            break
    # "null" is what can be typed where Python says None.
    return {name: doc.replace("``None``", "null").replace("``", "") for name, doc in docs.items()}
