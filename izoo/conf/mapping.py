"""Turns composed options (plain mappings) into the frozen dataclasses, and back, naming whatever does not fit."""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from izoo.algos.learners.registry import AlgoConfig
from izoo.errors import IzooError, plain_number, unknown_choice

T = TypeVar("T")


def from_mapping(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """Build the dataclass ``cls`` from ``values``.

    A field whose type is a union of dataclasses is resolved by the mapping's ``name``, which each of those classes
    declares as a ``Literal`` field; that of an algorithm's hyper-parameters by its name in the registry.

    Args:
        cls: a dataclass.
        values: one entry per field that is not to keep its default.
        path: option path of ``values``, for messages.

    Raises:
        IzooError: a key is unknown, a value has the wrong type, or the dataclass refuses it.
    """
    hints: dict[str, Any] = field_types(cls)
    for key in values:
        if key not in hints:
            raise unknown_choice("option", _join(path, key), [_join(path, name) for name in hints])
    return cls(**{key: _convert(hints[key], value, _join(path, key)) for key, value in values.items()})


def to_mapping(config: Any) -> Any:
    """Return ``config`` as nested plain dicts, lists and scalars: what YAML can hold."""
    if dataclasses.is_dataclass(config):
        return {field.name: to_mapping(getattr(config, field.name)) for field in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {str(key): to_mapping(value) for key, value in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_mapping(value) for value in config]
    return config


def with_given(base: T, chosen: T, given: Iterable[str], group: str = "") -> T:
    """Return the options ``base`` with those of ``chosen`` that were written on the command line.

    Args:
        base, chosen: the same dataclass.
        given: paths of the options that were written.
        group: what this group of options is called, as ``env``; empty: they are all options.
    """
    merged, prefix = base, f"{group}." if group else ""
    # A group comes before its options.
    for path in sorted(name.removeprefix(prefix).split(".") for name in given if name.startswith(prefix)):
        merged = _with_option(merged, chosen, path)
    return merged


def _with_option(base: Any, chosen: Any, path: Sequence[str]) -> Any:
    """Return the dataclass ``base`` with the option at ``path`` taken from ``chosen``."""
    name, *rest = path
    value = getattr(chosen, name)
    return dataclasses.replace(base, **{name: _with_option(getattr(base, name), value, rest) if rest else value})


def field_types(cls: Any) -> dict[str, Any]:
    """Return the resolved type of each field of a dataclass, in order."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls) if field.init}


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else str(key)


def _convert(kind: Any, value: Any, path: str) -> Any:
    """Return ``value`` as ``kind``; integers pass for floats, whole floats for integers, and nothing else bends."""
    origin = get_origin(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(get_args(kind), value, path)
    if origin is Literal:
        if value not in get_args(kind):
            raise unknown_choice(path, value, get_args(kind))
        return value
    if origin in (tuple, list):
        return _convert_sequence(kind, value, path)
    if kind is AlgoConfig:
        if not isinstance(value, Mapping):
            raise IzooError(f"{path} is {value!r}; it is a group of options, one of which is name.")
        kind = AlgoConfig.of(value)
    if dataclasses.is_dataclass(kind):
        group: Any = kind
        if not isinstance(value, Mapping):
            raise IzooError(f"{path} is {value!r}; it is a group of options: {', '.join(field_types(group))}.")
        return from_mapping(group, value, path)
    return _convert_scalar(kind, value, path)


def _convert_union(kinds: Sequence[Any], value: Any, path: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    groups: list[Any] = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if groups and isinstance(value, Mapping):
        names = {get_args(field_types(kind)["name"])[0]: kind for kind in groups if "name" in field_types(kind)}
        name = value.get("name")
        if not isinstance(name, str) or name not in names:
            raise unknown_choice(_join(path, "name"), name, names)
        return from_mapping(names[name], value, path)
    problems = []
    for kind in kinds:
        try:
            return _convert(kind, value, path)
        except IzooError as problem:
            problems.append(problem)
    raise problems[0]


def _convert_sequence(kind: Any, value: Any, path: str) -> Any:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise IzooError(f"{path} is {value!r}; {_list_remedy(value, path)}")
    args = get_args(kind)
    if get_origin(kind) is list or (len(args) == 2 and args[1] is Ellipsis):
        converted = [_convert(args[0], item, f"{path}[{index}]") for index, item in enumerate(value)]
        return get_origin(kind)(converted)
    if len(args) != len(value):
        raise IzooError(f"{path} is {list(value)!r}; it must have {len(args)} entries.")
    return tuple(
        _convert(arg, item, f"{path}[{index}]") for index, (arg, item) in enumerate(zip(args, value, strict=True))
    )


def _list_remedy(value: Any, path: str) -> str:
    """Say how a list is written; one that has arrived as text, for its entries hold ``=``, lacks quotes."""
    if not (isinstance(value, str) and value.startswith("[") and value.endswith("]") and "=" in value):
        return "it must be a list, for example [1,2]."
    # A comma inside an entry, as in a.b=[8,8], stands before no name; inside braces it may.
    whole = ["a=1", "b=2"] if "{" in value else re.split(r",(?=[\s\"']*[\w.]+=)", value[1:-1])
    quoted = ",".join(f'"{entry}"' for entry in (part.strip(" \"'") for part in whole))
    return f"put double quotes around entries that hold =, and single quotes around the option: '{path}=[{quoted}]'."


def _convert_scalar(kind: Any, value: Any, path: str) -> Any:
    value = plain_number(value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if is_number and not math.isfinite(value):
        raise IzooError(f"{path} is {value!r}; it must be a finite number.")
    if kind is float and is_number:
        return float(value)
    if kind is int and is_number and float(value).is_integer():
        return int(value)
    if kind is str and (isinstance(value, str) or is_number):
        return str(value)
    if kind not in (int, float) and isinstance(kind, type) and isinstance(value, kind):
        return value
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null"}
    raise IzooError(f"{path} is {value!r}; it must be {words.get(kind, kind)}.")
