"""Errors that a user can mend: they name the value, the legal set and the remedy.

Commands print an :class:`IzooError` as one sentence and exit with code 2, and an :class:`UnfinishedError` with code 1;
every other exception is a defect of izoo and keeps its traceback.
"""

from __future__ import annotations

import difflib
import math
import numbers
import unicodedata
from collections.abc import Iterable
from typing import Any


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
