"""Reads the drivable streets of an OpenStreetMap extract (``.osm``, ``.osm.pbf``, compressed or not).

Positions are metres east and north of the extract's centre; at the size of a city the projection is true to 0.1 %.

Where traffic drives on the left the map is mirrored: east and west, left and right change places, in positions, lanes
and restrictions, and all that is made of it drives on the right.
"""

from __future__ import annotations

import importlib
import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.osm.driving_side import Side, left_hand_region
from izoo.networks.osm.lane_access import CAR_KEYS, closed_direction, shuts_cars_out

SUFFIXES = (".osm", ".osm.pbf", ".pbf", ".osm.gz", ".osm.bz2")
EARTH_RADIUS_M = 6_371_000.0
DRIVABLE = frozenset(
    f"{name}{suffix}" for name in ("motorway", "trunk", "primary", "secondary", "tertiary") for suffix in ("", "_link")
) | {"unclassified", "residential", "living_street", "road"}
"""Values of ``highway`` that count as streets; service roads and driveways do not."""


_CARS = {"motorcar", "motor_vehicle", "vehicle"}
_RESTRICTION_KEYS = ("restriction:motorcar", "restriction:motor_vehicle", "restriction:vehicle", "restriction")
_ONEWAY_KEYS = ("oneway:motorcar", "oneway:motor_vehicle", "oneway:vehicle")
_SIDE_WORD = re.compile("left|right")


@dataclass(frozen=True)
class Way:
    """A drivable way: its node ids in drawing order, and its tags. ``oneway`` is 1, -1 (against the order) or 0."""

    id: int
    nodes: tuple[int, ...]
    tags: dict[str, str]
    oneway: int

    @property
    def name(self) -> str:
        """Street name, or its reference number, or an empty string."""
        return self.tags.get("name") or self.tags.get("ref") or ""


@dataclass(frozen=True)
class Restriction:
    """A turn restriction such as ``no_left_turn`` from one way into another, over nodes or over ways in between."""

    kind: str
    from_way: int
    to_way: int
    via_nodes: frozenset[int] = frozenset()
    via_ways: tuple[int, ...] = ()


@dataclass(frozen=True)
class StreetMap:
    """Streets of one extract.

    Attributes:
        ways: drivable ways by id; a way that leaves the extract is cut where its nodes are missing.
        position_m: per node, metres east and north of the centre.
        lonlat: per node, degrees.
        signals: signal nodes on drivable ways, with the direction (``forward``, ``backward`` or ``""``) they face.
        restrictions: turn restrictions between drivable ways.
        mirrored: where traffic drives on the left, and the map is mirrored, the name of the region; otherwise ``""``.
    """

    ways: dict[int, Way]
    position_m: dict[int, tuple[float, float]]
    lonlat: dict[int, tuple[float, float]]
    signals: dict[int, str]
    restrictions: tuple[Restriction, ...]
    mirrored: str = ""


def read_streets(path: Path | str, drives_on: Side | None = None) -> StreetMap:
    """Read an extract.

    Args:
        path: the extract.
        drives_on: the side that traffic drives on; ``None``: that of the country where the extract lies.

    Raises:
        IzooError: osmium is not installed; the file is missing, of another format or malformed, or has no streets.
    """
    path = expanded(path)
    if not path.is_file():
        raise IzooError(f"{path} does not exist; give the path of an OpenStreetMap extract ({', '.join(SUFFIXES)}).")
    if not path.name.endswith(SUFFIXES):
        raise IzooError(f"{path} is not an OpenStreetMap extract by its name; it must end in {', '.join(SUFFIXES)}.")
    osmium = _osmium()
    try:
        ways, restrictions = _read_ways(osmium, path)
        lonlat, signals = _read_nodes(osmium, path, {node for way in ways for node in way.nodes})
    except (osmium.InvalidLocationError, RuntimeError, ValueError, OSError) as error:
        raise IzooError(f"{path} cannot be read as OpenStreetMap data ({error}); export the extract again.") from error
    kept = {way.id: way for whole in ways for way in _cut(whole, lonlat)}
    if not kept:
        raise IzooError(f"{path} holds no drivable streets; export an extract that contains streets with their nodes.")
    used = {node for way in kept.values() for node in way.nodes}
    lonlat = {node: place for node, place in lonlat.items() if node in used}
    streets = StreetMap(
        ways=kept,
        position_m=_project(lonlat),
        lonlat=lonlat,
        signals={node: facing for node, facing in signals.items() if node in used},
        restrictions=tuple(rule for rule in restrictions if {rule.from_way, rule.to_way, *rule.via_ways} <= set(kept)),
    )
    region = left_hand_region(*_centre(lonlat))
    left = region is not None if drives_on is None else drives_on == "left"
    return _mirrored(streets, region or "as given") if left else streets


def _mirrored(streets: StreetMap, region: str) -> StreetMap:
    return StreetMap(
        ways={number: replace(way, tags=_mirrored_tags(way.tags)) for number, way in streets.ways.items()},
        position_m={node: (-x, y) for node, (x, y) in streets.position_m.items()},
        lonlat=streets.lonlat,
        signals=streets.signals,
        restrictions=tuple(replace(rule, kind=_exchanged(rule.kind)) for rule in streets.restrictions),
        mirrored=region,
    )


