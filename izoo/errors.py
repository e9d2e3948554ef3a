"""Errors that a user can mend: they name the value, the legal set and the remedy.

Commands print an :class:`IzooError` as one sentence and exit with code 2; every other exception is a defect of izoo
and keeps its traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class IzooError(ValueError):
    """Something the caller gave cannot be used; the message says what to do about it."""


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
    return IzooError(f"unknown {what} {value!r}; choose one of: {', '.join(names)}.{hint}")


def check_choice(what: str, value: object, legal: Iterable[object]) -> None:
    """Raise :func:`unknown_choice` unless ``value`` is one of ``legal``."""
    names = list(legal)
    if value not in names:
        raise unknown_choice(what, value, names)


def check_range(what: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise :class:`IzooError` unless ``low <= value <= high`` (NaN is outside every range)."""
    if not low <= value <= high:
        suffix = f" {unit}" if unit else ""
        raise IzooError(f"{what} is {value!r}; it must lie in [{low:g}, {high:g}]{suffix}.")
