"""What the episodes of a results folder can be played again from: its contexts, and where its policies came from."""

from __future__ import annotations

import dataclasses
import gzip
import json
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from izoo.contexts.context import Context
from izoo.contexts.population import DriverPopulation
from izoo.contexts.spec import Approach, GhostSpec, IntersectionSpec, Leg, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.files import expanded, read_bytes, write_bytes
from izoo.zoo.shelf import WEIGHTS

SOURCES_FILE = "sources.json.gz"
FORMAT = "izoo-sources-1"


@dataclass(frozen=True)
class Sources:
    """Contexts and policies of a results folder.

    Attributes:
        contexts: by content hash.
        policies: per policy, a driver's name, ``zoo:NAME``, ``module:function``, or the path of a checkpoint or an
            exported policy, ``.pt``, relative to the folder; ``None`` where it was an object of the calling program.
    """

    contexts: dict[str, Context] = field(default_factory=dict)
    policies: dict[str, str | None] = field(default_factory=dict)


def add_sources(folder: Path, contexts: Iterable[Context], policy: str, source: str | Path | None) -> None:
    """Add an evaluation's contexts and its policy to those that the folder already names.

    Args:
        folder: of the results; it exists.
        policy: its name in the table.
        source: what the policy was made from; a :class:`~pathlib.Path`, or a text that ends in ``.pt``, is a file.
    """
    try:
        old = read_sources(folder)
    except IzooError:
        old = Sources()
    is_file = isinstance(source, Path) or (source is not None and Path(source).suffix == WEIGHTS)
    path = expanded(source or "")
    # A link as the last part stays: it may come to mean another file, and then it is that one that is asked for.
    text = os.path.relpath(path.parent.resolve() / path.name, folder.resolve()) if is_file else source
    everything = {**old.contexts, **{context.content_hash: context for context in contexts}}
    content = {
        "format": FORMAT,
        "policies": {**old.policies, policy: text},
        "contexts": [dataclasses.asdict(everything[key]) for key in sorted(everything)],
    }
    write_bytes(folder / SOURCES_FILE, gzip.compress(json.dumps(content).encode(), mtime=0))


def read_sources(folder: Path) -> Sources:
    """Read what :func:`add_sources` wrote.

    Raises:
        IzooError: the file is missing, damaged, or of another version.
    """
    path = folder / SOURCES_FILE
    if not path.is_file():
        raise IzooError(f"{folder} has no {SOURCES_FILE}, so its episodes cannot be played again; evaluate once more.")
    try:
        values = json.loads(gzip.decompress(read_bytes(path)))
        if values["format"] != FORMAT:
            raise IzooError(f"{path} is of another version of izoo; evaluate again into another folder.")
        contexts = [context_from_dict(entry) for entry in values["contexts"]]
        policies = {str(name): None if source is None else str(source) for name, source in values["policies"].items()}
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise IzooError(f"{path} is damaged; remove it and evaluate again.") from error
    return Sources({context.content_hash: context for context in contexts}, policies)


def context_from_dict(fields: Mapping[str, Any]) -> Context:
    """Rebuild a context from ``dataclasses.asdict``, also after a way through JSON; its hash stays the same."""
    drivers = fields.get("drivers")
    population = None if drivers is None else DriverPopulation(**drivers)
    return Context(**{**fields, "intersection": _spec(fields["intersection"]), "drivers": population})


def _spec(fields: Mapping[str, Any]) -> IntersectionSpec:
    legs = []
    for leg in fields["legs"]:
        approach = leg["approach"]
        if approach is not None:
            approach = Approach(**{**approach, "lanes": tuple(approach["lanes"])})
        legs.append(Leg(**{**leg, "approach": approach}))
    plan = fields["signal_plan"]
    if plan is not None:
        phases = tuple(SignalPhase(p["duration_s"], tuple(tuple(s) for s in p["states"])) for p in plan["phases"])
        plan = SignalPlan(phases, plan["offset_s"])
    changes = {"legs": tuple(legs), "signal_plan": plan, "imputed": tuple(fields["imputed"])}
    return IntersectionSpec(**{**fields, **changes, "ghosts": GhostSpec(**fields["ghosts"])})
