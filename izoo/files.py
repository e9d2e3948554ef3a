"""Files and folders on disk: whole or absent at any time, used by one process at a time, and free names.

A file is written under a name of its own beside its place (:func:`partial_of`) and renamed at the end.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import gzip
import io
import json
import os
import re
import secrets
import shutil
import stat
import zipfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import platformdirs

from izoo.errors import IzooError

CACHE_ENV = "IZOO_CACHE_DIR"
MOST_UNPACKED_BYTES = 1 << 28
"""Of a compressed file; results with a hundred thousand contexts hold as much."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors of a disk that is full or has become read-only."""
_ABOUT_PATHS = (
    *(errno.ENOENT, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.ELOOP),
    *(errno.EEXIST, *NO_ROOM),
)
"""Errors for which another path is a remedy."""
_PARTIAL = re.compile(r"\..+\.partial(-[0-9a-f]+)*")


def expanded(path: str | Path) -> Path:
    """Return a path with the home folder in place of ``~`` or ``~name``; if there is no such user, as it is."""
    return Path(os.path.expanduser(path))  # noqa: PTH111 (Path's own raises without such a user)


def make_absolute(config: object, *names: str) -> None:
    """Resolve paths in fields of a frozen dataclass, so that they mean the same in another folder; null stays null."""
    for name in names:
        value = getattr(config, name)
        if value == "":
            raise IzooError(f"{name} is empty; give a path, such as . for the current folder, or leave it out.")
        if value is not None:
            object.__setattr__(config, name, str(expanded(value).absolute()))


@contextlib.contextmanager
def usable_paths() -> Iterator[None]:
    """Turn what the system says about a path, such as that it may not be read, into an :class:`IzooError`.

    What it says of other things stays as it is.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno == errno.ENOENT and not _has_current_folder():
            raise IzooError("the current folder has been removed; change to one that exists.") from error
        if error.filename is None or error.errno not in _ABOUT_PATHS:
            raise
        raise IzooError(f"cannot use {error.filename}: {os_reason(error)}; choose another path.") from error


def _has_current_folder() -> bool:
    try:
        return Path.cwd().is_dir()
    except OSError:
        return False


@contextlib.contextmanager
def replacing(path: Path, durable: bool = True) -> Iterator[Path]:
    """Give a path to write a file to, which takes the place of ``path`` when the block ends without an error.

    Args:
        path: the file, in a folder that exists.
        durable: flush the file and its folder to the disk first, so that it survives a loss of power as well. Without
            that a file may then be empty, which what is only kept to save time can afford.
    """
    partial = partial_of(path)
    try:
        yield partial
        if durable:
            _flush(partial)
        partial.replace(path)
        if durable:
            _flush(path.parent)
    except OSError as error:
        if error.filename == str(partial):
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Write a file; see :func:`replacing`."""
    with replacing(path, durable) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str, durable: bool = True) -> None:
    """Write a text file in UTF-8; see :func:`replacing`."""
    write_bytes(path, text.encode(), durable)


def write_json(path: Path, content: Any, durable: bool = True) -> None:
    """Write ``content`` as JSON, indented, without NaN; see :func:`replacing`."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n", durable)


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """Return the content of a file that somebody else may have put there.

    Args:
        path: the file.
        most: how many bytes it may hold; ``None``: as many as there are.

    Raises:
        OSError: it cannot be read, is larger, or is no regular file: reading a pipe could wait forever.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        if most is not None and status.st_size > most:
            raise OSError(errno.EFBIG, f"it holds {status.st_size:,} bytes, more than {most:,}", str(path))
        return file.read()


