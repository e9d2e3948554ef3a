"""Results folders: rows that are appended as episodes end, a manifest of what they were played with, and the contexts,
so that episodes can be played again."""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import importlib.metadata
import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pandas as pd

import izoo
from izoo.contexts.context import Context
from izoo.contexts.population import DriverPopulation
from izoo.contexts.spec import spec_from_dict
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.metric_sums import MOVEMENT_METRICS
from izoo.envs.model_version import MODEL_VERSION
from izoo.errors import IzooError, check_line
from izoo.files import MOST_UNPACKED_BYTES, claimed, read_bytes, read_text, reading, unpacked, write_bytes, write_json
from izoo.options import from_mapping
from izoo.results.rows_file import Row, RowsFile
from izoo.results.schema import COLUMNS, EPISODE, TEXT, WHOLE, make_table

FORMAT = "izoo-results-1"
ROWS_FILE, MANIFEST_FILE = "rows.csv", "manifest.json"
INDIFFERENT = ("emit", "recycle_episodes", "watchdog_s", "gui")
"""Settings of an environment that change no number."""
SHARED = ("step_s", "horizon_s", "warmup_s", "drain_s", "num_approaches", "late_vehicle")
"""Settings that all rows of a folder share; the others belong to a policy."""
Key = str | tuple[str, int]
"""A policy's name, or its name and training seed."""


@dataclass(frozen=True)
class PolicyRecord:
    """What is known of a policy, per training seed.

    Attributes:
        kind: what it is.
        weights: SHA-256 of its weights (:func:`izoo.results.policies.weights_hash`), if it has any.
        source: what it can be made from again: a driver's name, ``zoo:NAME``, ``module:function``, or the path of a
            checkpoint or exported policy, relative to the results folder where it is written.
        algo, frames: how it was trained, and on how many environment steps.
        env: settings of the environment that belong to it, such as what it observes.
    """

    kind: Literal["scripted", "trained", "untrained"] = "scripted"
    weights: str | None = None
    source: str | None = None
    algo: str | None = None
    frames: int | None = None
    env: dict[str, Any] | None = None

    def is_same(self, other: PolicyRecord) -> bool:
        """Return whether it is the same policy: same weights, or without any the same source."""
        return self.weights == other.weights and (self.weights is not None or self.source == other.source)


@dataclass(frozen=True)
class Manifest:
    """What a results folder was played with.

    Attributes:
        task: what was tested.
        model_version: :data:`izoo.envs.MODEL_VERSION`.
        env: settings of the environment; of a policy's own, those of its record hold.
        versions: of izoo, Python and packages.
        policies: by name and training seed.
        complete: false while episodes are missing.
    """

    task: str = ""
    model_version: int = 0
    env: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    policies: dict[str, dict[int, PolicyRecord]] = field(default_factory=dict)
    complete: bool = False

    def config(self, policy: str, train_seed: int = 0) -> EnvConfig:
        """Return the environment that a policy was played in."""
        record = self.policies.get(policy, {}).get(train_seed, PolicyRecord())
        return from_mapping(EnvConfig, {**self.env, **(record.env or {})})

    def shared(self) -> dict[str, Any]:
        """Return what all rows of the folder share."""
        env = {name: self.env.get(name) for name in SHARED}
        return {**env, "model_version": self.model_version, "sumo": self.versions.get("sumo")}


