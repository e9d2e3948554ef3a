"""The folder of an evaluation: what is in it, what may be added to it, and how it survives an interruption."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.errors import IzooError
from izoo.evaluation.table import (
    CSV_FILE,
    EPISODE_KEY,
    JOURNAL_FILE,
    MANIFEST_FILE,
    SUMMARY_FILE,
    make_table,
    read_csv,
    read_journal,
    write_csv,
)
from izoo.files import claimed, read_text, write_json, write_text

FORMAT = 1


class ResultFolder:
    """Rows of an evaluation, kept in memory and, where a path is given, in its files.

    While it is open, finished episodes are appended to a journal; closing it writes ``evaluation.csv`` and
    ``summary.json`` whole and removes the journal. ``evaluation.json`` holds the settings and the fingerprints of the
    policies.

    Args:
        path: the folder, or ``None`` to keep nothing.
        settings: what every row of the folder must share (:func:`izoo.evaluation.provenance.settings`).

    Attributes:
        done: ``(policy, context hash, seed)`` of the episodes that are there.
        table: all rows; set when the folder is closed.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]) -> None:
        self.path, self.settings = path, settings
        self.done: set[tuple[str, str, int]] = set()
        self.table: pd.DataFrame = make_table([])
        self._rows: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def open(self, policy: str, fingerprint: str) -> Iterator[None]:
        """Read what is there, and write everything at the end, also after an error.

        Args:
            policy: name of the policy that is about to be evaluated.
            fingerprint: its fingerprint; rows of another one under this name are dropped.

        Raises:
            IzooError: the folder was written with other settings, is damaged, or another process works in it.
        """
        with contextlib.nullcontext() if self.path is None else claimed(self.path):
            if self.path is not None:
                self._read(self.path, policy, fingerprint)
            whole = False
            try:
                yield
                whole = True
            finally:
                self.table = make_table(self._rows)
                if self.path is not None:
                    self._write(self.path, whole)

    def add(self, rows: list[dict[str, Any]]) -> None:
        """Add the rows of one episode."""
        self._rows.extend(rows)
        if self.path is not None and rows:
            with (self.path / JOURNAL_FILE).open("a") as journal:
                journal.write(json.dumps(rows) + "\n")

    def _read(self, path: Path, policy: str, fingerprint: str) -> None:
        manifest = _read_manifest(path / MANIFEST_FILE)
        policies: dict[str, str] = {}
        if manifest is not None:
            _compare(manifest["settings"], self.settings, path)
            policies = manifest["policies"]
            rows = read_csv(path / CSV_FILE).to_dict("records") if (path / CSV_FILE).exists() else []
            rows += read_journal(path / JOURNAL_FILE)
            stale = policies.get(policy, fingerprint) != fingerprint
            unique = {(*(row[column] for column in EPISODE_KEY), row["approach"]): row for row in rows}
            self._rows = [row for row in unique.values() if not (stale and row["policy"] == policy)]
            self.done = {tuple(row[column] for column in EPISODE_KEY) for row in self._rows}  # type: ignore[misc]
        elif (path / CSV_FILE).exists():
            raise IzooError(f"{path} holds an {CSV_FILE} without its {MANIFEST_FILE}; choose another folder.")
        if self._rows or (path / CSV_FILE).exists():
            write_csv(make_table(self._rows), path / CSV_FILE)
            write_text(path / JOURNAL_FILE, "")  # its rows are in the table; that it is there says: not yet whole
        else:
            (path / JOURNAL_FILE).unlink(missing_ok=True)
        content = {"format": FORMAT, "settings": self.settings, "policies": {**policies, policy: fingerprint}}
        write_json(path / MANIFEST_FILE, content)

    def _write(self, path: Path, whole: bool) -> None:
        from izoo.evaluation.summary import summarise

        if self.table.empty:
            return
        write_csv(self.table, path / CSV_FILE)
        (path / SUMMARY_FILE).unlink(missing_ok=True)
        if not whole:
            # The rows are in the table as well; that the journal is there says that more of them are to come.
            (path / JOURNAL_FILE).touch()
            return
        (path / JOURNAL_FILE).unlink(missing_ok=True)
        with contextlib.suppress(IzooError):  # an interrupted evaluation may lack baselines
            write_json(path / SUMMARY_FILE, summarise(self.table, self.settings.get("simulator", "sumo")))


def _read_manifest(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        manifest = json.loads(read_text(path))
        if manifest["format"] != FORMAT:
            raise IzooError(f"{path} is of another version of izoo; choose another folder.")
        return {"settings": dict(manifest["settings"]), "policies": dict(manifest["policies"])}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, IzooError):
            raise
        raise IzooError(f"{path} is damaged; remove the folder and evaluate again.") from error


def _compare(stored: dict[str, Any], wanted: dict[str, Any], path: Path) -> None:
    """Raise :class:`IzooError` naming the settings in which a folder differs from what is asked for."""
    changes = differences(stored, wanted)
    if changes:
        raise IzooError(f"{path} holds an evaluation with other settings ({changes}); choose another folder.")


def differences(stored: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Return in which of their (nested) settings two mappings differ, as ``name old -> new, ...``; empty: in none."""
    old, new = flat(stored), flat(wanted)
    differing = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
    return ", ".join(f"{key} {_short(old.get(key))} -> {_short(new.get(key))}" for key in differing)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their paths, ``a.b.c``."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:12]}..."
