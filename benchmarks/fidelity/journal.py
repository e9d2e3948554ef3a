"""Results that are no rows of the table, kept as they come, so that a comparison goes on where it was stopped."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.errors import IzooError
from izoo.files import read_text, write_text

Key = tuple[Any, ...]


class Journal:
    """Results by key, each a line of JSON in a file; a last line that was cut short is dropped.

    Args:
        path: of the file.

    Attributes:
        rows: results by key; a key holds texts, numbers and booleans.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, {}  # type: tuple[Path, dict[Key, dict[str, Any]]]
        try:
            text = read_text(path) if path.exists() else ""
            lines = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
            self.rows = {tuple(line["key"]): line["row"] for line in lines}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise IzooError(f"cannot read {path}: {error!r}; remove it, and it is made anew.") from error
        if text and not text.endswith("\n"):
            write_text(path, text[: text.rfind("\n") + 1])

    def add(self, key: Key, row: dict[str, Any]) -> None:
        """Keep a result."""
        self.rows[key] = row
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, "row": row}) + "\n")

    def table(self, keys: Iterable[Key]) -> pd.DataFrame:
        """Return the results of those of ``keys`` that are there, in their order."""
        return pd.DataFrame([self.rows[key] for key in keys if key in self.rows])
