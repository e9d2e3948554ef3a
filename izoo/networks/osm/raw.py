"""What an OpenStreetMap file says about streets that cars may use, before anything is made of it."""

from __future__ import annotations

import bz2
import gzip
import importlib
import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from izoo.errors import IzooError
from izoo.networks.osm.lane_access import CAR_KEYS, closed_direction, shuts_cars_out

SUFFIXES = (".osm", ".osm.pbf", ".pbf", ".osm.gz", ".osm.bz2")
DRIVABLE = frozenset(
    f"{name}{suffix}" for name in ("motorway", "trunk", "primary", "secondary", "tertiary") for suffix in ("", "_link")
) | {"unclassified", "residential", "living_street", "road"}
"""Values of ``highway`` that count as streets; service roads and driveways do not."""
REVERSIBLE = ("reversible", "alternating")
"""Values of ``oneway`` of streets whose direction changes with time."""
JUNCTION, CROSSING, PEDESTRIAN, UNCYCLED = "junction", "crossing", "pedestrian", "uncycled"
_WITHOUT_CYCLE = ("blinker", "blink_mode", "emergency", "ramp_meter", "level_crossing", "continuous_green")
_FOR_PEDESTRIANS = ("pedestrian_crossing", "crossing", "bicycle_crossing")
_CARS = {"motorcar", "motor_vehicle", "vehicle"}
_RESTRICTION_KEYS = ("restriction:motorcar", "restriction:motor_vehicle", "restriction:vehicle", "restriction")
_ONEWAY_KEYS = ("oneway:motorcar", "oneway:motor_vehicle", "oneway:vehicle")
_DELETED = re.compile(rb"action\s*=\s*['\"]delete['\"]")


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
class Light:
    """A signal node: the direction that it faces (``forward``, ``backward`` or ``""``), and what it is for."""

    facing: str
    kind: str


@dataclass(frozen=True)
class RawMap:
    """Drivable ways, turn restrictions, places of the ways' nodes in degrees, and signal nodes."""

    ways: list[Way]
    restrictions: list[Restriction]
    lonlat: dict[int, tuple[float, float]]
    lights: dict[int, Light]


def read_raw(path: Path) -> RawMap:
    """Read a file; of nodes that a way has twice in one place, one is left, and what an editor deleted is left out.

    Raises:
        IzooError: osmium is not installed, or the file is malformed.
    """
    osmium = _osmium()
    try:
        deleted = _deleted(path)
        ways, restrictions = _read_ways(osmium, path, deleted)
        lonlat, lights = _read_nodes(osmium, path, {node for way in ways for node in way.nodes})
    except (
        osmium.InvalidLocationError,
        ElementTree.ParseError,
        DefusedXmlException,
        RuntimeError,
        ValueError,
        OSError,
        EOFError,
    ) as error:
        raise IzooError(f"{path} cannot be read as OpenStreetMap data ({error}); export the extract again.") from error
    return _one_node_per_place(RawMap(ways, restrictions, lonlat, lights))


def _osmium() -> Any:
    try:
        return importlib.import_module("osmium")
    except ImportError as error:
        raise IzooError("OpenStreetMap needs the package osmium; install it with: pip install 'izoo[osm]'") from error


def _deleted(path: Path) -> set[tuple[str, int]]:
    """Type and id of what the editor JOSM keeps in its files as deleted."""
    if path.name.endswith(".pbf"):
        return set()
    opened: Any = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix, open)
    with opened(path, "rb") as file:
        if not _DELETED.search(file.read()):
            return set()
        file.seek(0)
        return {
            (element.tag, int(element.get("id")))
            for _, element in ElementTree.iterparse(file, events=("end",))
            if element.get("action") == "delete"
        }


def _read_ways(osmium: Any, path: Path, deleted: set[tuple[str, int]]) -> tuple[list[Way], list[Restriction]]:
    ways: list[Way] = []
    restrictions: list[Restriction] = []
    everything = osmium.FileProcessor(str(path), osmium.osm.WAY | osmium.osm.RELATION)
    for item in everything.with_filter(osmium.filter.KeyFilter("highway", *_RESTRICTION_KEYS)):
        tags = item.tags
        if ("way" if item.is_way() else "relation", item.id) in deleted:
            continue
        if item.is_way():
            if tags.get("highway") in DRIVABLE and _open_to_cars(tags):
                own = {tag.k: tag.v for tag in tags}
                ways.append(Way(item.id, tuple(node.ref for node in item.nodes), own, _oneway(own)))
        elif (tags.get("type") or "").startswith("restriction"):
            kind = next((tags[key] for key in _RESTRICTION_KEYS if tags.get(key)), None)
            if kind is not None and not _CARS & {word.strip() for word in (tags.get("except") or "").split(";")}:
                members = [(member.role, member.type, member.ref) for member in item.members]
                restrictions += _restrictions(kind, members)
    return ways, restrictions


def _restrictions(kind: str, members: list[tuple[str, str, int]]) -> Iterator[Restriction]:
    """One restriction per pair of ways: a relation may forbid to enter from several, or to leave into several."""

    def of(role: str, type_: str) -> list[int]:
        return [ref for name, kind, ref in members if (name, kind) == (role, type_)]

    for start, end in itertools.product(of("from", "w"), of("to", "w")):
        yield Restriction(kind, start, end, frozenset(of("via", "n")), tuple(of("via", "w")))


def _read_nodes(osmium: Any, path: Path, wanted: set[int]) -> tuple[dict[int, tuple[float, float]], dict[int, Light]]:
    lonlat: dict[int, tuple[float, float]] = {}
    lights: dict[int, Light] = {}
    nodes = osmium.FileProcessor(str(path), osmium.osm.NODE)
    if min(wanted, default=0) > 0:  # The filter does not take the negative ids of unpublished nodes.
        nodes = nodes.with_filter(osmium.filter.IdFilter(wanted))
    for node in nodes:
        if node.id not in wanted or not node.location.valid():
            continue
        lonlat[node.id] = (node.location.lon, node.location.lat)
        if node.tags.get("highway") == "traffic_signals":
            facing = node.tags.get("traffic_signals:direction") or node.tags.get("direction") or ""
            lights[node.id] = Light(facing, _kind(node.tags))
    return lonlat, lights


def _kind(tags: Any) -> str:
    what = tags.get("traffic_signals") or ""
    if what in _WITHOUT_CYCLE:
        return UNCYCLED
    if what in _FOR_PEDESTRIANS:
        return PEDESTRIAN
    return CROSSING if tags.get("crossing") or tags.get("crossing_ref") else JUNCTION


def _one_node_per_place(raw: RawMap) -> RawMap:
    """Join nodes that follow each other in a way and lie in one place: between them no street has a direction."""
    joined: dict[int, int] = {}

    def root(node: int) -> int:
        while node in joined:
            node = joined[node]
        return node

    for way in raw.ways:
        for pair in itertools.pairwise(way.nodes):
            one, two = map(root, pair)
            if one != two and one in raw.lonlat and raw.lonlat[one] == raw.lonlat.get(two):
                # A signal on either of them is one of the place.
                kept, gone = sorted((one, two), key=lambda node: (node not in raw.lights, node))
                joined[gone] = kept
    if not joined:
        return raw
    return RawMap(
        [replace(way, nodes=tuple(root(node) for node in way.nodes)) for way in raw.ways],
        [replace(rule, via_nodes=frozenset(map(root, rule.via_nodes))) for rule in raw.restrictions],
        {node: place for node, place in raw.lonlat.items() if node not in joined},
        {node: light for node, light in raw.lights.items() if node not in joined},
    )


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
