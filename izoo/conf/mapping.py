"""Turns composed options (plain mappings) into frozen dataclasses and back.

A dataclass checks and converts its values (:class:`izoo.errors.CheckedOptions`); here a group of options becomes the
dataclass that its ``name`` chooses.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin

from omegaconf import OmegaConf

from izoo.algos.learners.registry import AlgoConfig, options_class
from izoo.errors import IzooError, unknown_choice

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
    """Return a mapping as the group of options that its ``name`` chooses, also in a list; other values as they are."""
    groups: list[Any] = [part for part in (kind, *get_args(kind)) if dataclasses.is_dataclass(part)]
    if get_origin(kind) is list and isinstance(value, list) and isinstance(get_args(kind)[0], types.UnionType):
        return [_convert(get_args(kind)[0], item, f"{path}[{index}]") for index, item in enumerate(value)]
    if not groups:
        return value
    if not isinstance(value, Mapping):
        raise IzooError(f"{path} is {value!r}; it is a group of options: {', '.join(field_types(groups[0]))}.")
    name = value.get("name")
    if groups == [AlgoConfig]:
        return from_mapping(options_class(str(name)), value, path)
    if len(groups) == 1:
        return from_mapping(groups[0], value, path)
    names = [(field_types(group)["name"], group) for group in groups]
    for declared, group in names:
        if name in get_args(declared) or (declared is str and ":" in str(name)):
            return from_mapping(group, value, path)
    raise unknown_choice(_join(path, "name"), name, [get_args(kind)[0] for kind, _ in names if kind is not str])
