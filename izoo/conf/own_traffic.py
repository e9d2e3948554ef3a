"""The options ``contexts.drivers`` and ``contexts.fleet``, which every choice of contexts has but the mixture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from izoo.contexts.context import checked_fleet
from izoo.contexts.population import read_population
from izoo.contexts.source import ContextSource, with_changes
from izoo.errors import IzooError
from izoo.files import expanded


def check_traffic(config: Any) -> None:
    """Check the fleet, and make the path of the drivers absolute, so that a run can be resumed from another folder."""
    try:
        if config.fleet is not None:
            checked_fleet(config.fleet)
    except IzooError as error:
        raise IzooError(f"contexts.fleet: {error}") from None
    if config.drivers is not None:
        object.__setattr__(config, "drivers", str(expanded(config.drivers).absolute()))


def driver_files(config: Any) -> list[Path]:
    """Return the files of drivers that a choice of contexts names, once each; a mixture may name several."""
    named = (getattr(each, "drivers", None) for each in (config, *getattr(config, "sources", ())))
    return list(dict.fromkeys(Path(path) for path in named if path is not None))


def with_own_traffic(source: ContextSource, config: Any) -> ContextSource:
    """Return the source with the drivers and the fleet that a choice of contexts names; without any, as it is."""
    changes: dict[str, Any] = {} if config.fleet is None else {"fleet": checked_fleet(config.fleet)}
    if config.drivers is not None:
        try:
            changes["drivers"] = read_population(config.drivers)
        except IzooError as error:
            raise IzooError(f"contexts.drivers: {error}") from None
    return with_changes(source, changes) if changes else source
