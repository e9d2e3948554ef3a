"""The contexts of a results folder, so that its episodes can be played again."""

from __future__ import annotations

import dataclasses
import gzip
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from izoo.contexts.context import Context
from izoo.contexts.population import DriverPopulation
from izoo.contexts.spec import spec_from_dict
from izoo.files import MOST_UNPACKED_BYTES, read_bytes, reading, unpacked, write_bytes

CONTEXTS_FILE = "contexts.json.gz"


def add_contexts(folder: Path, contexts: Iterable[Context]) -> None:
    """Add contexts to those that a results folder already has."""
    old = read_contexts(folder) if (folder / CONTEXTS_FILE).exists() else {}
    every = old | {context.content_hash: context for context in contexts}
    if len(every) > len(old):
        content = [dataclasses.asdict(every[key]) for key in sorted(every)]
        write_bytes(folder / CONTEXTS_FILE, gzip.compress(json.dumps(content).encode(), mtime=0))


def read_contexts(folder: Path) -> dict[str, Context]:
    """Return the contexts of a results folder by content hash.

    Raises:
        IzooError: the file is missing or cannot be read.
    """
    path = folder / CONTEXTS_FILE
    with reading(path):
        found = [context_from_dict(entry) for entry in json.loads(unpacked(read_bytes(path, MOST_UNPACKED_BYTES)))]
    return {context.content_hash: context for context in found}


def context_from_dict(fields: Mapping[str, Any]) -> Context:
    """Rebuild a context from ``dataclasses.asdict``, also after a way through JSON; its hash stays the same."""
    drivers = fields.get("drivers")
    population = None if drivers is None else DriverPopulation(**drivers)
    return Context(**{**fields, "intersection": spec_from_dict(fields["intersection"]), "drivers": population})
