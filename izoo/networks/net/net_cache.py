"""Nets on disk, by content hash: whole or absent, also when several processes read and write at once."""

from __future__ import annotations

import contextlib
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
_END = b"</net>\n"
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
    """Return the entry ``key``, or ``None`` where it is absent, or cut short by a loss of power."""
    path = _entry(folder, key)
    with contextlib.suppress(OSError):
        if path.read_bytes().endswith(_END):
            return path
    return None


def store(folder: Path, key: str, text: str) -> Path:
    """Write an entry in one go, replacing what is there, and return its path.

    Raises:
        IzooError: the folder cannot be written to.
    """
    global _stored
    try:
        write_bytes(_entry(folder, key), text.encode(), durable=False)
    except OSError as error:
        raise _unwritable(folder, error) from error
    _stored += 1
    if _stored % _TIDY_EVERY == 0:
        tidy(folder)
    return _entry(folder, key)


def tidy(folder: Path, max_entries: int = MAX_ENTRIES, spare_s: float = SPARE_S) -> None:
    """Remove the oldest entries beyond ``max_entries``, and what killed builds left, if older than ``spare_s``."""
    found = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):
            found.append((path.name.startswith(_WORK) or is_partial(path), path.stat().st_mtime, path))
    entries = sorted(entry for entry in found if not entry[0])
    leftovers = [entry for entry in found if entry[0]]
    for _, written_s, path in leftovers + entries[: max(len(entries) - max_entries, 0)]:
        if time.time() - written_s >= spare_s:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


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


def _unwritable(folder: Path, error: OSError) -> IzooError:
    return IzooError(
        f"cannot write to the cache folder {folder} ({os_reason(error)}); set {CACHE_ENV} to a folder that can "
        "be written to."
    )
