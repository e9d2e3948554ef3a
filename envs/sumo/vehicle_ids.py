"""SUMO's vehicle ids, and the rows by which all other code knows the vehicles.

A vehicle's id is its number in the episode's demand, as a decimal string.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable


class VehicleIds:
    """The vehicles in the region by id.

    Attributes:
        row_of: row of each vehicle in the region, in order of arrival.
        members: their ids, in the same order.
    """

    def __init__(self) -> None:
        self.row_of: dict[str, int] = {}
        self.members: list[str] = []
        self._id_of: dict[int, str] = {}

    def add(self, vehicle: str, row: int) -> None:
        """Add a vehicle that was given a row."""
        self.row_of[vehicle] = row
        self._id_of[row] = vehicle
        self.members.append(vehicle)

    def remove(self, vehicles: Collection[str]) -> None:
        """Remove vehicles that left from the members; they keep their rows until :meth:`free_rows`."""
        self.members = [vehicle for vehicle in self.members if vehicle not in vehicles]

    def free_rows(self, vehicles: Iterable[str]) -> None:
        """Free the rows of vehicles that left, at the end of the step."""
        for vehicle in vehicles:
            del self._id_of[self.row_of.pop(vehicle)]

    def of(self, rows: Iterable[int]) -> list[str]:
        """Return the ids behind rows."""
        return [self._id_of[row] for row in rows]
