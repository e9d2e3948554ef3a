"""What the tags of an OpenStreetMap way say about its lanes, turns and speed, and the rules where they say nothing.

Rules of imputation, applied in this order and marked by the callers:

- lanes of a direction: ``lanes:forward``/``lanes:backward``; the entries of ``turn:lanes``, or of tags that say whose
  each lane is; ``lanes`` less the other direction and the centre lane; half of ``lanes``, where an odd lane serves the
  traffic that arrives; the street class. Lanes that are closed to cars are left out
  (:mod:`izoo.networks.osm.lane_access`).
- turns: ``turn:lanes``; lanes without an entry go straight on, the rightmost of them turns right too and the leftmost
  left, where there is such an exit and no other lane has it. A centre lane or an odd lane is a left-turn lane.
- speed limit: ``maxspeed`` of the direction; ``maxspeed``; the number of a zone; the street class.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from izoo.networks.osm.lane_access import OPEN, directional, lane_marks
from izoo.networks.osm.streets import Way

MAX_LANES = 6
MPH = 0.44704
KMH = 1.0 / 3.6


@dataclass(frozen=True)
class ClassDefault:
    """What is assumed of a street class: lanes per direction, limit in m/s, AADT per lane in veh/day."""

    lanes: int
    speed_limit_mps: float
    aadt_per_lane: float


CLASS_DEFAULTS = {
    "motorway": ClassDefault(2, 60 * MPH, 12_000.0),
    "trunk": ClassDefault(2, 45 * MPH, 9_000.0),
    "primary": ClassDefault(2, 35 * MPH, 7_500.0),
    "secondary": ClassDefault(1, 35 * MPH, 6_500.0),
    "tertiary": ClassDefault(1, 30 * MPH, 5_000.0),
    "residential": ClassDefault(1, 25 * MPH, 1_500.0),
    "unclassified": ClassDefault(1, 25 * MPH, 2_000.0),
    "living_street": ClassDefault(1, 10 * MPH, 500.0),
    "road": ClassDefault(1, 25 * MPH, 2_000.0),
    "link": ClassDefault(1, 30 * MPH, 5_000.0),
}
_TURN_WORDS = {
    "left": "l",
    "slight_left": "l",
    "sharp_left": "l",
    "reverse": "l",
    "through": "s",
    "right": "r",
    "slight_right": "r",
    "sharp_right": "r",
}
_ZONE = re.compile(r"([A-Z]{2}):(?:zone:?)?(\d+)(?: ?mph)?")
_MPH_COUNTRIES = ("GB", "US")
WALKING_MPS = 7.0 * KMH
_SPEED = re.compile(r"(\d+(?:\.\d+)?)\s*(mph|km/?h|kmh|kph|knots)?", re.IGNORECASE)
_SPEED_UNITS = {"mph": MPH, "knots": 0.514444}


@dataclass(frozen=True)
class Lanes:
    """Lanes of one direction.

    Attributes:
        turns: per lane, right to left: the tagged turns, or an empty string where the lane has no entry.
        guessed: whether the number of lanes was imputed.
        left_lane: whether the leftmost lane is a left-turn lane by rule: a centre lane, or the odd one.
    """

    turns: tuple[str, ...]
    guessed: bool = False
    left_lane: bool = False


def class_default(way: Way) -> ClassDefault:
    """What is assumed of the class of ``way``."""
    highway = way.tags["highway"]
    return CLASS_DEFAULTS["link" if highway.endswith("_link") else highway]


def lanes_towards(way: Way, direction: int, *, arriving: bool) -> Lanes:
    """Lanes of ``way`` for traffic with (1) or against (-1) its node order.

    Args:
        way: the way; it must be open in that direction.
        direction: 1 or -1.
        arriving: whether that traffic is on its way to the intersection.
    """
    marks = lane_marks(way.tags, way.oneway, direction)
    entries = _turn_entries(way, direction)
    centre = _centre_lane(way) and arriving
    explicit = _explicit(way, direction)
    turns = None if entries is None else marks.without_closed(entries, explicit)
    if turns is not None:
        return _with_centre(turns, False, centre)
    if explicit is not None:
        return _with_centre(("",) * max(explicit - marks.buses, 1), explicit <= marks.buses, centre)
    if marks.lanes is not None and OPEN in marks.lanes:
        return _with_centre(("",) * marks.lanes.count(OPEN), False, centre)
    total = _count(way.tags.get("lanes"))
    if total is None:
        return _with_centre(("",) * class_default(way).lanes, True, centre)
    rest = total - _centre_lane(way)
    other = _counted(way, -direction)
    if other is not None:
        own = rest - other - marks.buses
        return _with_centre(("",) * max(own, 1), own < 1, centre)
    rest -= marks.buses + lane_marks(way.tags, way.oneway, -direction).buses
    if rest % 2 == 1 and rest > 1:
        half = (rest + 1) // 2 if arriving else rest // 2
        return Lanes(("",) * min(half, MAX_LANES), guessed=True, left_lane=arriving)
    return _with_centre(("",) * max(rest // 2, 1), rest < 2, centre)


def _explicit(way: Way, direction: int) -> int | None:
    """The lanes of a direction that a tag counts."""
    found = _count(directional(way.tags, way.oneway, "lanes", direction))
    own, other = (f"lanes:{'forward' if towards > 0 else 'backward'}" for towards in (direction, -direction))
    if found is None or own in way.tags:
        return found
    # On a street that is one-way for cars, ``lanes`` counts those of buses against them as well.
    return max(found - (_count(way.tags.get(other)) or 0), 1)


def _counted(way: Way, direction: int) -> int | None:
    """The lanes of a direction that ``lanes`` counts, as far as tags of that direction tell: bus lanes included."""
    explicit = _explicit(way, direction)
    entries = _turn_entries(way, direction)
    if explicit is not None or entries is None:
        return explicit
    marks = lane_marks(way.tags, way.oneway, direction)
    turns = marks.without_closed(entries, None)
    return len(entries if turns is None else turns) + marks.buses


def speed_limit(way: Way, direction: int) -> tuple[float, bool]:
    """Speed limit in m/s for one direction, and whether it was imputed."""
    suffix = "forward" if direction > 0 else "backward"
    for key in (f"maxspeed:{suffix}", "maxspeed", "zone:maxspeed", "maxspeed:type"):
        found = parse_speed(way.tags.get(key))
        if found is not None:
            return found, False
    return class_default(way).speed_limit_mps, True


def parse_speed(value: str | None) -> float | None:
    """``"30 mph"``, ``"50"``, ``"50 km/h"``, ``"DE:zone30"`` or ``"walk"`` in m/s.

    ``None`` for anything else, such as ``"none"`` or ``"US:urban"``. Of several values, as in ``"30 mph; 20 mph"``, the
    first counts.
    """
    text = (value or "").split(";")[0].strip()
    if text == "walk":
        return WALKING_MPS
    match, zone = _SPEED.fullmatch(text), _ZONE.fullmatch(text)
    if zone is not None:
        speed = float(zone[2]) * (MPH if zone[1] in _MPH_COUNTRIES else KMH)
    elif match is not None:
        speed = float(match[1]) * _SPEED_UNITS.get((match[2] or "").lower(), KMH)
    else:
        return None
    return speed if 1.0 <= speed <= 60.0 else None


def assign_turns(lanes: Lanes, available: frozenset[str], banned: frozenset[str]) -> tuple[tuple[str, ...], bool]:
    """Turns of every lane, right to left, and whether some were imputed.

    Args:
        lanes: the lanes and their tagged turns.
        available: the turns (``r``, ``s``, ``l``) that have an exit here.
        banned: turns that a restriction forbids to all lanes.
    """
    allowed = (available - banned) or available
    found = [set(turns) & allowed for turns in lanes.turns]
    open_lanes = [lane for lane, turns in enumerate(found) if not turns]
    missing = allowed - set().union(*found)
    for lane in open_lanes:
        found[lane] |= {"s"} & allowed
    if open_lanes:
        _add_sides(found, open_lanes, missing, lanes.left_lane and "l" in allowed)
    for lane in open_lanes:
        if not found[lane]:
            sides = [turn for turn in "rl" if turn in allowed]
            found[lane].add(sides[0] if lane <= (len(found) - 1) / 2 else sides[-1])
    turns = tuple("".join(turn for turn in "rsl" if turn in lane) for lane in found)
    return turns, bool(open_lanes) and len(found) > 1


def _add_sides(found: list[set[str]], open_lanes: list[int], missing: frozenset[str] | set[str], left: bool) -> None:
    """Give right to the rightmost and left to the leftmost lane, where those have no tagged turns."""
    if "r" in missing and open_lanes[0] == 0:
        found[0].add("r")
    last = len(found) - 1
    if "l" in missing and open_lanes[-1] == last:
        if left and last > 0:
            found[last] = {"l"}
        else:
            found[last].add("l")


def _turn_entries(way: Way, direction: int) -> tuple[str, ...] | None:
    text = directional(way.tags, way.oneway, "turn:lanes", direction)
    if text is None:
        return None
    entries = []
    for entry in reversed(text.split("|")):
        turns = {_TURN_WORDS.get(word.strip(), "") for word in entry.split(";")}
        entries.append("".join(turn for turn in "rsl" if turn in turns))
    return tuple(entries)


def _centre_lane(way: Way) -> int:
    """1 where a lane in the middle serves both directions, otherwise 0."""
    return int(way.oneway == 0 and (way.tags.get("lanes:both_ways") == "1" or "turn:lanes:both_ways" in way.tags))


def _with_centre(turns: tuple[str, ...], guessed: bool, centre: int | bool) -> Lanes:
    # Next to the stop line the centre lane is the left-turn lane of arriving traffic.
    whole = (*turns, "l") if centre and "l" not in turns else turns
    return Lanes(whole[:MAX_LANES], guessed)


def _count(value: str | None, most: int = 2 * MAX_LANES + 2) -> int | None:
    """Return the number of lanes that a tag names, or ``most`` if it names more."""
    numbers = [int(float(part)) for part in re.findall(r"\d+(?:\.\d+)?", value or "")]
    return min(max(numbers), most) if numbers and max(numbers) > 0 else None
