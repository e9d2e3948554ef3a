"""The process of a validation.

It is of low priority, without workers of its own, and gone as soon as the run is: what imports slowly comes after the
watch over that.
"""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

NICENESS = 10


def end_with_parent(parent: int) -> None:
    """End this process as soon as the run is gone, which holds the other end of the socket ``parent``."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            os.read(parent, 1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main(parent: int, checkpoint_file: str, result_file: str) -> None:
    """Validate a checkpoint and write the row as JSON, whole or not at all."""
    end_with_parent(parent)
    os.nice(NICENESS)
    os.environ["OMP_NUM_THREADS"] = "1"
    from izoo.files import write_json
    from izoo.training.validation import validate

    write_json(Path(result_file), validate(Path(checkpoint_file)), durable=False)
