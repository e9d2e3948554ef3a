"""From an :class:`IntersectionSpec` to a SUMO net file: plain XML, ``netconvert``, checks, cache."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import re
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from izoo.console import Progress
from izoo.contexts.spec import IntersectionSpec, Leg
from izoo.cores import usable_cores
from izoo.errors import IzooError
from izoo.networks.net import net_cache as cache
from izoo.networks.net.connections import Link
from izoo.networks.net.heights import add_heights
from izoo.networks.net.netconvert import SUMO_VERSION, convert, convert_together
from izoo.networks.net.plain import PlainNet, plain_net
from izoo.networks.net.programs import stop_mutual_waits
from izoo.networks.signals.search import search_plan

BUILDER_VERSION = 2
"""To be raised whenever the same spec gives another net."""
TOGETHER = 64
"""Most nets of one call of netconvert: more gain little, and what is stored is not lost when a long build is ended."""
FEWEST = 16
"""A core gets so many at least: the start of netconvert costs as much."""
SHOWN_FROM = 256
"""So many nets take long enough for a bar."""
MIN_LANE_M = 2.0
_TURN_OF_DIR = {"r": "r", "R": "r", "s": "s", "l": "l", "L": "l", "t": "l"}
_SIGNAL_LINK = re.compile(
    r'<connection from="([A-F])2TL(?:_intern)?" to="TL2([A-F])" fromLane="(\d+)" toLane="(\d+)"[^>]*? '
    r'tl="TL" linkIndex="(\d+)" dir="(\w)"'
)
_LANE = re.compile(r'<lane id="((?:[A-F]2TL(?:_intern)?|TL2[A-F])_\d+)"[^>]*? length="([\d.]+)"')


def build_net(spec: IntersectionSpec, cache_dir: Path | None = None) -> Path:
    """Return the path of a SUMO net for ``spec``, built when it is not in the cache.

    A spec that brings its own net (``net_path``) is returned as it is. Several processes may build at the same time.

    Args:
        spec: the intersection; without a signal plan one is searched for.
        cache_dir: where nets are kept; see :func:`izoo.networks.net.net_cache.cache_folder`.

    Raises:
        IzooError: the spec contradicts itself, ``netconvert`` refuses it, or the cache cannot be written to.
    """
    if spec.net_path is not None:
        path = Path(spec.net_path)
        if not path.is_file():
            raise IzooError(f"the net {path} of intersection {spec.name} does not exist; import the dataset again.")
        return path
    folder = cache.cache_folder(cache_dir)
    key = net_key(spec)
    return cache.lookup(folder, key) or cache.store(folder, key, _build(spec, folder))


def build_nets(specs: Sequence[IntersectionSpec], cache_dir: Path | None = None) -> list[Path]:
    """Return the paths of SUMO nets, in the order of ``specs``; those that are not in the cache are built together,
    on all cores.

    Each file is byte for byte what :func:`build_net` stores, at a tenth of the time.

    Raises:
        IzooError: what :func:`build_net` says of the first net that cannot be built; the others are in the cache then.
    """
    paths: dict[IntersectionSpec, Path] = {}
    keys = {spec: net_key(spec) for spec in dict.fromkeys(specs) if spec.net_path is None}
    if len(keys) > 1:
        folder = cache.cache_folder(cache_dir)
        paths |= {spec: path for spec, key in keys.items() if (path := cache.lookup(folder, key)) is not None}
        absent = list({key: spec for spec, key in keys.items() if spec not in paths}.items())
        size = min(max(-(-len(absent) // usable_cores()), FEWEST), TOGETHER)
        parts = [dict(absent[first : first + size]) for first in range(0, len(absent), size)]
        bar = Progress(len(absent), unit="nets", file=sys.stderr, shown=len(absent) >= SHOWN_FROM)
        with bar, ThreadPoolExecutor(usable_cores()) as pool:
            for built in pool.map(lambda part: _store_together(part, folder), parts):
                paths |= built
                bar.update(len(paths) - len(keys) + len(absent), "building nets")
    for spec in specs:
        if spec not in paths:
            paths[spec] = build_net(spec, cache_dir)
    return [paths[spec] for spec in specs]


@functools.lru_cache(maxsize=4096)
def net_key(spec: IntersectionSpec) -> str:
    """Return the hash of all that the net of ``spec`` depends on; with a plan given, demand is not part of it."""
    fields = dataclasses.asdict(spec)
    for name in ("name", "city", "imputed", "net_path", "net_sha256", "lonlat"):
        fields.pop(name)
    fields["source"] = spec.source == "procedural"
    for side in (leg["approach"] for leg in fields["legs"] if leg["approach"]):
        if spec.signal_plan or not side["exit_counts"]:
            side.pop("exit_counts")
        if spec.signal_plan:
            side.pop("aadt_per_lane")
    content = json.dumps([BUILDER_VERSION, _sumo_version(), fields], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:40]


@functools.cache
def _sumo_version() -> str:
    try:
        return importlib.metadata.version("eclipse-sumo")
    except importlib.metadata.PackageNotFoundError:
        return SUMO_VERSION  # nets in the cache are found without it


def _store_together(absent: Mapping[str, IntersectionSpec], folder: Path) -> dict[IntersectionSpec, Path]:
    """Build nets, by their keys, in one call, but for those that cannot be built: alone, each says why."""
    plains: dict[str, PlainNet] = {}
    for key, spec in absent.items():
        with contextlib.suppress(IzooError):
            plains[key] = _plain(spec)
    if len(plains) < 2:
        return {}
    try:
        with cache.workspace(folder) as scratch:
            texts = convert_together(list(plains.values()), scratch)
    except IzooError:
        keys = list(plains)
        halves = keys[: len(keys) // 2], keys[len(keys) // 2 :]
        one, two = (_store_together({key: absent[key] for key in half}, folder) for half in halves)
        return one | two
    paths = {}
    for (key, plain), text in zip(plains.items(), texts, strict=True):
        with contextlib.suppress(IzooError):
            paths[absent[key]] = cache.store(folder, key, _finished(absent[key], plain, text, ""))
    return paths


def _plain(spec: IntersectionSpec) -> PlainNet:
    return plain_net(spec, spec.signal_plan or search_plan(spec))


def _build(spec: IntersectionSpec, folder: Path) -> str:
    plain = _plain(spec)
    with cache.workspace(folder) as scratch:
        return _finished(spec, plain, *convert(spec.name, plain, scratch))


def _finished(spec: IntersectionSpec, plain: PlainNet, text: str, messages: str) -> str:
    """Return the net as it is stored, of what netconvert made and said."""
    text = _checked_links(spec.name, text, plain.links, messages)
    _check_lanes(spec, text, messages)
    return add_heights(stop_mutual_waits(text), spec)


def _checked_links(name: str, text: str, links: tuple[Link, ...], messages: str) -> str:
    """Check that every link is there, and make the directions that SUMO reports those of the spec.

    ``netconvert`` calls a movement a turn when another exit is straighter, and a sharp turn on a one-way leg a U-turn;
    the spec's turns follow from bearings alone, and vehicles, observations and demand must all mean the same.
    """
    found: dict[int, Link] = {}

    def settle(match: re.Match[str]) -> str:
        start, end, lane, target, index, direction = match.groups()
        link = links[int(index)]
        found[int(index)] = Link(start, int(lane), end, int(target), link.turn)
        keep = _TURN_OF_DIR.get(direction) == link.turn
        return match.group(0) if keep else match.group(0)[:-2] + f'{link.turn}"'

    text = _SIGNAL_LINK.sub(settle, text)
    lost = [link for index, link in enumerate(links) if found.get(index) != link]
    if lost:
        raise IzooError(
            f"netconvert dropped the connection from lane {lost[0].from_lane} of {lost[0].from_leg} to lane "
            f"{lost[0].to_lane} of {lost[0].to_leg} at intersection {name}. {messages}"
        )
    return text


def _check_lanes(spec: IntersectionSpec, text: str, messages: str) -> None:
    """Check that the junctions left something of every lane."""
    lengths = {lane: float(length) for lane, length in _LANE.findall(text)}
    for leg in spec.legs:
        for lane in _lane_ids(leg):
            if lengths.get(lane, 0.0) < MIN_LANE_M:
                raise IzooError(
                    f"intersection {spec.name}: leg {leg.name} is too short, its junctions leave "
                    f"{lengths.get(lane, 0.0):g} m of lane {lane}; make it longer. {messages}"
                )


def _lane_ids(leg: Leg) -> list[str]:
    lanes = [f"TL2{leg.name}_{index}" for index in range(leg.exit_lanes)]
    if leg.approach is not None:
        lanes += [f"{leg.name}2TL_{index}" for index in range(leg.approach.main_lane_count)]
    return lanes
