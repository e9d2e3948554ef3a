"""Which lanes of a way cars may use: bus lanes, lanes for public service vehicles and cycle lanes are left out.

Per lane, in this order: ``motorcar:lanes``, ``motor_vehicle:lanes``, ``vehicle:lanes`` and ``access:lanes`` say whether
cars may use it; else a lane designated for buses, public service vehicles or bicycles is theirs. Without such tags
``lanes:bus``, ``lanes:psv`` and ``busway`` tell how many lanes at the kerb are for buses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

CAR_KEYS = ("motorcar", "motor_vehicle", "vehicle", "access")
"""Tags that say whether cars may use something, the most particular one first."""
_BUS_KEYS = ("bus", "psv")
CLOSED = frozenset(
    (
        *("no", "private", "agricultural", "forestry", "delivery", "military", "emergency"),
        *("bus", "psv", "taxi", "tram", "bicycle", "foot", "hgv", "goods"),
    )
)
"""Values of those tags that shut cars out; among them the vehicles that alone may use it."""
OPEN, BUS, CYCLE = "", "bus", "cycle"
_COUNT_KEYS = ("lanes:bus", "lanes:psv")


@dataclass(frozen=True)
class LaneMarks:
    """Whose the lanes of one direction are.

    Attributes:
        lanes: per lane that tags list, right to left: open to cars, for buses, or for bicycles; ``None`` without such
            tags.
        buses: bus lanes, which ``lanes`` counts.
        cycles: cycle lanes, which ``lanes`` does not count.
    """

    lanes: tuple[str, ...] | None
    buses: int = 0
    cycles: int = 0

    def without_closed(self, entries: tuple[str, ...], counted: int | None) -> tuple[str, ...] | None:
        """Return the entries of the lanes that are open to cars.

        Args:
            entries: something per lane, right to left: of all lanes, or without the cycle lanes, or of the open ones.
            counted: what the tag ``lanes`` says of the direction.

        Returns:
            ``None`` where the entries cannot be told apart, or are others than were counted.
        """
        lanes = self.lanes
        if lanes is None:
            # The kerb is on the right.
            whole = len(entries) - self.buses > 0 and counted in (None, len(entries))
            found = entries[self.buses :] if whole else entries
            return found if counted in (None, len(found), len(found) + self.buses) else None
        listed = [lanes, tuple(lane for lane in lanes if lane != CYCLE), tuple(lane for lane in lanes if lane == OPEN)]
        fits = next((row for row in listed if len(row) == len(entries)), None)
        if fits is None:
            return None
        found = tuple(entry for entry, lane in zip(entries, fits, strict=True) if lane == OPEN)
        return found if found and counted in (None, *map(len, listed)) else None


def directional(tags: Mapping[str, str], oneway: int, key: str, direction: int) -> str | None:
    """Return the value of ``key`` for one direction: that of its own tag, or on a one-way street the tag for all."""
    value = tags.get(f"{key}:{'forward' if direction > 0 else 'backward'}")
    return tags.get(key) if value is None and oneway == direction else value


def shuts_cars_out(value: str) -> bool:
    """Whether a value of an access tag leaves no car in; several values are separated by semicolons."""
    words = {word.strip() for word in value.split(";")} - {""}
    return bool(words) and words <= CLOSED


def lane_marks(tags: Mapping[str, str], oneway: int, direction: int) -> LaneMarks:
    """Return which vehicles the lanes of a direction are for."""

    def listed(key: str) -> list[str] | None:
        text = directional(tags, oneway, f"{key}:lanes", direction)
        return None if text is None else [entry.strip() for entry in reversed(text.split("|"))]

    columns = {key: column for key in (*CAR_KEYS, *_BUS_KEYS, "bicycle", "cycleway") if (column := listed(key))}
    if not columns:
        return LaneMarks(None, buses=_bus_count(tags, oneway, direction))
    most = max(map(len, columns.values()))
    own = {key: column for key, column in columns.items() if len(column) == most}
    marks = [_mark({key: column[lane] for key, column in own.items()}) for lane in range(most)]
    # Some mappers list cycle lanes in one tag and not in the other.
    counted = [lane for lane in range(most) if marks[lane] != CYCLE]
    for lane, place in enumerate(counted):
        shorter = {key: column[lane] for key, column in columns.items() if len(column) == len(counted) < most}
        if shorter and marks[place] == OPEN:
            marks[place] = _mark(shorter)
    return LaneMarks(tuple(marks), marks.count(BUS), marks.count(CYCLE))


def closed_direction(tags: Mapping[str, str]) -> int:
    """Return the direction, 1 or -1, of a two-way street all of whose lanes are closed to cars; 0 if there is none."""
    for direction in (1, -1):
        lanes = lane_marks(tags, 0, direction).lanes
        if lanes is not None and OPEN not in lanes:
            return direction
    return 0


def _mark(values: Mapping[str, str]) -> str:
    """Whose a lane is, from the values of its tags."""
    own = BUS if any(values.get(key) == "designated" for key in _BUS_KEYS) else ""
    if not own and (values.get("bicycle") == "designated" or values.get("cycleway") in ("lane", "track")):
        own = CYCLE
    said = next((values[key] for key in CAR_KEYS if values.get(key)), None)
    if said is None:
        return own or OPEN
    return (own or BUS) if shuts_cars_out(said) else OPEN


def _bus_count(tags: Mapping[str, str], oneway: int, direction: int) -> int:
    for key in _COUNT_KEYS:
        text = directional(tags, oneway, key, direction)
        if text is not None and text.isdecimal():
            return int(text)
    kerb = "right" if direction > 0 or oneway else "left"
    return int("lane" in {tags.get(key) for key in ("busway", "busway:both", f"busway:{kerb}")})
