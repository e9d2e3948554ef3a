"""The files of a dataset that was downloaded as a folder or as a zip archive.

Nothing is written under a name that an archive gives, and no file is unpacked beyond what a net may hold.
"""

from __future__ import annotations

import functools
import os
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from izoo.errors import IzooError
from izoo.files import read_bytes

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