def _mirrored_tags(tags: dict[str, str]) -> dict[str, str]:
    """Tags of a way whose lanes, listed from the left, are listed from the other side, and turn to the other side."""
    found = {}
    for key, value in tags.items():
        words = key.split(":")
        key = ":".join(_exchanged(word) if word in ("left", "right") else word for word in words)
        by_lane = "|".join(reversed(value.split("|"))) if "lanes" in words else value
        found[key] = _exchanged(by_lane) if words[0] == "turn" else by_lane
    return found


def _exchanged(text: str) -> str:
    """Return a text in which left and right change places."""
    return _SIDE_WORD.sub(lambda match: "right" if match[0] == "left" else "left", text)


def _osmium() -> Any:
    try:
        return importlib.import_module("osmium")
    except ImportError as error:
        raise IzooError("OpenStreetMap needs the package osmium; install it with: pip install 'izoo[osm]'") from error


def _read_ways(osmium: Any, path: Path) -> tuple[list[Way], list[Restriction]]:
    ways: list[Way] = []
    restrictions: list[Restriction] = []
    everything = osmium.FileProcessor(str(path), osmium.osm.WAY | osmium.osm.RELATION)
    for item in everything.with_filter(osmium.filter.KeyFilter("highway", *_RESTRICTION_KEYS)):
        tags = item.tags
        if item.is_way():
            if tags.get("highway") in DRIVABLE and _open_to_cars(tags):
                nodes = tuple(node.ref for node in item.nodes)
                own = {tag.k: tag.v for tag in tags}
                ways.append(Way(item.id, nodes, own, _oneway(own)))
        elif (tags.get("type") or "").startswith("restriction"):
            kind = next((tags[key] for key in _RESTRICTION_KEYS if tags.get(key)), None)
            if kind is not None and not _CARS & {word.strip() for word in (tags.get("except") or "").split(";")}:
                members = [(member.role, member.type, member.ref) for member in item.members]
                restrictions += _restrictions(kind, members)
    return ways, restrictions


def _restrictions(kind: str, members: list[tuple[str, str, int]]) -> Iterator[Restriction]:
    """One restriction per pair of ways: a relation may forbid to enter from several, or to leave into several."""

    def of(role: str, kind: str) -> list[int]:
        return [ref for name, type_, ref in members if (name, type_) == (role, kind)]

    for start, end in itertools.product(of("from", "w"), of("to", "w")):
        yield Restriction(kind, start, end, frozenset(of("via", "n")), tuple(of("via", "w")))


def _read_nodes(osmium: Any, path: Path, wanted: set[int]) -> tuple[dict[int, tuple[float, float]], dict[int, str]]:
    lonlat: dict[int, tuple[float, float]] = {}
    signals: dict[int, str] = {}
    nodes = osmium.FileProcessor(str(path), osmium.osm.NODE)
    if min(wanted, default=0) > 0:  # The filter does not take the negative ids of unpublished nodes.
        nodes = nodes.with_filter(osmium.filter.IdFilter(wanted))
    for node in nodes:
        if node.id not in wanted or not node.location.valid():
            continue
        lonlat[node.id] = (node.location.lon, node.location.lat)
        if node.tags.get("highway") == "traffic_signals":
            signals[node.id] = node.tags.get("traffic_signals:direction") or node.tags.get("direction") or ""
    return lonlat, signals


def _open_to_cars(tags: Any) -> bool:
    if tags.get("area") == "yes":
        return False
    value = next((tags[key] for key in CAR_KEYS if tags.get(key) is not None), None)
    return value is None or not shuts_cars_out(value)


def _oneway(tags: Mapping[str, str]) -> int:
    """The only direction that is open to cars, or 0."""
    particular = (tags[key] for key in _ONEWAY_KEYS if key in tags)
    value = next(particular, tags.get("oneway"))
    if value in ("yes", "true", "1"):
        return 1
    if value in ("-1", "reverse"):
        return -1
    implied = tags.get("junction") in ("roundabout", "circular") or tags.get("highway") in ("motorway", "motorway_link")
    return 1 if implied and value is None else -closed_direction(tags)


def _cut(way: Way, lonlat: dict[int, tuple[float, float]]) -> Iterator[Way]:
    """The longest stretch of ``way`` whose nodes are all in the extract, if it has two nodes or more."""
    stretches: list[list[int]] = [[]]
    for node in way.nodes:
        if node not in lonlat:
            stretches.append([])
        elif not stretches[-1] or stretches[-1][-1] != node:
            stretches[-1].append(node)
    best = max(stretches, key=len)
    if len(best) > 1:
        yield Way(way.id, tuple(best), way.tags, way.oneway)


def _centre(lonlat: dict[int, tuple[float, float]]) -> tuple[float, float]:
    return sum(lon for lon, _ in lonlat.values()) / len(lonlat), sum(lat for _, lat in lonlat.values()) / len(lonlat)


def _project(lonlat: dict[int, tuple[float, float]]) -> dict[int, tuple[float, float]]:
    lon0, lat0 = _centre(lonlat)
    metres = math.radians(1.0) * EARTH_RADIUS_M
    shrink = math.cos(math.radians(lat0))
    return {node: ((lon - lon0) * metres * shrink, (lat - lat0) * metres) for node, (lon, lat) in lonlat.items()}


def neighbours(streets: StreetMap) -> dict[int, list[tuple[int, Way, int]]]:
    """Per node: the nodes next to it, the way in between, and 1 or -1: with or against the way's order."""
    found: dict[int, list[tuple[int, Way, int]]] = defaultdict(list)
    for way in streets.ways.values():
        for one, two in itertools.pairwise(way.nodes):
            found[one].append((two, way, 1))
            found[two].append((one, way, -1))
    return found
