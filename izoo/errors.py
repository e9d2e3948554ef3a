"""Errors that a user can mend: they name the value, the legal set and the remedy.

Commands print an :class:`IzooError` as one sentence and exit with code 2; every other exception is a defect of izoo
and keeps its traceback.
"""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable
from pathlib import Path


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


def os_reason(error: OSError) -> str:
    """Return why a file or folder could not be made or written, where the system's "File exists" would mislead."""
    if error.errno == errno.ENOTDIR:
        return "a folder of its path is a file"
    if error.errno == errno.EEXIST and error.filename is not None and not Path(error.filename).is_dir():
        what = "a link that leads nowhere" if Path(error.filename).is_symlink() else "a file"
        return f"{error.filename} is {what}"
    return error.strerror or str(error)


def check_folder(folder: Path, remedy: str) -> None:
    """Raise :class:`IzooError`, which ends with what to give instead, unless ``folder`` is one."""
    if not folder.is_dir():
        raise IzooError(f"{folder} is {'a file' if folder.exists() else 'no folder'}; {remedy}.")
