"""The drivable streets of an OpenStreetMap extract (``.osm``, ``.osm.pbf``, compressed or not), in metres.

Positions are metres east and north of the extract's centre; at the size of a city the projection is true to 0.1 %.

Where traffic drives on the left the map is mirrored: east and west, left and right change places, in positions, lanes
and restrictions, and all that is made of it drives on the right.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.osm.raw import CROSSING, PEDESTRIAN, REVERSIBLE, SUFFIXES, UNCYCLED, Restriction, Way, read_raw

EARTH_RADIUS_M = 6_371_000.0
_SIDE_WORD = re.compile("left|right")


@dataclass(frozen=True)
class StreetMap:
    """Streets of one extract.

    Attributes:
        ways: drivable ways by id; a way that leaves the extract is cut where its nodes are missing.
        position_m: per node, metres east and north of the centre.
        lonlat: per node, degrees.
        signals: signal nodes on drivable ways, with the direction (``forward``, ``backward`` or ``""``) they face.
        crossings: those of them that are tagged as crossings too, which stop lines are as well.
        pedestrian: those of them that are for pedestrians alone.
        uncycled: how many other signal nodes there are that show no cycle: they blink, meter a ramp, or wait for an
            emergency.
        restrictions: turn restrictions between drivable ways.
        mirrored: where traffic drives on the left, and the map is mirrored, the name of the region; otherwise ``""``.
    """

    ways: dict[int, Way]
    position_m: dict[int, tuple[float, float]]
    lonlat: dict[int, tuple[float, float]]
    signals: dict[int, str]
    restrictions: tuple[Restriction, ...]
    crossings: frozenset[int] = frozenset()
    pedestrian: frozenset[int] = frozenset()
    uncycled: int = 0
    mirrored: str = ""

    @property
    def reversible(self) -> tuple[str, ...]:
        """Names, or ids, of streets whose direction changes with time; they count as two-way."""
        found = (way for way in self.ways.values() if way.tags.get("oneway") in REVERSIBLE)
        return tuple(dict.fromkeys(way.name or f"way {way.id}" for way in found))

    def drawn_lonlat(self, node: int) -> tuple[float, float]:
        """Degrees of a node, mirrored as the map is."""
        lon, lat = self.lonlat[node]
        return (2.0 * _centre(self.lonlat)[0] - lon if self.mirrored else lon), lat


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
    raw = read_raw(path)
    kept = {way.id: way for whole in raw.ways for way in _cut(whole, raw.lonlat)}
    if not kept:
        raise IzooError(f"{path} holds no drivable streets; export an extract that contains streets with their nodes.")
    used = {node for way in kept.values() for node in way.nodes}
    lonlat = {node: place for node, place in raw.lonlat.items() if node in used}
    lights = {node: light for node, light in raw.lights.items() if node in used}
    signals = {node: light for node, light in lights.items() if light.kind != UNCYCLED}
    streets = StreetMap(
        ways=kept,
        position_m=_project(lonlat),
        lonlat=lonlat,
        signals={node: light.facing for node, light in signals.items()},
        restrictions=tuple(
            rule for rule in raw.restrictions if {rule.from_way, rule.to_way, *rule.via_ways} <= set(kept)
        ),
        crossings=frozenset(node for node, light in signals.items() if light.kind == CROSSING),
        pedestrian=frozenset(node for node, light in signals.items() if light.kind == PEDESTRIAN),
        uncycled=len(lights) - len(signals),
    )
    region = left_hand_region(*_centre(lonlat))
    left = region is not None if drives_on is None else drives_on == "left"
    return _mirrored(streets, region or "as given") if left else streets


def _mirrored(streets: StreetMap, region: str) -> StreetMap:
    return replace(
        streets,
        ways={number: replace(way, tags=_mirrored_tags(way.tags)) for number, way in streets.ways.items()},
        position_m={node: (-x, y) for node, (x, y) in streets.position_m.items()},
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


Side = Literal["left", "right"]
SIDES: tuple[Side, ...] = ("left", "right")
REGIONS_FILE = "left_hand_regions.json"
"""By the name of the region, outlines of ``[longitude, latitude]`` in degrees."""


@functools.cache
def _regions() -> dict[str, list[Any]]:
    from matplotlib.path import Path as Outline

    regions = json.loads(resources.files(__package__).joinpath(REGIONS_FILE).read_text("utf-8"))
    return {name: [Outline(points) for points in outlines] for name, outlines in regions.items()}


def left_hand_region(lon: float, lat: float) -> str | None:
    """Return the region where traffic drives on the left that holds a place, or ``None``."""
    regions = _regions().items()
    return next((name for name, outlines in regions if any(o.contains_point((lon, lat)) for o in outlines)), None)
