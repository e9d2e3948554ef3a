"""Rows of a comparison that goes on where it was stopped: each is kept in a file as soon as it is there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from pandas.errors import EmptyDataError, ParserError

from izoo.files import write_text

Key = tuple[Any, ...]


class KeptRows:
    """A table in a CSV file, a row per key.

    A file that is no such table, or has the columns of another version, is begun anew, which is said.

    Args:
        path: of the file.
        types: columns of the table, and what they hold: ``str``, ``bool``, ``int64``, ``float``, or ``Int64``, of which
            some may be missing.
        key: columns that tell rows apart.
    """

    def __init__(self, path: Path, types: Mapping[str, str], key: Sequence[str]) -> None:
        self._path, self._types, self._key = path, dict(types), list(key)
        table = _read(path, self._types)
        self._rows = {self._key_of(row): row for row in table.to_dict("records")}

    def __contains__(self, key: Key) -> bool:
        return key in self._rows

    def add(self, row: dict[str, Any]) -> None:
        """Keep a row that has all columns."""
        self._rows[self._key_of(row)] = row
        write_text(self._path, self.table(self._rows).to_csv(index=False))

    def table(self, keys: Iterable[Key]) -> pd.DataFrame:
        """Return the rows of those of ``keys`` that are there, in their order."""
        found = [self._rows[key] for key in keys if key in self._rows]
        return pd.DataFrame(found, columns=list(self._types)).astype(self._types)

    def _key_of(self, row: Mapping[str, Any]) -> Key:
        return tuple(row[name] for name in self._key)


def _read(path: Path, types: Mapping[str, str]) -> pd.DataFrame:
    """Return the table of a file; an empty one where there is none, or something else."""
    if not path.exists():
        return pd.DataFrame()
    try:
        found = pd.read_csv(
            path,
            dtype=dict(types),
            keep_default_na=False,
            na_values={name: [""] for name, kind in types.items() if kind != "str"},
        )
    except (EmptyDataError, ParserError, ValueError):
        found = pd.DataFrame()
    if list(found) != list(types):
        print(f"{path} was not written by this version; it is begun anew.", flush=True)
        return pd.DataFrame()
    return found