def read_text(path: Path, most: int | None = None) -> str:
    """Return the content of a text file in UTF-8; see :func:`read_bytes`.

    Raises:
        OSError: as there.
        ValueError: it holds something else than text.
    """
    try:
        return read_bytes(path, most).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"it is no text ({error.reason} at byte {error.start:,})") from error


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while one of izoo's own files is read and used into one sentence.

    Raises:
        IzooError: it is missing, damaged, or another version of izoo wrote it.
    """
    try:
        yield
    except IzooError:
        raise
    except FileNotFoundError:
        raise IzooError(f"there is no {path}.") from None
    except Exception as error:  # what damaged content raises depends on the content
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise IzooError(
            f"cannot read {path}: {reason}. It is damaged, or another version of izoo or other options wrote it."
        ) from error


def check_parts(path: Path) -> None:
    """Raise :class:`ValueError` where a part of a file of torch's does not have its checksum, which torch would not
    notice, or is compressed, which torch never does: a few bytes can stand for more than fits into the memory.

    ``zipfile`` raises errors of its own for bytes that are no archive.
    """
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            try:
                if member.compress_type != zipfile.ZIP_STORED:
                    raise ValueError("it is compressed")
                with archive.open(member) as stream:
                    while stream.read(1 << 20):
                        pass
            except Exception as error:  # a checksum, a header, or what zlib makes of either
                raise ValueError(f"its part {member.filename} is not what was written") from error


def unpacked(packed: bytes, most: int = MOST_UNPACKED_BYTES) -> bytes:
    """Return what ``gzip`` has compressed.

    Raises:
        OSError, EOFError, zlib.error: it is damaged, or holds more than ``most`` bytes: a few can stand for gigabytes.
    """
    content = gzip.GzipFile(fileobj=io.BytesIO(packed)).read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it holds more than {most:,} bytes")
    return content


@contextlib.contextmanager
def replacing_folder(target: Path) -> Iterator[Path]:
    """Give an empty folder to fill, which takes the place of ``target`` when the block ends without an error.

    What a killed process left beside ``target`` is removed first; if it was killed just before the end, ``target`` is
    brought back.

    Raises:
        IzooError: another process fills it.
    """
    staging, old = (target.with_name(f".{target.name}.{what}") for what in ("partial", "old"))
    with claimed(staging, "wait for its end, or choose another target"):
        if old.exists() and not target.exists():
            old.replace(target)
        shutil.rmtree(old, ignore_errors=True)
        try:
            for left in staging.iterdir():
                shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
            yield staging
            if target.exists():
                target.replace(old)
            staging.replace(target)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise
        finally:
            if target.exists():
                shutil.rmtree(old, ignore_errors=True)


def check_replaceable(target: Path, known: Callable[[], Collection[str]]) -> None:
    """Refuse a target of :func:`replacing_folder` that is no folder, or holds anything that nobody knows.

    Args:
        known: returns the names of what the same command wrote there before; called if the folder holds anything.
    """
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise IzooError(f"the target {target} is not a folder; choose a new one.")
    held = {child.name for child in target.iterdir()} if target.exists() else set()
    if held and (foreign := sorted(held - set(known()))):
        raise IzooError(f"the target {target} holds other files ({', '.join(foreign[:3])}); choose a new folder.")


def partial_of(path: Path) -> Path:
    """Return where ``path`` is written until it is whole; a new name at every call."""
    return path.with_name(f".{path.name}.partial-{secrets.token_hex(4)}")


def is_partial(path: Path) -> bool:
    """Whether a path is of something half-written: of :func:`partial_of`, :func:`replacing_folder`, or an earlier
    version.
    """
    return _PARTIAL.fullmatch(path.name) is not None


@contextlib.contextmanager
def claimed(folder: Path, remedy: str = "wait for it, or choose another out") -> Iterator[None]:
    """Make ``folder`` and keep other processes out of it, until the end of this one at the latest.

    Args:
        folder: the folder.
        remedy: what to do while another process works in it.

    Raises:
        IzooError: it cannot be made, or another process works in it.
    """
    descriptor = None
    try:
        while descriptor is None:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = _locked(folder)
    except BlockingIOError:
        raise IzooError(f"another process works in {folder}; {remedy}.") from None
    except OSError as error:
        raise IzooError(f"cannot use the folder {folder}: {os_reason(error)}; choose another one.") from error
    try:
        yield
    finally:
        os.close(descriptor)


def _locked(folder: Path) -> int | None:
    """Return a descriptor of ``folder`` that keeps others out; ``None`` where it was removed meanwhile.

    Raises:
        BlockingIOError: another process works there.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:
        pass  # some network file systems cannot lock a folder
    with contextlib.suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(descriptor), folder.stat()):
            return descriptor
    os.close(descriptor)
    return None


@contextlib.contextmanager
def claimed_empty(folder: Path, option: str, instead: str = "remove its content") -> Iterator[None]:
    """Claim a folder (:func:`claimed`) that is empty (:func:`ensure_empty`); one that stays so is removed if the block
    ends with an error, unless it was there before.
    """
    existed = folder.exists()
    with claimed(folder, f"wait for it, or choose another {option}"):
        ensure_empty(folder, option, instead)
        try:
            yield
        except BaseException:
            if not existed:
                with contextlib.suppress(OSError):
                    folder.rmdir()
            raise


def free_folder(path: Path) -> Path:
    """Make the folder ``path``, or the first of ``path-2``, ``path-3``, ... that is not there, and return it."""
    wanted, number = path, 1
    while True:
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            if not os.path.lexists(path):
                raise  # something else is in the way
        number += 1
        path = wanted.with_name(f"{wanted.name}-{number}")


def ensure_empty(folder: Path, option: str, instead: str = "remove its content") -> None:
    """Make ``folder``, which ``option`` names; refuse one that holds anything, or that cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except OSError as error:
        raise IzooError(f"cannot use {option}={folder}: {os_reason(error)}; choose another folder.") from error
    if occupied:
        raise IzooError(f"{option}={folder} is not empty; choose another folder, or {instead}.")


def check_folder(folder: Path, remedy: str) -> None:
    """Raise :class:`IzooError`, which ends with what to give instead, unless ``folder`` is one."""
    if not folder.is_dir():
        raise IzooError(f"{folder} {'is a file' if folder.exists() else 'does not exist'}; {remedy}.")


def cache_root() -> Path:
    """Return the folder of what is kept to save time: ``$IZOO_CACHE_DIR``, or else the user's cache folder."""
    return Path(os.environ.get(CACHE_ENV) or platformdirs.user_cache_dir("izoo"))


def os_reason(error: OSError) -> str:
    """Return why a file or folder could not be made or written, where the system's "File exists" would mislead."""
    if error.errno == errno.ENOTDIR:
        return "a folder of its path is a file"
    if error.errno == errno.EEXIST and error.filename is not None and not Path(error.filename).is_dir():
        what = "a link that leads nowhere" if Path(error.filename).is_symlink() else "a file"
        return f"{error.filename} is {what}"
    return error.strerror or str(error)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
