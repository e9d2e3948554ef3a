"""What users name as ``module:name``: tasks, algorithms, contexts and policies of their own."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from izoo.errors import IzooError


def imported(option: str, place: str) -> Any:
    """Return what ``module:name`` names.

    Args:
        option: that it was given for, as in ``algo=module:Class``.
        place: the module and the name in it; modules are also looked for in the current folder.

    Raises:
        IzooError: the module is not there, or has no such name.
    """
    module, _, name = place.partition(":")
    # Only for what is not izoo's own: nothing in the current folder shall be imported that nobody named.
    if module.partition(".")[0] != "izoo" and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise IzooError(f"{option}={place}: {error}.") from error
