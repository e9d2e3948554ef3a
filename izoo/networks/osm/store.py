"""The folder that a build from OpenStreetMap leaves: one JSON file per intersection and an index of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from izoo.contexts.spec import IntersectionSpec, spec_from_dict
from izoo.errors import IzooError
from izoo.files import check_replaceable, expanded, os_reason, reading, replacing_folder
from izoo.networks.osm.counts import check_exit_counts
from izoo.networks.osm.plans import with_plan

CMDP_FILE = "cmdp.json"
FORMAT = "izoo-osm-1"
ATTRIBUTION = "Contains information from OpenStreetMap, made available under the Open Database License (ODbL) 1.0"


def check_target(target: Path) -> None:
    """Refuse a target that holds anything but an earlier build, or one that has been edited since."""
    written = {}
    if (target / CMDP_FILE).is_file():
        written = _read(target / CMDP_FILE).get("sha256", {})
    check_replaceable(target, lambda: {CMDP_FILE, *(f"{key}.json" for key in _index(target))} if written else set())
    edited = [f"{key}.json" for key, digest in written.items() if _digest(target / f"{key}.json") not in (digest, None)]
    if edited:
        raise IzooError(
            f"{target / edited[0]} has been edited since it was built, and a build would replace it; choose another "
            "target, or move that file away and give its values through --signals and --aadt."
        )


def save_cmdp(
    target: Path, specs: Mapping[str, IntersectionSpec], details: Mapping[str, Any], notes: Mapping[str, Any]
) -> None:
    """Write a build to ``target``, replacing an earlier one; a reader sees all of it or nothing.

    Args:
        target: accepted by :func:`check_target`.
        specs: the intersections by key; each becomes ``KEY.json``.
        details: further facts per intersection (street names, place).
        notes: facts about the build, for the index.
    """
    try:
        with replacing_folder(target) as staging:
            for key, spec in specs.items():
                record = {"format": FORMAT, "attribution": ATTRIBUTION, "spec": asdict(spec), **details[key]}
                (staging / f"{key}.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
            digests = {key: _digest(staging / f"{key}.json") for key in specs}
            index = {"format": FORMAT, "attribution": ATTRIBUTION, **notes, "intersections": list(specs)}
            index["sha256"] = digests
            (staging / CMDP_FILE).write_text(json.dumps(index, indent=1), encoding="utf-8")
    except OSError as error:
        raise IzooError(f"cannot write to {target}: {os_reason(error)}; choose another target.") from error


def load_cmdp(folder: Path | str) -> list[IntersectionSpec]:
    """Load the intersections of a build in the order of its index.

    Raises:
        IzooError: a file is missing, damaged, or of another format version.
    """
    folder = expanded(folder)
    return [load_record(folder / f"{key}.json")[0] for key in _index(folder)]


def load_record(file: Path) -> tuple[IntersectionSpec, dict[str, str]]:
    """Load one intersection of a build, and the names of its streets by leg.

    Raises:
        IzooError: the file is missing, damaged, or of another format version.
    """
    record = _read(file)
    with reading(file):
        lon, lat = map(float, record["lonlat"])
        spec = replace(spec_from_dict({**record["spec"], "signal_plan": None}), lonlat=(lon, lat))
        plan, streets = record["spec"]["signal_plan"], {str(leg): str(name) for leg, name in record["streets"].items()}
    try:
        check_exit_counts(spec)
        return with_plan(spec, plan), streets
    except IzooError as error:
        raise IzooError(f"{file}: {error}") from error


def _digest(file: Path) -> str | None:
    """SHA-256 of a file; ``None`` where there is none."""
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None


def _index(folder: Path) -> list[str]:
    return list(map(str, _read(folder / CMDP_FILE).get("intersections", ())))


def _read(path: Path) -> dict[str, Any]:
    with reading(path):
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["format"] != FORMAT:
            raise IzooError(f"{path} is not of the format {FORMAT}; build the folder again with this version of izoo.")
    return record
