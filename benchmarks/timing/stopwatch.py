"""What the speed benchmarks share: steps before those that are timed, and clocks around parts of a step."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

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


def clocked(call: Callable[..., Any], seconds: dict[str, float], part: str) -> Callable[..., Any]:
    """Return a function that does the same, and adds the time that it takes to ``seconds[part]``."""

    def run(*args: Any) -> Any:
        begin = time.perf_counter()
        result = call(*args)
        seconds[part] += time.perf_counter() - begin
        return result

    return run
