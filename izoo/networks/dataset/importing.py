"""Import of a downloaded dataset: every intersection is checked, the usable ones are copied and indexed.

The target holds one folder per dataset (its name says the city), ``index.csv`` and ``manifest.json``. It appears whole,
or not at all. Folders keep their names where these are plain, and no more is unpacked than a net may hold.
"""

from __future__ import annotations

import csv
import functools
import hashlib
import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from izoo.console import counted, plain
from izoo.contexts.spec import IntersectionSpec
from izoo.errors import IzooError
from izoo.files import check_replaceable, expanded, os_reason, read_bytes, replacing_folder, write_json
from izoo.networks.dataset.intersections import INFLOW_FILE, NET_FILE, load_intersection, natural_key

MANIFEST, INDEX = "manifest.json", "index.csv"
FORMAT = "izoo-intersections-1"
_SAFE_NAME = re.compile(r"\w[\w .+-]{0,99}")
Progress = Callable[[int, int], None]
"""Called with the number of folders done and their total."""


@dataclass(frozen=True)
class ImportReport:
    """What an import did.

    Attributes:
        target: the folder to give to :func:`izoo.networks.dataset.intersections.load_dataset`.
        usable: the imported intersections, in natural order.
        unusable: why each of the other folders was left out, by its path in the source.
    """

    target: Path
    usable: tuple[IntersectionSpec, ...]
    unusable: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        legs = sum(len(spec.approach_names) for spec in self.usable)
        idle = legs - sum(len(_with_demand(spec)) for spec in self.usable)
        places = counted(len(self.usable), "intersection")
        lines = [f"imported {places} with {legs} approaches ({idle} of them without demand) into {self.target}"]
        lines += [f"unusable: {place}: {reason}" for place, reason in self.unusable.items()]
        return "\n".join(map(plain, lines))


def import_dataset(source: Path | str, target: Path | str, progress: Progress | None = None) -> ImportReport:
    """Check every intersection folder of ``source``, copy the usable ones into ``target`` and index them.

    Args:
        source: a folder or a zip archive of intersection folders, with or without a folder per city around them.
        target: a new or empty folder, or an earlier import, which is replaced once the new one is complete.
        progress: called after each folder.

    Raises:
        IzooError: the source is missing, hostile or holds no usable intersection, or the target holds other files.
            The target is then as it was before.
    """
    source, target = expanded(source), expanded(target).absolute()
    with open_archive(source) as archive:
        places = _find_places(archive)
        if not places:
            raise IzooError(f"{source} holds no intersection folders with {NET_FILE} and {INFLOW_FILE}.")
        _check_target(target, source)
        try:
            with replacing_folder(target) as staging:
                specs, unusable = _stage(archive, places, staging, progress)
                if not specs:
                    first = next(iter(unusable.items()))
                    raise IzooError(f"none of the {len(places)} folders of {source} is usable; {first[0]}: {first[1]}")
                _write_index(staging, specs, unusable, source.name)
        except OSError as error:
            raise IzooError(f"cannot write to {target}: {os_reason(error)}; choose another target.") from error
    return ImportReport(target, tuple(specs), unusable)


def _find_places(archive: Archive) -> list[PurePosixPath]:
    """Folders of the archive that are intersections, or stand beside intersections, in natural order."""
    holders = {name.parent for name in archive.files if name.name in (NET_FILE, INFLOW_FILE)}
    around = {holder.parent for holder in holders if holder != PurePosixPath(".")}
    beside = {folder for folder in archive.folders if folder.parent in around and folder not in around}
    found = {place for place in holders | beside if not any(part.startswith((".", "__")) for part in place.parts)}
    return sorted(found, key=lambda place: [natural_key(part) for part in place.parts])


def _names(archive: Archive, place: PurePosixPath) -> tuple[str, str]:
    """Names of the dataset and of the intersection at ``place``."""
    dataset, intersection = ("imported", *archive.label, *place.parts)[-2:]
    for name in (dataset, intersection):
        if not _SAFE_NAME.fullmatch(name) or name in (MANIFEST, INDEX):
            raise IzooError(f"the folder name {name!r} cannot be used; rename it to letters, digits, - and _.")
    return dataset, intersection


def _stage(
    archive: Archive, places: list[PurePosixPath], staging: Path, progress: Progress | None
) -> tuple[list[IntersectionSpec], dict[str, str]]:
    specs: list[IntersectionSpec] = []
    unusable: dict[str, str] = {}
    for number, place in enumerate(places, start=1):
        try:
            specs.append(_stage_one(archive, place, staging))
        except IzooError as error:
            unusable["/".join(("imported", *archive.label, *place.parts)[-2:])] = str(error)
        if progress is not None:
            progress(number, len(places))
    return specs, unusable


