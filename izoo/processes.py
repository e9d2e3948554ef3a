"""Processes of fresh interpreters, for work beside this one."""

from __future__ import annotations

import subprocess
import sys
from typing import BinaryIO


def start_process(call: str, *descriptors: int, output: BinaryIO | None = None) -> subprocess.Popen[bytes]:
    """Start ``from MODULE import FUNCTION; FUNCTION(...)`` in a fresh interpreter that imports what this one can.

    Unlike ``multiprocessing``'s, the process does not run the user's script again, so that scripts need no
    ``if __name__ == "__main__"``. It heeds no more of the environment and the user's site than this one does. A session
    of its own keeps the terminal's Ctrl-C away: the parent decides when it ends.

    Args:
        call: the statements.
        descriptors: open files that the process inherits under the same numbers.
        output: file that takes what the process prints; ``None``: where this one's goes.
    """
    program = f"import sys; sys.path[:] = {sys.path!r}; {call}"
    heeds = {"-I": sys.flags.isolated, "-E": sys.flags.ignore_environment, "-s": sys.flags.no_user_site}
    return subprocess.Popen(
        [sys.executable, *(flag for flag, is_set in heeds.items() if is_set), "-c", program],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        pass_fds=descriptors,
        start_new_session=True,
    )
