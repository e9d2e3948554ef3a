"""The process of a validation.

It is of low priority, without workers of its own, and gone as soon as the run is: what imports slowly comes after the
watch over that.
"""

from __future__ import annotations

import os
from pathlib import Path

from izoo.processes import end_with_parent

NICENESS = 10


def main(parent: int, checkpoint_file: str, result_file: str) -> None:
    """Validate a checkpoint and write the row as JSON, whole or not at all."""
    end_with_parent(parent)
    os.nice(NICENESS)
    os.environ["OMP_NUM_THREADS"] = "1"
    from izoo.files import write_json
    from izoo.training.validation_rollout import validate

    write_json(Path(result_file), validate(Path(checkpoint_file)), durable=False)