def _stage_one(archive: Archive, place: PurePosixPath, staging: Path) -> IntersectionSpec:
    dataset, intersection = _names(archive, place)
    folder = staging / dataset / intersection
    if folder.exists():
        raise IzooError(f"another folder is called {dataset}/{intersection} too; rename one of them.")
    for name in (NET_FILE, INFLOW_FILE):
        if place / name not in archive.files:
            raise IzooError(f"it has no {name}; fetch the folder again.")
    data = {name: archive.read(place / name) for name in (NET_FILE, INFLOW_FILE)}
    folder.mkdir(parents=True)
    try:
        for name, content in data.items():
            (folder / name).write_bytes(content)
        return load_intersection(folder)
    except IzooError as error:
        shutil.rmtree(folder)
        raise IzooError(str(error).replace(f"{folder.absolute()}{os.sep}", "")) from error


def _with_demand(spec: IntersectionSpec) -> str:
    """Letters of the approaches with demand."""
    return "".join(leg.name for leg in spec.legs if leg.approach is not None and leg.approach.aadt_per_lane > 0.0)


def _check_target(target: Path, source: Path) -> None:
    inside, outside = target.resolve(), source.resolve()
    if inside == outside or (source.is_dir() and (inside in outside.parents or outside in inside.parents)):
        raise IzooError(f"the target {target} and the source {source} lie within each other; choose another target.")
    check_replaceable(target, lambda: _imported(target))


def _imported(target: Path) -> list[str]:
    """What an earlier import has written into ``target``; nothing if its manifest is another's, or damaged."""
    try:
        found = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
        return [MANIFEST, INDEX, *found["datasets"]] if found["format"] == FORMAT else []
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []


def _write_index(folder: Path, specs: list[IntersectionSpec], unusable: dict[str, str], source_name: str) -> None:
    rows = []
    for spec in specs:
        place = Path(str(spec.net_path)).parent
        rows.append(
            {
                "dataset": place.parent.name,
                "intersection": place.name,
                "city": spec.city or "",
                "legs": "".join(spec.leg_names),
                "approaches": "".join(spec.approach_names),
                "with_demand": _with_demand(spec),
                "net_sha256": spec.net_sha256,
                "inflows_sha256": hashlib.sha256((place / INFLOW_FILE).read_bytes()).hexdigest(),
                "imputed": "; ".join(spec.imputed),
            }
        )
    with (folder / INDEX).open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    manifest = {
        "format": FORMAT,
        "source": source_name,
        "datasets": sorted({str(row["dataset"]) for row in rows}),
        "intersections": len(rows),
        "approaches": sum(len(spec.approach_names) for spec in specs),
        "unusable": unusable,
    }
    write_json(folder / MANIFEST, manifest)


MAX_FILE_BYTES = 16 * 1024**2
"""A net of the published dataset has about 0.1 MB; a larger file is not read."""


@dataclass(frozen=True)
class Archive:
    """A folder or a zip file.

    Attributes:
        label: what stands above its files.
        files: how to read each, by relative POSIX path, in no particular order.
        folders: every one.
    """

    label: tuple[str, ...]
    files: Mapping[PurePosixPath, Callable[[], bytes]]
    folders: Collection[PurePosixPath]

    def read(self, name: PurePosixPath) -> bytes:
        """Content of a file; :class:`IzooError` if it cannot be read or is too large."""
        try:
            content = self.files[name]()
        except Exception as error:  # the errors of zipfile and its four decompressors have no common base
            raise IzooError(f"cannot read {name} ({error}); fetch it again.") from error
        if len(content) > MAX_FILE_BYTES:
            raise IzooError(
                f"{name} is larger than {MAX_FILE_BYTES // 1024**2} MiB; no net or inflow file is; fetch it again."
            )
        return content


@contextmanager
def open_archive(source: Path) -> Iterator[Archive]:
    """Open a folder or a zip file.

    Raises:
        IzooError: ``source`` does not exist, or is neither.
    """
    if source.is_dir():
        yield _folder(source)
    elif not source.exists():
        raise IzooError(f"{source} does not exist; give the path of the dataset's folder or zip archive.")
    elif not source.is_file():  # a device may have no end
        raise IzooError(f"{source} is neither a folder nor a file; give the dataset's folder or zip archive.")
    else:
        try:
            file = zipfile.ZipFile(source)
        except Exception as error:  # zipfile's errors about damaged directories have no common base, either
            raise IzooError(f"{source} is neither a folder nor a readable zip archive ({error}).") from error
        with file:
            # Some programs on Windows write backslashes.
            members = {PurePosixPath(info.filename.replace("\\", "/")): info for info in file.infolist()}
            files = {name: functools.partial(_unpacked, file, info) for name, info in members.items()}
            folders = {parent for name in members for parent in name.parents}
            empty = [name for name, info in members.items() if info.is_dir()]
            for name in empty:
                del files[name]
            yield Archive((source.stem,), files, folders.union(empty))


def _folder(source: Path) -> Archive:
    label = source.resolve().parts[-2:] if source.name in ("", "..") else source.absolute().parts[-2:]
    files: dict[PurePosixPath, Callable[[], bytes]] = {}
    folders = []
    for folder, _, names in os.walk(source):
        folders.append(PurePosixPath(Path(folder).relative_to(source).as_posix()))
        files |= {folders[-1] / name: functools.partial(read_bytes, Path(folder, name)) for name in names}
    return Archive(label, files, folders)


def _unpacked(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    with file.open(info) as stream:
        return stream.read(MAX_FILE_BYTES + 1)
