"""Keeps what SUMO prints about vehicles that it drops off the terminal.

libsumo writes its errors to file descriptor 2, past Python and whatever its options for logs say. While it simulates,
that descriptor leads to a scratch file instead; whatever else has been written meanwhile is passed on.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
from collections.abc import Callable

_DROPPED = re.compile(rb"^Error: Vehicle '[^'\n]*' will not be able to depart .*\n?", re.MULTILINE)


class Overheard:
    """Calls functions that may print.

    Attributes:
        dropped: how many vehicles SUMO has said that it drops.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._scratch = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (it lives as long as this object)

    def call(self, function: Callable[[], object]) -> None:
        """Call a function; what it prints about dropped vehicles is counted, and all else passed on."""
        try:
            terminal = os.dup(2)  # anew each time: descriptor 2 may lead elsewhere by now
        except OSError:  # there is no standard error
            function()
            return
        scratch = self._scratch.fileno()
        try:
            os.dup2(scratch, 2)
            function()
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            if size := os.lseek(scratch, 0, os.SEEK_CUR):
                self._sort(size)

    def _sort(self, size: int) -> None:
        """Count the lines about dropped vehicles, and pass the others on."""
        self._scratch.seek(0)
        text, count = _DROPPED.subn(b"", self._scratch.read(size))
        self._scratch.seek(0)
        self.dropped += count
        if text:
            with contextlib.suppress(OSError):
                os.write(2, text)
