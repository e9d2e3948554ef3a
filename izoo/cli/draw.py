"""What ``python -m izoo.contexts draw`` draws: finds the intersections that a word or a path means."""

from __future__ import annotations

import re
from pathlib import Path

from izoo.contexts import catalogue
from izoo.contexts.cities import rebuilt as cities
from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.dataset.intersections import find_intersections, load_intersection, load_specs
from izoo.networks.draw.intersection import draw_features, draw_intersection, save_png
from izoo.networks.draw.town import draw_town
from izoo.networks.osm.store import CMDP_FILE, load_record


def draw(what: str, png: Path) -> Path:
    """Draw ``what`` to ``png`` and return the path that was written.

    Args:
        what: an intersection's folder or ``.json`` file, a town built from OpenStreetMap (its map), a folder of several
            others (their features), or, where there is no such path, an id of the catalogue, a city's name (its
            features) or ``CITY/NUMBER``.

    Raises:
        IzooError: it is none of these, or the picture cannot be written.
    """
    check_png(png)
    path = expanded(what)
    if path.exists():
        return _draw_path(path, png)
    if re.fullmatch(r"-?\d{1,18}", what, re.ASCII):
        return draw_intersection(catalogue.get(int(what)).intersection, png)
    city, _, number = what.partition("/")
    try:
        cities.city_name(city)
    except IzooError as error:
        names = ", ".join(cities.CITIES)
        text = f"{what!r} is neither a path, nor an id of the catalogue, nor one of the cities {names}."
        raise IzooError(text) from error
    if not number:
        return draw_features(cities.get(city), png, title=cities.city_name(city))
    size = len(cities.get(city))
    if not number.isdecimal() or int(number) >= size:
        raise IzooError(f"intersection {number} of {city} does not exist; legal: 0 to {size - 1}.")
    return draw_intersection(cities.get(city)[int(number)], png)


def check_png(path: Path) -> None:
    """Refuse a path that no picture can be written to, before any work is done."""
    if path.suffix.lower() != ".png":
        raise IzooError(f"pictures are written as PNG; {path} must end in .png.")
    if path.is_dir():
        raise IzooError(f"{path} is a folder; give the name of a file in it.")


def _draw_path(path: Path, png: Path) -> Path:
    if path.suffix == ".json" and path.is_file() and path.name != CMDP_FILE:
        spec, streets = load_record(path)
        return draw_intersection(spec, png, streets)
    if not (path / CMDP_FILE).is_file():
        folders = find_intersections(path)
        if len(folders) == 1:
            return draw_intersection(load_intersection(folders[0]), png)
    specs = load_specs(path)
    if all(spec.lonlat for spec in specs):
        return save_png(draw_town(specs, f"{path.resolve().name}: vehicles in the peak hour"), png)
    return draw_features(specs, png, title=path.resolve().name)
