"""Import of the published dataset: a folder per intersection with ``net.net.xml`` and ``inflows.txt``.

Conventions of its nets: the signal is ``TL``; legs are ``A``, ``B``, ...; a leg's incoming edge is ``A2TL``, sometimes
followed by ``A2TL_intern`` (the part with the turn pocket); its outgoing edge is ``TL2A``. Left, straight and right
come from SUMO's connection direction. ``inflows.txt`` holds the annual average daily traffic per lane (veh/day), one
line per leg in letter order, outgoing-only legs included.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from izoo.contexts.cities.weather import CITY_COUNTIES, WEATHER_PUBLISHED, weather
from izoo.contexts.context import Context
from izoo.contexts.source import ContextList
from izoo.contexts.spec import IntersectionSpec
from izoo.errors import IzooError, check_choice
from izoo.files import expanded, read_bytes
from izoo.networks.dataset.netspec import spec_from_net
from izoo.networks.osm.store import CMDP_FILE, load_cmdp

NET_FILE, INFLOW_FILE = "net.net.xml", "inflows.txt"
APPROACH_CHOICES = ("one", "all")
_DOWNLOAD_HINT = "fetch the folder again from the published dataset"


def load_intersection(folder: Path | str) -> IntersectionSpec:
    """Read one intersection folder of the published dataset.

    Args:
        folder: holds ``net.net.xml`` and ``inflows.txt``; its name is the intersection's id, the name of its parent
            folder (with ``-`` for ``_``) the city's.

    Returns:
        the description read from the finished net, with ``net_path`` and ``net_sha256``; heights that the net lacks
        count as 0 and are named in ``imputed``.

    Raises:
        IzooError: the folder or one of its files is missing or cannot be used.
    """
    folder = _existing(folder)
    net = folder / NET_FILE
    if not net.is_file():
        raise IzooError(f"{folder} has no {NET_FILE}; {_DOWNLOAD_HINT}, or remove it from the dataset.")
    spelt = folder.parent.name.replace("-", "_")
    city = spelt if spelt in CITY_COUNTIES else None
    return spec_from_net(
        net,
        name=f"{city or folder.parent.name}/{folder.name}",  # one name, and one split, however a city is spelt
        city=city,
        inflows=lambda legs, incoming: read_inflows(folder / INFLOW_FILE, legs, incoming),
    )


def load_dataset(
    path: Path | str, *, approaches: str = "one", with_demand_only: bool = True, **context_fields: Any
) -> ContextList:
    """Load the contexts of a dataset folder, or of a single intersection folder, in natural order of the ids.

    Args:
        path: a folder of intersection folders, a folder of such folders (one per city), one intersection folder, or a
            folder that was built from OpenStreetMap.
        approaches: ``one``: a context per incoming approach; ``all``: one per intersection, fed from every approach.
        with_demand_only: leave out contexts without any demand.
        **context_fields: fields of every :class:`~izoo.contexts.context.Context`; the weather defaults to the
            published values of the city, in a city without them to its county's summer, elsewhere to those of
            Salt Lake City.

    Raises:
        IzooError: nothing usable is there, or a folder is broken; the message names the file and the remedy.
    """
    check_choice("approaches", approaches, APPROACH_CHOICES)
    contexts: list[Context] = []
    for spec in load_specs(path):
        temperature, humidity = _default_weather(spec.city)
        fields = {"temperature_c": temperature, "humidity_pct": humidity, **context_fields}
        legs: Iterable[str | None] = spec.approach_names if approaches == "one" else (None,)
        found = [Context(spec, approach=leg, **fields) for leg in legs]
        contexts.extend(context for context in found if context.demand_approaches or not with_demand_only)
    if not contexts:
        raise IzooError(f"no approach in {path} has demand; check the {INFLOW_FILE} files, or ask for all approaches.")
    return ContextList(contexts)


def _default_weather(city: str | None) -> tuple[float, float]:
    if city is None or city in WEATHER_PUBLISHED:
        return WEATHER_PUBLISHED[city or "salt_lake_city"]
    return weather(city, "summer")


def load_specs(path: Path | str) -> list[IntersectionSpec]:
    """Load every intersection under ``path``; see :func:`load_dataset` for what may stand there."""
    if (expanded(path) / CMDP_FILE).is_file():
        return load_cmdp(path)
    return [load_intersection(folder) for folder in find_intersections(path)]


def find_intersections(path: Path | str) -> list[Path]:
    """Return the intersection folders under ``path`` in natural order; one folder per city may stand in between.

    Raises:
        IzooError: ``path`` does not exist, or holds no intersection folders.
    """
    path = _existing(path)
    if _holds_intersection(path):
        return [path]
    children = _subfolders(path)
    if any(_holds_intersection(child) for child in children):
        return children
    found = [folder for child in children for folder in _city_folders(child)]
    if not found:
        raise IzooError(
            f"{path} holds no intersection folders; give a folder whose sub-folders hold {NET_FILE} and {INFLOW_FILE}."
        )
    return found


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which ``9`` comes before ``10``."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts)


def read_inflows(path: Path, legs: tuple[str, ...], incoming: frozenset[str]) -> dict[str, float]:
    """Read the AADT per lane (veh/day) of the legs in ``incoming``.

    Args:
        path: the ``inflows.txt``.
        legs: all legs of the net in letter order, outgoing-only legs included; each has a line. A file that has lines
            for letters which the net skips is read by letter.
        incoming: legs with incoming lanes; the lines of other legs are ignored.
    """
    try:
        lines = read_bytes(path).decode("utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise IzooError(f"cannot read {path}: {error.strerror}; {_DOWNLOAD_HINT}.") from error
    filled = [line for line in lines if line.strip()]
    lines = filled if len(filled) >= len(legs) else lines
    if len(lines) < len(legs):
        raise IzooError(
            f"{path} has {len(filled)} lines for the {len(legs)} legs {', '.join(legs)}; "
            "write one AADT value per leg, in letter order, outgoing-only legs included."
        )
    by_letter = ord(legs[-1]) - ord("A") + 1
    place = [ord(leg) - ord("A") for leg in legs] if len(lines) >= by_letter else list(range(len(legs)))
    return {leg: _inflow(lines[row], path, row + 1) for leg, row in zip(legs, place, strict=True) if leg in incoming}


def _inflow(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0.0:
        raise IzooError(
            f"{path}, line {line}: {text.strip()[:40]!r} is not a usable inflow; "
            "write the annual average daily traffic per lane as a number of 0 or more."
        )
    return value


def _existing(path: Path | str) -> Path:
    path = expanded(path)
    if not path.exists():
        raise IzooError(f"{path} does not exist; give the path of a dataset folder or of one intersection folder.")
    if not path.is_dir():
        raise IzooError(f"{path} is not a folder; give a dataset folder, or import an archive of it first.")
    # A link's own name may be the city's, so links are followed only where the path goes up again.
    return path.resolve() if ".." in path.parts else path.absolute()


def _subfolders(path: Path) -> list[Path]:
    found = [child for child in path.iterdir() if child.is_dir() and not child.name.startswith((".", "__"))]
    return sorted(found, key=lambda child: natural_key(child.name))


def _holds_intersection(folder: Path) -> bool:
    return (folder / NET_FILE).exists() or (folder / INFLOW_FILE).exists()


def _city_folders(folder: Path) -> list[Path]:
    children = _subfolders(folder)
    return children if any(_holds_intersection(child) for child in children) else []
