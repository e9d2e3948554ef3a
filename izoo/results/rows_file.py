"""Rows of a CSV file, appended in groups that are there whole or not at all: a blank line ends the header and each."""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from izoo.console import Progress
from izoo.errors import IzooError
from izoo.files import read_text, write_text

Row = dict[str, Any]
Key = tuple[Any, ...]
Of = TypeVar("Of")


class RowsFile:
    """A CSV file and its rows.

    Args:
        path: of the file; ``None`` keeps rows in memory.
        columns: in order.
        text, whole: names of columns of words and of whole numbers; all others are floats, or true and false.
        optional: names of columns that a file may lack; they are then empty.

    Attributes:
        rows: those of the groups that are whole.
    """

    def __init__(
        self,
        path: Path | None,
        columns: Sequence[str],
        text: Sequence[str] = (),
        whole: Sequence[str] = (),
        optional: Sequence[str] = (),
    ) -> None:
        self.path, self.columns, self.text, self.whole = path, tuple(columns), tuple(text), tuple(whole)
        self.optional = frozenset(optional)
        self.rows: list[Row] = []

    def read(self, mend: bool = True) -> RowsFile:
        """Read what is there, and with ``mend`` write the file anew where a group was cut short or columns differ.

        Raises:
            IzooError: the file cannot be read, or lacks columns.
        """
        if self.path is None or not self.path.exists():
            return self
        try:
            text = read_text(self.path)
            lines = csv.reader(io.StringIO(text[: text.rfind("\n\n") + 1] or text))
            names, *records = [line for line in lines if line] or [[]]
            for record in records:
                if len(record) != len(names):
                    raise ValueError(f"a row has {len(record)} cells, and the header {len(names)}")
            cells = [dict(zip(names, record, strict=True)) for record in records]
            rows = [{column: self._value(column, row.get(column, "")) for column in self.columns} for row in cells]
        except (OSError, ValueError, csv.Error) as error:
            raise IzooError(f"cannot read {self.path}: {str(error).splitlines()[0]}; choose another folder.") from error
        missing = [column for column in self.columns if column not in names and column not in self.optional]
        if missing:
            raise IzooError(
                f"{self.path} lacks the column(s) {', '.join(missing)}: another version of izoo wrote it; choose "
                "another folder."
            )
        self.rows = rows
        if mend and not (tuple(names) == self.columns and text.endswith("\n\n")):
            self.replace(self.rows)
        return self

    def add(self, rows: Sequence[Row]) -> None:
        """Append a group of rows, all of them or none."""
        self.rows.extend(rows)
        if self.path is not None:
            with self.path.open("a", encoding="utf-8", newline="") as file:
                file.write(self._lines(rows, header=not file.tell()))

    def fill(self, key: Sequence[str], wanted: Mapping[Key, Of], make: Callable[[Key, Of], Sequence[Row]]) -> list[Row]:
        """Return the rows of what is wanted; those of what the file lacks are made, and kept group by group.

        Args:
            key: the columns that tell groups apart.
            wanted: what each group is made from, by the values of these columns.
            make: ``(values, what it is made from)`` to the group's rows without these columns; there may be none.
        """
        there = {tuple(row[name] for name in key) for row in self.rows}
        todo = {values: of for values, of in wanted.items() if values not in there}
        with Progress(len(todo), unit="groups of rows", file=sys.stderr) as bar:
            for number, (values, of) in enumerate(todo.items(), 1):
                rows = [{**dict(zip(key, values, strict=True)), **row} for row in make(values, of)]
                if rows:
                    self.add(rows)
                bar.update(number)
        return [row for row in self.rows if tuple(row[name] for name in key) in wanted]

    def replace(self, rows: Iterable[Row]) -> None:
        """Write the file anew with these rows."""
        self.rows = list(rows)
        if self.path is not None:
            write_text(self.path, self._lines(self.rows, header=True))

    def _value(self, column: str, text: str) -> Any:
        """Return what a cell holds; nothing and NaN are ``None``."""
        if column in self.text:
            return text or None
        if text in ("True", "False") and column not in self.whole:
            return text == "True"
        number = float(text or "nan")
        if math.isnan(number):
            return None
        if column not in self.whole:
            return number
        if not number.is_integer():
            raise ValueError(f"{column} is {text}, and should be a whole number")
        return int(text) if text.lstrip("-").isdigit() else int(number)

    def _lines(self, rows: Iterable[Row], header: bool) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if header:
            writer.writerows([self.columns, ()])
        writer.writerows([row[column] for column in self.columns] for row in rows)
        writer.writerow(())
        return text.getvalue()
