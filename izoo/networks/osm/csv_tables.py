"""CSV tables that users give with an extract."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from izoo.errors import IzooError
from izoo.files import expanded


def read_rows(
    path: Path | str, what: str, columns: Sequence[str], or_columns: Sequence[str] = ()
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield where each row stands, in words, and its values by column, without spaces around them.

    Args:
        path: the file.
        what: it holds, for messages.
        columns: that it must have, in any order and case.
        or_columns: at least one of these it must have too; those it lacks are empty.

    Raises:
        IzooError: the file cannot be read, or lacks columns.
    """
    path = expanded(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            names = {name.strip().lower(): name for name in reader.fieldnames or []}
            if not set(columns) <= set(names) or (or_columns and not set(or_columns) & set(names)):
                listed = ", ".join(columns) + (f", and {' or '.join(or_columns)}" if or_columns else "")
                raise IzooError(f"{path} needs a header with the columns {listed}; it has {list(names)}.")
            for row in reader:
                values = {name: (row.get(names.get(name, "")) or "").strip() for name in (*columns, *or_columns)}
                yield f"{path}, line {reader.line_num}", values
    except OSError as error:
        raise IzooError(f"cannot read {what} {path}: {error.strerror}; give a CSV file.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise IzooError(f"{path} cannot be read as a CSV table ({error}).") from error


def number(text: str, most: float, what: str, unit: str, place: str) -> float:
    """Return a number from 0 to ``most``; raises :class:`IzooError` for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= most:
        raise IzooError(f"{place}: {text!r} is not a usable {what}; write {unit} between 0 and {most:,.0f}.")
    return value
