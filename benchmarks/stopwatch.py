"""What the speed benchmarks share: steps that are not timed before those that are."""

from __future__ import annotations

import time
from collections.abc import Callable

CHUNK = 200
"""Steps per environment in a collected batch."""


def seconds_per_step(
    step: Callable[[], None], count: int, settle: int, before: Callable[[], object] = lambda: None
) -> float:
    """Return the mean time of ``count`` calls of ``step``, which follow ``settle`` others and one of ``before``."""
    for _ in range(settle):
        step()
    before()
    begin = time.perf_counter()
    for _ in range(count):
        step()
    return (time.perf_counter() - begin) / count
