"""MOVES default tables: the rows that izoo uses, as the package ``neuralmoves`` publishes them (``data/LICENSE``)."""

from __future__ import annotations

import csv
from pathlib import Path

DATA = Path(__file__).parent / "data"


def read_moves_table(name: str) -> list[dict[str, str]]:
    """Return the rows of ``data/<name>.csv``; values are strings as in the file."""
    with (DATA / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
