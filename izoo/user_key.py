"""A secret of the user, by which izoo knows again what it has written itself."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import secrets
from pathlib import Path

import platformdirs

from izoo.files import read_bytes, replacing

_KEY_BYTES = 32


@functools.cache
def own_key() -> bytes:
    """Return the secret, 32 bytes.

    They lie in the user's data folder; where that cannot be written, they are those of this process alone.
    """
    path, key = Path(platformdirs.user_data_dir("izoo")) / "key", secrets.token_bytes(_KEY_BYTES)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):  # some network file systems cannot lock a folder
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not path.exists() or path.stat().st_size != _KEY_BYTES:
                with replacing(path) as partial:
                    partial.touch(0o600)
                    partial.write_bytes(key)
            return read_bytes(path, _KEY_BYTES)
        finally:
            os.close(descriptor)
    except OSError:
        return key
