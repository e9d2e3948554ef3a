"""Nets on disk, by content hash: whole or absent, also when several processes read and write at once."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from izoo.errors import IzooError
from izoo.files import CACHE_ENV, cache_root, is_partial, os_reason, write_bytes

MAX_ENTRIES = 20_000
"""Procedural training never ends, so the oldest nets (of about 50 kB) go when there are more than this."""
SPARE_S = 3600.0
"""Nets younger than this stay, whatever their number: someone may be about to load them."""
_SEAL = "<!-- sha256 "
_TIDY_EVERY = 500
_WORK = ".work-"
_stored = 0


def cache_folder(cache_dir: Path | None = None) -> Path:
    """Return the folder of the nets, made if absent.

    Args:
        cache_dir: where to cache; ``None`` means the environment variable ``IZOO_CACHE_DIR`` or else the user's cache
            folder.

    Raises:
        IzooError: the folder cannot be made.
    """
    folder = Path(cache_dir or cache_root()) / "nets"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    return folder


def lookup(folder: Path, key: str) -> Path | None:
    """Return the entry ``key``, or ``None`` where it is absent, truncated or altered."""
    path = _entry(folder, key)
    try:
        data = path.read_bytes()
    except OSError:
        return None
    body, seal, rest = data.rpartition(_SEAL.encode())
    return path if seal and rest == _digest(body) else None


def store(folder: Path, key: str, text: str) -> Path:
    """Write an entry in one go, replacing what is there, and return its path.

    Raises:
        IzooError: the folder cannot be written to.
    """
    global _stored
    body = text.encode()
    try:
        # A loss of power may leave a file that the seal gives away.
        write_bytes(_entry(folder, key), body + _SEAL.encode() + _digest(body), durable=False)
    except OSError as error:
        raise _unwritable(folder, error) from error
    _stored += 1
    if _stored % _TIDY_EVERY == 0:
        tidy(folder)
    return _entry(folder, key)


def tidy(folder: Path, max_entries: int = MAX_ENTRIES, spare_s: float = SPARE_S) -> None:
    """Remove the oldest entries beyond ``max_entries``, and what killed builds left, if older than ``spare_s``."""
    entries: list[tuple[float, Path]] = []
    leftovers: list[tuple[float, Path]] = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):
            kept = leftovers if path.name.startswith(_WORK) or is_partial(path) else entries
            kept.append((path.stat().st_mtime, path))
    surplus = sorted(entries)[: max(len(entries) - max_entries, 0)]
    for written_s, path in surplus + leftovers:
        if time.time() - written_s < spare_s:
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def workspace(folder: Path) -> Iterator[Path]:
    """Give a folder for intermediate files, inside the cache, and remove it afterwards."""
    try:
        scratch = tempfile.TemporaryDirectory(prefix=_WORK, dir=folder, ignore_cleanup_errors=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    with scratch as name:
        yield Path(name)


def _entry(folder: Path, key: str) -> Path:
    return folder / f"{key}.net.xml"


def _digest(body: bytes) -> bytes:
    return f"{hashlib.sha256(body).hexdigest()} -->\n".encode()


def _unwritable(folder: Path, error: OSError) -> IzooError:
    return IzooError(
        f"cannot write to the cache folder {folder} ({os_reason(error)}); set {CACHE_ENV} to a folder that can "
        "be written to."
    )
