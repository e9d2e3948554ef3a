"""Options: frozen dataclasses whose values become of the declared types, and plain values and words again."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import numbers
import re
import types
import typing
from collections.abc import Collection, Mapping
from typing import Any, ClassVar, TypeAlias, TypeVar, get_args, get_origin

from izoo.errors import IzooError, check_range, plain_number, unknown_choice

T = TypeVar("T")
Ranges: TypeAlias = tuple[tuple[Any, ...], ...]
_WORDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text", type(None): "null"}


class CheckedOptions:
    """Base of frozen dataclasses of options: when one is made, values become of the declared types.

    Finite numbers, switches, texts, names out of a few, what may be missing (``None``), lists of them, and groups of
    options are converted: whole numbers pass for real ones and the other way round, numbers for texts, lists for
    tuples, numbers of NumPy's for Python's, mappings for groups. Fields of other types are taken as they are.

    Attributes:
        group: of the options, for messages; empty where there is none.
        ranges: names that are separated by blanks, lowest and highest value of these numbers, and perhaps their unit; a
            class adds to those of its bases.
    """

    group: ClassVar[str] = ""
    ranges: ClassVar[Ranges] = ()

    def __post_init__(self) -> None:
        for name, kind in field_types(type(self)).items():
            object.__setattr__(self, name, _converted(kind, getattr(self, name), _join(self.group, name)))
        for part in reversed(type(self).__mro__):
            for names, *limits in vars(part).get("ranges", ()):
                for name in names.split():
                    if (value := getattr(self, name)) is not None:
                        check_range(_join(self.group, name), value, *limits)

    @classmethod
    def class_of(cls, name: str) -> Any:
        """Return the class of the options that are called ``name``: this one, or one that is derived from it."""
        return cls


def from_mapping(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """Build a dataclass.

    Args:
        cls: the dataclass.
        values: one entry per field that is not to keep its default.
        path: option path of ``values``, for messages.

    Raises:
        IzooError: a key is unknown, or the dataclass refuses a value.
    """
    kinds = field_types(cls)
    for key in values:
        if key not in kinds:
            raise unknown_choice("option", _join(path, key), [_join(path, name) for name in kinds])
    return cls(**values)


def to_mapping(config: Any) -> Any:
    """Return ``config`` as nested plain dicts, lists and scalars: what YAML can hold."""
    if dataclasses.is_dataclass(config):
        return {field.name: to_mapping(getattr(config, field.name)) for field in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {str(key): to_mapping(value) for key, value in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_mapping(value) for value in config]
    return config


def field_types(cls: Any) -> Mapping[str, Any]:
    """Return the resolved type of each field of a dataclass, in order."""
    return _resolved(cls)


@functools.cache  # of this one, since mypy takes no class for the argument of a cached function
def _resolved(cls: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else str(key)


def _converted(kind: Any, value: Any, path: str) -> Any:
    """Return the value of an option as one of its declared type; raises :class:`IzooError` where it cannot be one."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is list and isinstance(value, (list, tuple)) and _groups(args[0]):
        return [_converted(args[0], item, f"{path}[{place}]") for place, item in enumerate(value)]
    if groups := _groups(kind):
        return value if isinstance(value, tuple(groups)) else _group(groups, value, path)
    try:
        return _fit(kind, value)
    except (TypeError, OverflowError):
        raise IzooError(f"{path} is {value!r}; it must be {_words(kind)}.") from None


def _groups(kind: Any) -> list[Any]:
    """Return the dataclasses that a type is, or may be."""
    return [part for part in (kind, *get_args(kind)) if dataclasses.is_dataclass(part)]


def _group(groups: list[Any], value: Any, path: str) -> Any:
    """Return the group of options that the ``name`` in a mapping chooses."""
    if not isinstance(value, Mapping):
        raise IzooError(f"{path} is {value!r}; it is a group of options: {', '.join(field_types(groups[0]))}.")
    name = str(value.get("name"))
    if len(groups) == 1:
        return from_mapping(groups[0].class_of(name), value, path)
    names = {group: get_args(field_types(group)["name"]) for group in groups}  # none: any module:name
    for group, legal in names.items():
        if name in legal or (not legal and ":" in name):
            return from_mapping(group, value, path)
    raise unknown_choice(_join(path, "name"), name, [each for legal in names.values() for each in legal])


def _fit(kind: Any, value: Any) -> Any:
    """Return a value as one of a type; raises :class:`TypeError` or :class:`OverflowError` where it cannot be one."""
    origin, args, plain = get_origin(kind), get_args(kind), plain_number(value)
    number = isinstance(plain, numbers.Real) and not isinstance(plain, bool)
    if origin in (typing.Union, types.UnionType):
        found = []
        for part in args:
            with contextlib.suppress(TypeError, OverflowError):
                found.append(_fit(part, value))
        if found:
            return min(found, key=lambda each: type(each) is not type(plain))  # what it is already comes first
    elif origin is typing.Literal:
        if plain in args:
            return plain
    elif origin is list or (origin is tuple and args[1:] == (Ellipsis,)):
        if isinstance(value, (tuple, list)):
            return origin(_fit(args[0], item) for item in value)
    elif kind not in _WORDS:
        return value
    elif not number:
        if type(plain) is kind:
            return plain
    elif kind in (int, float, str) and math.isfinite(plain) and (kind is not int or plain == int(plain)):
        return kind(plain)
    raise TypeError


def _words(kind: Any) -> str:
    """Say what a type is."""
    args = get_args(kind)
    if get_origin(kind) is typing.Literal:
        return str(args[0]) if len(args) == 1 else f"one of {', '.join(map(str, args))}"
    if get_origin(kind) in (list, tuple):
        return f"a list, each entry {_words(args[0])}"
    return " or ".join(map(_words, args)) if args else _WORDS.get(kind, getattr(kind, "__name__", str(kind)))


def quoted(text: str) -> str:
    """Return a text in single quotes, as Hydra's parser of command lines reads it back."""
    escaped = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + ("\\'" if match[2] else ""), text)
    return f"'{escaped}'"


def written(value: Any, elsewhere: Collection[str] = (), name: str = "") -> str:
    """Return the value of an option as it is written on a command line.

    Args:
        value: of the option ``name``: plain numbers, switches, texts, lists and mappings.
        elsewhere: names of options whose places are of one machine: ``FOLDER`` stands for them.
    """
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{written(entry, elsewhere, key)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(written(entry, elsewhere) for entry in value) + "]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if name in elsewhere:
        return "FOLDER"
    text = f"{value:.6g}" if isinstance(value, float) and float(f"{value:.6g}") == value else str(value)
    return text if re.fullmatch(r"[\w.+/-]+", text) else quoted(text)
