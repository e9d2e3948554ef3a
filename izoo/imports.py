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
    if not module or module.startswith(".") or not name.isidentifier():
        raise IzooError(f"{option}={place} is not of the form module:name, such as mine:drive.")
    # A file in the current folder is imported only if the user named it.
    if module.partition(".")[0] != "izoo" and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # it is missing in the user's own module
        raise IzooError(f"{option}={place}: {error}.") from error
    if not hasattr(found, name):
        raise IzooError(f"{option}={place}: the module {module} has no {name}.")
    return getattr(found, name)
