"""Turns composed options (plain mappings) into frozen dataclasses and back.

What an option may be is checked by its dataclass; here plain values become what its fields hold: tuples, whole numbers,
and the dataclass that a group's ``name`` chooses.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from omegaconf import OmegaConf

from izoo.algos.learners.registry import AlgoConfig, options_class
from izoo.errors import IzooError, plain_number, unknown_choice

T = TypeVar("T")


def from_mapping(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """Build the dataclass ``cls`` from ``values``.

    Args:
        cls: a dataclass.
        values: one entry per field that is not to keep its default.
        path: option path of ``values``, for messages.

    Raises:
        IzooError: a key is unknown, or the dataclass refuses a value.
    """
    kinds = field_types(cls)
    for key in values:
        if key not in kinds:
            raise unknown_choice("option", _join(path, key), [_join(path, name) for name in kinds])
    return cls(**{key: _convert(kinds[key], value, _join(path, key)) for key, value in values.items()})


def to_mapping(config: Any) -> Any:
    """Return ``config`` as nested plain dicts, lists and scalars: what YAML can hold."""
    if dataclasses.is_dataclass(config):
        return {field.name: to_mapping(getattr(config, field.name)) for field in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {str(key): to_mapping(value) for key, value in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_mapping(value) for value in config]
    return config


def to_yaml(config: Any) -> str:
    """Return ``config`` as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(to_mapping(config)))


def field_types(cls: Any) -> dict[str, Any]:
    """Return the resolved type of each field of a dataclass, in order."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else str(key)


def _convert(kind: Any, value: Any, path: str) -> Any:
    """Return ``value`` as ``kind`` where it can be; else as it is, for the dataclass to refuse."""
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, path)
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise IzooError(f"{path} is {value!r}; it is a group of options: {', '.join(field_types(kind))}.")
        group: Any = options_class(str(value.get("name"))) if kind is AlgoConfig else kind
        return from_mapping(group, value, path)
    if origin in (tuple, list) and isinstance(value, (tuple, list)):
        return origin(_convert(args[0], item, f"{path}[{index}]") for index, item in enumerate(value))
    value = plain_number(value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if number and (kind in (float, str) or (kind is int and value == int(value))):
        return kind(value)
    return value


def _convert_union(kinds: Sequence[Any], value: Any, path: str) -> Any:
    """Return ``value`` as the first of ``kinds`` that it can be; among groups of options, as the one of its name."""
    groups: list[Any] = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if groups and isinstance(value, Mapping):
        name, names = value.get("name"), {field_types(kind)["name"]: kind for kind in groups}
        for declared, kind in names.items():
            if name in get_args(declared) or (declared is str and ":" in str(name)):
                return from_mapping(kind, value, path)
        raise unknown_choice(
            _join(path, "name"), name, [get_args(declared)[0] for declared in names if declared is not str]
        )
    for kind in kinds:
        converted = _convert(kind, value, path)
        if _is(converted, kind):
            return converted
    return value


def _is(value: Any, kind: Any) -> bool:
    if kind is Any:
        return True
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    return type(value) is (get_origin(kind) or kind)
