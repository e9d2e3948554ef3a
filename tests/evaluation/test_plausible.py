"""Every cell of an evaluation table, with whatever it cannot be: refused by line and column, never summed up."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from izoo.contexts.context import Context
from izoo.errors import IzooError
from izoo.evaluation.folder import ResultFolder
from izoo.evaluation.plausible import NAMED, RANGES, SIGNED
from izoo.evaluation.table import (
    COLUMNS,
    CSV_FILE,
    JOURNAL_FILE,
    MANIFEST_FILE,
    make_table,
    read_csv,
    read_journal,
    write_csv,
)
from tests.evaluation.test_table import rows

TEXTS = ("demand", "hour", "engine", "season", "city", "cv_vehicle")
"""Columns that may be empty, or hold any text."""
WRONG_NUMBERS = ("", "nan", "-inf", "text", "-1e400", "1_000", "0x10", "1,5")
WRONG_WHOLE = ("1.5", "x", "inf", "-1", "1e3", "9223372036854775808", "\u0661")


def wrong() -> list[tuple[str, str]]:
    """Every column of numbers with every text that is none, or none that it can be."""
    cells = [(column, value) for column in RANGES for value in WRONG_NUMBERS]
    cells += [(column, "-1") for column, (low, _) in RANGES.items() if low > -1.0]
    cells += [(column, "inf") for column, (_, high) in RANGES.items() if high < float("inf")]
    cells += [(column, "1.5") for column in ("adoption", "green_share")]
    cells += [(column, value) for column in ("seed", "context_id") for value in WRONG_WHOLE]
    return cells + [(column, "") for column in (*NAMED, "seed")]


@pytest.fixture(scope="module")
def table(contexts: list[Context]) -> pd.DataFrame:
    return make_table(rows(contexts)).astype(object)


def test_every_column_is_walked() -> None:
    walked = {column for column, _ in wrong()}
    assert set(COLUMNS) - walked == set(TEXTS)
    assert {f"episode_{name}" for name in SIGNED} <= walked


@pytest.mark.parametrize("column", [column for column in COLUMNS if column not in TEXTS])
def test_every_wrong_cell_is_refused(table: pd.DataFrame, column: str, tmp_path: Path) -> None:
    path = tmp_path / CSV_FILE
    for value in [value for name, value in wrong() if name == column]:
        changed = table.copy()
        changed.loc[1, column] = value
        write_csv(changed, path)
        with pytest.raises(IzooError, match=rf"evaluation\.csv, line 3: {column} is"):
            read_csv(path)
            raise AssertionError(f"{column}={value!r} was read")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, None, "text", True, [1.0], {}])
def test_the_journal_is_checked_as_well(contexts: list[Context], value: Any, tmp_path: Path) -> None:
    path = tmp_path / JOURNAL_FILE
    damaged = rows(contexts)
    damaged[1]["emission_g"] = value
    path.write_text(f"{json.dumps(damaged[:1])}\n{json.dumps(damaged[1:])}\n")
    with pytest.raises(IzooError, match="emission_g"):
        read_journal(path)


def test_a_row_that_is_there_twice_is_refused(table: pd.DataFrame, tmp_path: Path) -> None:
    write_csv(pd.concat([table, table[:1]]), tmp_path / CSV_FILE)
    with pytest.raises(IzooError, match="line 4: the row is there twice"):
        read_csv(tmp_path / CSV_FILE)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "binary": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "zeros": lambda path: path.write_bytes(bytes(500)),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-20]),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "nested": lambda path: path.write_text("[" * 100_000 + "\n"),
    "a number": lambda path: path.write_text("7\n"),
    "null": lambda path: path.write_text("null\n"),
    "a list of numbers": lambda path: path.write_text("[1, 2]\n"),
}


@pytest.mark.parametrize("file", [CSV_FILE, JOURNAL_FILE, MANIFEST_FILE])
@pytest.mark.parametrize("damage", DAMAGES)
def test_every_file_of_an_evaluation_in_every_way(
    contexts: list[Context], file: str, damage: str, tmp_path: Path
) -> None:
    """Opening the folder is refused, and leaves its files as they are; a journal may have been cut by a kill."""
    folder = ResultFolder(tmp_path, {"env": {}})
    with folder.open("x", "fingerprint"):
        folder.add(rows(contexts))
    (tmp_path / JOURNAL_FILE).write_text(json.dumps(rows(contexts)[:1]) + "\n")
    DAMAGES[damage](tmp_path / file)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    again = ResultFolder(tmp_path, {"env": {}})
    if (file, damage) in {(JOURNAL_FILE, "cut"), (JOURNAL_FILE, "zeros")}:  # no line was written whole
        with again.open("x", "fingerprint"):
            assert len(again.done) == 2
        return
    with pytest.raises(IzooError, match=file.replace(".", r"\.")), again.open("x", "fingerprint"):
        raise AssertionError("it was opened")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
