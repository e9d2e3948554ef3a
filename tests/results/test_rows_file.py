"""Files of rows: what cells hold, and files that were cut short or edited."""

from pathlib import Path

import pytest

from izoo.errors import IzooError
from izoo.results.rows_file import RowsFile

COLUMNS, TEXT, WHOLE = ("name", "seed", "share", "good"), ("name",), ("seed",)


def read(path: Path) -> list[dict[str, object]]:
    return RowsFile(path, COLUMNS, TEXT, WHOLE).read().rows


def test_cells_are_read_as_they_were_written(tmp_path: Path) -> None:
    rows = [{"name": "a,b", "seed": 2**60 + 1, "share": 0.1, "good": True}]
    rows.append({"name": None, "seed": None, "share": None, "good": False})
    file = RowsFile(tmp_path / "rows.csv", COLUMNS, TEXT, WHOLE)
    for row in rows:
        file.add([row])
    assert read(tmp_path / "rows.csv") == rows


def test_whole_numbers_that_a_table_program_wrote_are_read(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("name,seed,share,good\na,3.0,0.5,True\n")
    assert read(tmp_path / "rows.csv") == [{"name": "a", "seed": 3, "share": 0.5, "good": True}]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "lacks the column"),
        ("name,seed,share,good\na,1\n", "a row has 2 cells, and the header 4"),
        ("name,seed,share,good\na,1.5,0,True\n", r"seed is 1\.5, and should be a whole number"),
        ("name,seed,share\na,1,0\n", r"lacks the column\(s\) good"),
    ],
)
def test_files_of_others_are_refused_with_what_is_wrong(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "rows.csv").write_text(content)
    with pytest.raises(IzooError, match=said):
        read(tmp_path / "rows.csv")
