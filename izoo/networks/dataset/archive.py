"""Read-only views of a dataset that was downloaded as a folder or as a zip archive; hostile archives are refused."""

from __future__ import annotations

import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from izoo.errors import IzooError

MAX_FILE_BYTES = 16 * 1024**2
"""A net of the published dataset has about 0.1 MB; a larger file is not read."""
BOMB_BYTES, BOMB_RATIO = 64 * 1024**2, 100
"""An archive with a member that unpacks to more than both (the second: times its packed size) is refused."""
MAX_MEMBERS = 1_000_000
_CHUNK = 1024**2


@contextmanager
def open_archive(source: Path) -> Iterator[FolderArchive | ZipArchive]:
    """Open a folder or a zip file.

    Raises:
        IzooError: ``source`` does not exist, is neither, or is a zip archive with an unsafe member.
    """
    if source.is_dir():
        yield FolderArchive(source)
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
            yield ZipArchive(source, file)


class FolderArchive:
    """A folder on disk; symbolic links inside it are listed and refused when read.

    Attributes:
        label: what stands above its files.
        files, folders: every one, by relative POSIX path, in no particular order.
    """

    def __init__(self, source: Path) -> None:
        self.source = source
        self.label = source.resolve().parts[-2:] if source.name in ("", "..") else source.absolute().parts[-2:]
        self.files: list[PurePosixPath] = []
        self.folders: list[PurePosixPath] = []
        for folder, _, names in os.walk(source):
            relative = PurePosixPath(Path(folder).relative_to(source).as_posix())
            self.folders.append(relative)
            self.files.extend(relative / name for name in names)

    def read(self, name: PurePosixPath) -> bytes:
        """Content of a file; :class:`IzooError` if it cannot be read or is too large."""
        path = self.source / name
        try:
            state = path.lstat()
            if not stat.S_ISREG(state.st_mode):
                raise IzooError(f"{name} is a symbolic link or a special file; put the file itself there.")
            _check_size(name, state.st_size)
            return path.read_bytes()
        except OSError as error:
            raise IzooError(f"cannot read {name}: {error.strerror}.") from error


class ZipArchive:
    """A zip file, like a :class:`FolderArchive`; nothing of it is ever extracted by member name."""

    def __init__(self, source: Path, file: zipfile.ZipFile) -> None:
        self.file = file
        self.label: tuple[str, ...] = (source.stem,)
        self._members: dict[PurePosixPath, zipfile.ZipInfo] = {}
        folders: set[PurePosixPath] = set()
        members = file.infolist()
        if len(members) > MAX_MEMBERS:
            raise IzooError(f"{source} has {len(members)} members, over the limit of {MAX_MEMBERS}; it is refused.")
        for info in members:
            name = _safe_name(source, info)
            folders.update(name.parents)
            if info.is_dir():
                folders.add(name)
                continue
            if name in self._members:
                raise IzooError(f"{source} has two members called {name}; it is refused. Fetch the archive again.")
            if info.file_size > max(BOMB_BYTES, BOMB_RATIO * info.compress_size):
                raise IzooError(
                    f"{source} is refused: its member {name} would unpack from {info.compress_size} to "
                    f"{info.file_size} bytes."
                )
            self._members[name] = info
        self.files, self.folders = list(self._members), list(folders)

    def read(self, name: PurePosixPath) -> bytes:
        """Content of a file; :class:`IzooError` if it cannot be unpacked or is too large."""
        data = bytearray()
        _check_size(name, self._members[name].file_size)
        try:
            with self.file.open(self._members[name]) as stream:
                while chunk := stream.read(_CHUNK):
                    data += chunk
                    _check_size(name, len(data))
        except IzooError:
            raise
        except Exception as error:  # The errors of zipfile and its four decompressors have no common base.
            raise IzooError(f"cannot unpack {name} ({error}); fetch the archive again.") from error
        return bytes(data)


def _safe_name(source: Path, info: zipfile.ZipInfo) -> PurePosixPath:
    raw = info.filename.replace("\\", "/")
    name = PurePosixPath(raw)
    if raw.startswith("/") or (len(raw) > 1 and raw[1] == ":") or ".." in name.parts or "\0" in info.orig_filename:
        raise IzooError(f"{source} is refused: its member {info.filename!r} would lie outside the target folder.")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise IzooError(f"{source} is refused: its member {info.filename!r} is a symbolic link.")
    return name


def _check_size(name: PurePosixPath, size: int) -> None:
    if size > MAX_FILE_BYTES:
        raise IzooError(
            f"{name} is larger than {MAX_FILE_BYTES // 1024**2} MiB; no net or inflow file is; fetch it again."
        )
