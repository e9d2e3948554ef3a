"""Errors that a user can mend: they name the value, the legal set and the remedy.

Commands print an :class:`IzooError` as one sentence and exit with code 2, and an :class:`UnfinishedError` with code 1;
every other exception is a defect of izoo and keeps its traceback.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import numbers
import types
import typing
import unicodedata
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, TypeAlias


class IzooError(ValueError):
    """Something the caller gave cannot be used; the message says what to do about it."""


class UnfinishedError(RuntimeError):
    """Work that had begun cannot be finished; the message says what is kept and how to go on.

    Commands print it as one sentence and exit with code 1.
    """


def unknown_choice(what: str, value: object, legal: Iterable[object]) -> IzooError:
    """Return the error for ``value`` outside a set of names.

    Args:
        what: what the value chooses, for example ``"hour"``.
        value: the value that was given.
        legal: the values that would have been accepted.
    """
    names = [str(name) for name in legal]
    close = difflib.get_close_matches(str(value), names, n=1, cutoff=0.5)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return IzooError(f"unknown {what} {plain_number(value)!r}; choose one of: {', '.join(names)}.{hint}")


def check_choice(what: str, value: object, legal: Iterable[object]) -> None:
    """Raise :func:`unknown_choice` unless ``value`` is one of ``legal``."""
    names = list(legal)
    if value not in names:
        raise unknown_choice(what, value, names)


def check_range(what: str, value: Any, low: float, high: float, unit: str = "") -> None:
    """Raise :class:`IzooError` unless ``value`` is a number in ``[low, high]`` (NaN is outside every range)."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise IzooError(f"{what} is {plain_number(value)!r}; it must be a number in {_interval(low, high, unit)}.")
    number: Any = value
    if not low <= number <= high:
        raise IzooError(f"{what} is {plain_number(value)!r}; it must lie in {_interval(low, high, unit)}.")


def _interval(low: float, high: float, unit: str) -> str:
    return f"[{_bound(low)}, {_bound(high)}]{f' {unit}' if unit else ''}"


def _bound(value: float) -> str:
    """Return a bound in short; in full where that would round a whole number."""
    short = f"{value:g}"
    is_whole = math.isfinite(value) and value == int(value)
    return str(int(value)) if is_whole and float(short) != value else short


def check_whole(what: str, value: object, low: int, high: int) -> int:
    """Return ``value``; raise :class:`IzooError` unless it is a whole number in ``[low, high]``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not low <= int(value) <= high:
        raise IzooError(f"{what} is {plain_number(value)!r}; it must be a whole number from {low} to {high}.")
    return int(value)


def check_seed(seed: object, what: str = "seed") -> int:
    """Return ``seed``; raise :class:`IzooError` unless it is a whole number that generators take."""
    return check_whole(what, seed, 0, 2**63 - 1)


def plain_number(value: Any) -> Any:
    """Return a scalar of NumPy's as one of Python's, which JSON and YAML know; other values as they are."""
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value


def check_line(what: str, text: str) -> None:
    """Raise :class:`IzooError` unless a text is one line that every table can hold."""
    if not text or any(unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") for character in text):
        raise IzooError(f"{what} is {text!a}; give one line of text, without control characters.")


def check_types(group: str, config: Any) -> None:
    """Make every field of a frozen dataclass hold the type that it declares.

    Finite numbers, switches, texts, names out of a few, what may be missing (``None``), and lists of them are checked;
    whole numbers pass for real ones and the other way round, numbers for texts, lists for tuples, numbers of NumPy's
    for Python's. Other fields check themselves.

    Args:
        group: the group of options, for messages; empty where there is none.
        config: an instance; its class must be defined in a module, where its annotations can be read.

    Raises:
        IzooError: a field holds something else.
    """
    for name, kind in typing.get_type_hints(type(config)).items():
        legal = _legal(kind)
        if legal is not None and hasattr(config, name):
            value = getattr(config, name)
            fitting = _fitting(legal, value)
            if not fitting:
                option = f"{group}.{name}" if group else name
                raise IzooError(f"{option} is {value!r}; it must be {' or '.join(word for word, _ in legal)}.")
            object.__setattr__(config, name, fitting[0])


Ranges: TypeAlias = tuple[tuple[Any, ...], ...]


class CheckedOptions:
    """Base of frozen dataclasses of options: when one is made, values become of the declared types
    (:func:`check_types`), and their ranges are checked.

    Attributes:
        group: of the options, for messages; empty where there is none.
        ranges: names that are separated by blanks, lowest and highest value of these numbers, and perhaps their unit; a
            class adds to those of its bases.
    """

    group: ClassVar[str] = ""
    ranges: ClassVar[Ranges] = ()

    def __post_init__(self) -> None:
        check_types(self.group, self)
        for part in reversed(type(self).__mro__):
            for names, *limits in vars(part).get("ranges", ()):
                for name in names.split():
                    if (value := getattr(self, name)) is not None:
                        check_range(f"{self.group}.{name}" if self.group else name, value, *limits)


_Kind = tuple[str, Callable[[Any], Any]]
"""A type in words, and what returns a value of it, or raises :class:`TypeError` or :class:`OverflowError`."""


def _fitting(legal: list[_Kind], value: Any) -> list[Any]:
    """Return what a value can be of some types; what it is already comes first."""
    found = []
    for _, convert in legal:
        with contextlib.suppress(TypeError, OverflowError):
            found.append(convert(plain_number(value)))
    return sorted(found, key=lambda each: type(each) is not type(value))


def _scalar(kind: type) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if number and kind in (int, float, str) and math.isfinite(value) and (kind is not int or value == int(value)):
            return kind(value)
        if number or type(value) is not kind:
            raise TypeError
        return value

    return convert


_WORDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text", type(None): "null"}
_SCALARS: dict[Any, _Kind] = {kind: (word, _scalar(kind)) for kind, word in _WORDS.items()}


def _legal(kind: Any) -> list[_Kind] | None:
    """Return the types that a declared one allows; ``None``: it is not one that is checked here."""
    if kind in _SCALARS:
        return [_SCALARS[kind]]
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        parts = [_legal(arg) for arg in args]
        return None if None in parts else [entry for part in parts for entry in part or ()]
    if origin is typing.Literal:
        words = [str(arg) for arg in args]

        def one_of(value: Any) -> Any:
            if value not in args:
                raise TypeError
            return value

        return [(words[0] if len(words) == 1 else f"one of {', '.join(words)}", one_of)]
    if (origin is list or (origin is tuple and args[1:] == (Ellipsis,))) and (inner := _legal(args[0])) is not None:

        def each(value: Any) -> Any:
            fitting = [_fitting(inner, item) for item in value] if isinstance(value, (tuple, list)) else [[]]
            if not all(fitting):
                raise TypeError
            return origin(item[0] for item in fitting)

        return [(f"a list, each entry {' or '.join(word for word, _ in inner)}", each)]
    return None
