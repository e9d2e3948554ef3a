"""Names of vehicles, which SUMO wants, by the rows that everything else knows.

A vehicle's name is its number in the episode's demand, as a decimal string.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable


class Names:
    """Who is in the region, by name.

    Attributes:
        row_of: row of each vehicle in the region, in the order in which they came.
        members: their names, in the same order.
    """

    def __init__(self) -> None:
        self.row_of: dict[str, int] = {}
        self.members: list[str] = []
        self._name_of: dict[int, str] = {}

    def add(self, name: str, row: int) -> None:
        """Enter a vehicle that has been given a row."""
        self.row_of[name] = row
        self._name_of[row] = name
        self.members.append(name)

    def leave(self, names: Collection[str]) -> None:
        """Remove vehicles that have left from the members; their rows stay theirs until :meth:`forget`."""
        self.members = [name for name in self.members if name not in names]

    def forget(self, names: Iterable[str]) -> None:
        """Forget vehicles that have left, at the end of the step."""
        for name in names:
            del self._name_of[self.row_of.pop(name)]

    def of(self, rows: Iterable[int]) -> list[str]:
        """Return the names behind rows."""
        return [self._name_of[row] for row in rows]
