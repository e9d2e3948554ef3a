"""Removes SUMO's messages about dropped vehicles from standard error.

libsumo writes its errors to file descriptor 2, whatever its options for logs say. While it simulates, that descriptor
is redirected to a scratch file; all other text is passed on.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
from collections.abc import Callable

_DROPPED = re.compile(rb"^Error: Vehicle '[^'\n]*' will not be able to depart .*\n?", re.MULTILINE)


class StderrFilter:
    """Calls functions with standard error filtered.

    Attributes:
        dropped: number of dropped vehicles that SUMO reported.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._scratch = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (it lives as long as this object)

    def call(self, function: Callable[[], object]) -> None:
        """Call a function; count its messages about dropped vehicles, and pass all other text on."""
        try:
            terminal = os.dup(2)  # each time: descriptor 2 may have been redirected since
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
                self._pass_on(size)

    def _pass_on(self, size: int) -> None:
        """Count the lines about dropped vehicles, and print the others."""
        self._scratch.seek(0)
        text, count = _DROPPED.subn(b"", self._scratch.read(size))
        self._scratch.seek(0)
        self.dropped += count
        if text:
            with contextlib.suppress(OSError):
                os.write(2, text)
