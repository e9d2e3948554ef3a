"""The file of a benchmark's rows, which is looked at before anything is measured."""

from __future__ import annotations

import os
from typing import Any

from izoo.errors import IzooError
from izoo.files import check_folder, expanded

REMEDY = "choose another file with out=FILE"


def check_out(config: Any) -> None:
    """Raise :class:`IzooError` where the file that the option ``out`` names, if any, cannot be written."""
    if config.out is None:
        return
    path = expanded(config.out)
    check_folder(path.parent, REMEDY)
    if path.is_dir():
        raise IzooError(f"out={path} is a folder; {REMEDY}.")
    if not os.access(path.parent, os.W_OK):
        raise IzooError(f"out={path}: the folder {path.parent} may not be written; {REMEDY}.")