class Store:
    """A results folder, or a table in memory alone.

    Args:
        path: the folder; ``None`` keeps rows in memory.
        task: what is tested.
        config: the environment.

    Attributes:
        done: :data:`~izoo.results.schema.EPISODE` of the episodes that are there.
    """

    def __init__(self, path: Path | str | None, *, task: str = "", config: EnvConfig | None = None) -> None:
        self.path = None if path is None else Path(path)
        if task:
            check_line("the name of a task", task)
        env = settings(config or EnvConfig())
        self.manifest = Manifest(task, MODEL_VERSION, env, versions())
        self.file = rows_file(self.path)
        self.done: set[tuple[Any, ...]] = set()

    @contextlib.contextmanager
    def open(self, policies: Mapping[Key, PolicyRecord] | None = None) -> Iterator[Store]:
        """Read what is there, :meth:`admit` policies, and keep other processes out; the end of the block completes it.

        Raises:
            IzooError: the folder was written with other settings or by another version, or another process works in it.
        """
        with contextlib.nullcontext() if self.path is None else claimed(self.path):
            self.read()
            self.admit(policies or {})
            yield self
            self._update(complete=True)

    def admit(self, policies: Mapping[Key, PolicyRecord]) -> None:
        """Name policies that are about to be played; rows of other weights under the same name are dropped.

        Raises:
            IzooError: a policy was played here with other settings of its own.
        """
        known = {name: dict(seeds) for name, seeds in self.manifest.policies.items()}
        stale = set()
        for key, record in policies.items():
            name, train_seed = key if isinstance(key, tuple) else (key, 0)
            check_line("the name of a policy", name)
            old = known.get(name, {}).get(train_seed)
            if old is not None and old.env and record.env:
                check_same(old.env, record.env, f"{self.path} holds {name}")
            if old is not None and not old.is_same(record):
                stale.add((name, train_seed))
            known.setdefault(name, {})[train_seed] = record
        if stale:
            self.file.replace(row for row in self.file.rows if (row["policy"], row["train_seed"]) not in stale)
            self.done = _episodes(self.file.rows)
        self._update(policies=known, complete=False)

    def keep_contexts(self, contexts: Iterable[Context]) -> None:
        """Keep contexts, so that their episodes can be played again."""
        if self.path is not None:
            add_contexts(self.path, contexts)

    def add(self, rows: list[Row]) -> None:
        """Append the rows of one episode, all of them or none."""
        self.file.add(rows)
        self.done |= _episodes(rows)

    @property
    def table(self) -> pd.DataFrame:
        """All rows, those of earlier evaluations too."""
        return make_table(self.file.rows)

    def read(self, mend: bool = True) -> None:
        """Read what is there; ``mend`` as for :meth:`~izoo.results.rows_file.RowsFile.read`.

        Raises:
            IzooError: the folder was written with other settings or by another version.
        """
        path = self.path
        if path is not None and (path / MANIFEST_FILE).exists():
            old = read_manifest(path)
            check_same(old.shared(), self.manifest.shared(), f"{path} holds results")
            self.manifest = dataclasses.replace(old, versions=self.manifest.versions)
            self.done = _episodes(self.file.read(mend).rows)
        elif path is not None and (path / ROWS_FILE).exists():
            raise IzooError(f"{path} has a {ROWS_FILE} without its {MANIFEST_FILE}; choose another folder.")

    def _update(self, **changes: Any) -> None:
        self.manifest = dataclasses.replace(self.manifest, **changes)
        if self.path is not None:
            write_json(self.path / MANIFEST_FILE, {"format": FORMAT, **dataclasses.asdict(self.manifest)})


def read_table(folder: Path | str) -> pd.DataFrame:
    """Return the table of a results folder.

    Raises:
        IzooError: it is not a results folder, or its table cannot be read.
    """
    folder = Path(folder)
    read_manifest(folder)
    if not (folder / ROWS_FILE).exists():
        raise IzooError(f"{folder} has no episodes yet; run the evaluation again.")
    return make_table(rows_file(folder).read(mend=False).rows)


def rows_file(folder: Path | None) -> RowsFile:
    """Return the file of a results folder that holds its table."""
    return RowsFile(None if folder is None else folder / ROWS_FILE, COLUMNS, TEXT, WHOLE, MOVEMENT_METRICS)


def read_manifest(folder: Path | str) -> Manifest:
    """Return the manifest of a results folder.

    Raises:
        IzooError: as :func:`read_table`.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise IzooError(f"{folder}: no such results folder.")
    path = folder / MANIFEST_FILE
    if not path.exists():
        raise IzooError(f"{folder} is not a results folder: it has no {MANIFEST_FILE}.")
    with reading(path):
        content = json.loads(read_text(path))
        if content.pop("format") != FORMAT:
            raise IzooError(f"{path} is of another version of izoo; evaluate again into another folder.")
        policies = {
            name: {int(seed): PolicyRecord(**record) for seed, record in seeds.items()}
            for name, seeds in content.pop("policies").items()
        }
        return Manifest(**content, policies=policies)


def settings(config: EnvConfig) -> dict[str, Any]:
    """Return the settings that change numbers, as plain values for JSON."""
    values = json.loads(json.dumps(dataclasses.asdict(config)))
    return {name: value for name, value in values.items() if name not in INDIFFERENT}


def own_settings(config: EnvConfig) -> dict[str, Any]:
    """Return the settings that belong to a policy: what it observes, how long its decisions hold, its reward."""
    return {name: value for name, value in settings(config).items() if name not in SHARED}


def check_same(stored: Mapping[str, Any], wanted: Mapping[str, Any], what: str) -> None:
    """Raise :class:`IzooError` naming the (nested) settings in which two mappings differ.

    Args:
        stored, wanted: the settings.
        what: the beginning of the sentence, such as ``FOLDER holds results``.
    """
    old, new = flat(stored), flat(wanted)
    changed = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
    if changed:
        listed = ", ".join(f"{key} {_short(old.get(key))} -> {_short(new.get(key))}" for key in changed)
        raise IzooError(f"{what} with other settings ({listed}); choose another folder.")


def versions() -> dict[str, str]:
    """Return the versions of izoo, Python and the packages that simulate and learn."""
    packages = {"sumo": "libsumo", "torch": "torch", "torchrl": "torchrl"}
    found = {name: importlib.metadata.version(package) for name, package in packages.items()}
    return {"izoo": izoo.__version__, "python": platform.python_version(), **found}


def _episodes(rows: Iterable[Row]) -> set[tuple[Any, ...]]:
    return {tuple(row[column] for column in EPISODE) for row in rows}


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by their paths, such as ``algo.lr``."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:12]}..."


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
