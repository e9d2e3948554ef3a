"""The options ``contexts.drivers`` and ``contexts.fleet``, which every choice of contexts has but the mixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from izoo.contexts.context import checked_fleet
from izoo.contexts.population import read_population
from izoo.contexts.source import ContextSource, with_changes
from izoo.errors import IzooError
from izoo.files import make_absolute
from izoo.options import CheckedOptions


@dataclass(frozen=True)
class SourceConfig(CheckedOptions):
    """A choice of contexts.

    Attributes:
        name: the source.
        drivers: a population that ``python -m izoo.drivers calibrate`` wrote, as a JSON file; null: the built-in one.
        fleet: shares of passenger cars, passenger trucks, light commercial trucks and transit buses, with a sum of 1:
            ``[0.7,0.2,0.06,0.04]``; null: those of MOVES for 2019.
    """

    name: str = ""
    drivers: str | None = None
    fleet: list[float] | None = None
    group = "contexts"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            if self.fleet is not None:
                checked_fleet(self.fleet)
        except IzooError as error:
            raise IzooError(f"contexts.fleet: {error}") from None
        make_absolute(self, "drivers")

    def build(self) -> ContextSource:
        """Return the contexts; raises :class:`IzooError` where an option or a file cannot be used."""
        source = self.source()
        changes: dict[str, Any] = {} if self.fleet is None else {"fleet": checked_fleet(self.fleet)}
        if self.drivers is not None:
            try:
                changes["drivers"] = read_population(self.drivers)
            except IzooError as error:
                raise IzooError(f"contexts.drivers: {error}") from None
        return with_changes(source, changes) if changes else source

    def source(self) -> ContextSource:
        """Return the contexts with the built-in drivers and fleet."""
        raise NotImplementedError
