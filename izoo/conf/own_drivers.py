"""The option ``contexts.drivers``, which every choice of contexts has: a file with a population of human drivers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from izoo.contexts.population import read_population
from izoo.contexts.source import ContextSource, with_drivers
from izoo.errors import IzooError
from izoo.files import expanded


def resolve_drivers(config: Any) -> None:
    """Make the path absolute, so that a run can be resumed and evaluated from another folder."""
    if config.drivers is not None:
        object.__setattr__(config, "drivers", str(expanded(config.drivers).absolute()))


def driver_files(config: Any) -> list[Path]:
    """Return the files of drivers that a choice of contexts names, once each; a mixture may name several."""
    named = (getattr(each, "drivers", None) for each in (config, *getattr(config, "sources", ())))
    return list(dict.fromkeys(Path(path) for path in named if path is not None))


def with_own_drivers(source: ContextSource, path: str | None) -> ContextSource:
    """Return the source with the drivers of a file; without one, as it is."""
    if path is None:
        return source
    try:
        population = read_population(path)
    except IzooError as error:
        raise IzooError(f"contexts.drivers: {error}") from None
    return with_drivers(source, population)
