"""Features of nets that SUMO supports and the twin does not: such nets are refused when they are read.

Features that neither simulator can represent are refused before, by :mod:`izoo.networks.representable`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from izoo.contexts.context import Context
from izoo.envs.twin.driving.tolerances import VISIBILITY_M
from izoo.errors import IzooError
from izoo.networks.net.build import build_nets
from izoo.networks.representable import CAR, check_representable, is_no, open_to_cars
from izoo.networks.road import parse_net

SIGNAL_LETTERS = "GgyYrs"
_WALKED = ("crossing", "walkingarea")
_LANES_REMARK = "on the twin all vehicles may use every lane, and change to each neighbouring one"


def check_contexts(contexts: Iterable[Context]) -> None:
    """Refuse contexts that the twin cannot play; their nets are built for that.

    Raises:
        IzooError: a net cannot be built or read, or is not supported; the message names the context.
    """
    by_net = {context.intersection: context for context in contexts}
    for path, context in zip(build_nets(list(by_net)), by_net.values(), strict=True):
        try:
            root = parse_net(path.read_bytes(), path)
            check_representable(root, str(path))
            check_supported(root, str(path))
        except IzooError as error:
            raise IzooError(f"context {context.name}: {error}") from error


def check_supported(root: Any, path: str) -> None:
    """Refuse a net that the twin would not play like SUMO.

    Raises:
        IzooError: it has an unsupported feature; the message names the first.
    """
    for features in (_signals, _lanes, _connections):
        for feature, remark in features(root):
            raise IzooError(f"{path}: {feature}; {remark}. Use simulator=sumo.")


def _signals(root: Any) -> Iterator[tuple[str, str]]:
    for logic in root.findall("tlLogic"):
        name = f"signal {logic.get('id')}"
        if logic.get("type", "static") != "static":
            yield f"{name} is of type {logic.get('type')}", "the twin plays static programs only"
        for phase in logic.findall("phase"):
            if phase.get("next") is not None:
                yield f"{name} has a phase with next={phase.get('next')!r}", "the twin plays phases in their order"
            for letter in phase.get("state", ""):
                if letter not in SIGNAL_LETTERS:
                    yield f"{name} shows {letter!r}", f"the twin knows the letters {' '.join(SIGNAL_LETTERS)}"


def _lanes(root: Any) -> Iterator[tuple[str, str]]:
    for edge in root.findall("edge"):
        for element in edge.iter():
            if element.tag == "stopOffset":
                yield f"edge {edge.get('id')} has a stopOffset", "on the twin vehicles stop at the end of the lane"
            if element.tag != "lane" or edge.get("function") in _WALKED:
                continue
            for name in ("changeLeft", "changeRight"):
                if not {"all", CAR} & set(element.get(name, "all").split()):
                    yield f"lane {element.get('id')} has {name}={element.get(name)!r}", _LANES_REMARK
            if not open_to_cars(element):
                name = "allow" if element.get("allow") else "disallow"
                yield f"lane {element.get('id')} has {name}={element.get(name)!r}", _LANES_REMARK


def _connections(root: Any) -> Iterator[tuple[str, str]]:
    for connection in root.findall("connection"):
        name = f"the connection from {connection.get('from')} to {connection.get('to')}"
        visibility = connection.get("visibility")
        if visibility is not None and float(visibility) != VISIBILITY_M:
            yield f"{name} has visibility={visibility!r}", f"on the twin drivers see others from {VISIBILITY_M:g} m on"
        if is_no(connection.get("keepClear", "1")):
            yield f"{name} has keepClear={connection.get('keepClear')!r}", "on the twin drivers keep junctions clear"
