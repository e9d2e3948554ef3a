"""``python -m izoo.training.validating CHECKPOINT RESULT``: the process of a validation.

It is of low priority, without workers of its own, and gone as soon as the run is: what imports slowly comes after the
watch over that.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

NICENESS = 10


def end_with_parent() -> None:
    """End this process as soon as its standard input closes, which the run holds open."""

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the end
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main(checkpoint_file: str, result_file: str) -> None:
    """Validate a checkpoint and write the row as JSON, whole or not at all."""
    from izoo.files import write_json
    from izoo.training.validation import validate

    write_json(Path(result_file), validate(Path(checkpoint_file)), durable=False)


if __name__ == "__main__":
    end_with_parent()
    os.nice(NICENESS)
    main(*sys.argv[1:])
