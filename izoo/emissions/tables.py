"""The data files of the package ``neuralmoves``: MOVES default tables and network weights.

They are found without importing the package, whose ``__init__`` loads pandas and torch.
"""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Callable
from pathlib import Path

from izoo.errors import IzooError


def moves_file(*parts: str) -> Path:
    """Return the path of a file inside the installed package ``neuralmoves``.

    Raises:
        IzooError: the package or the file is missing.
    """
    found = importlib.util.find_spec("neuralmoves")
    if found is None or found.origin is None:
        raise IzooError("the package neuralmoves is not installed; run: pip install 'neuralmoves>=0.4,<0.5'.")
    path = Path(found.origin).parent.joinpath(*parts)
    if not path.is_file():
        raise IzooError(f"neuralmoves has no file {path}; install a release in 'neuralmoves>=0.4,<0.5'.")
    return path


def read_default_table(name: str, keep: Callable[[dict[str, str]], bool]) -> list[dict[str, str]]:
    """Return the rows of ``defaults/<name>.csv`` that ``keep`` accepts; values are strings as in the file."""
    with moves_file("defaults", f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if keep(row)]
