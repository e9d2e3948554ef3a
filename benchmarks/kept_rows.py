"""Rows of a comparison that goes on where it was stopped: each is kept in a file as soon as it is there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.files import write_text

Key = tuple[Any, ...]
TYPES = {"parted": "Int64"}
"""Columns of whole numbers some of which are missing."""


class KeptRows:
    """A table in a CSV file, a row per key.

    A file of a version that had other columns is begun anew.

    Args:
        path: of the file.
        columns: all of the table's.
        key: those that tell its rows apart.
    """

    def __init__(self, path: Path, columns: Sequence[str], key: Sequence[str]) -> None:
        self._path, self._columns, self._key = path, list(columns), list(key)
        self._rows: dict[Key, dict[str, Any]] = {}
        table = pd.read_csv(path, dtype=TYPES) if path.exists() else pd.DataFrame()
        if list(table) == self._columns:
            self._rows = {tuple(row[name] for name in self._key): row for row in table.to_dict("records")}

    def __contains__(self, key: Key) -> bool:
        return key in self._rows

    def add(self, row: dict[str, Any]) -> None:
        """Keep a row that has all columns."""
        self._rows[tuple(row[name] for name in self._key)] = row
        write_text(self._path, self.table(self._rows).to_csv(index=False))

    def table(self, keys: Iterable[Key]) -> pd.DataFrame:
        """Return the rows of those of ``keys`` that are there, in their order."""
        found = [self._rows[key] for key in keys if key in self._rows]
        return pd.DataFrame(found, columns=self._columns).astype(TYPES)
