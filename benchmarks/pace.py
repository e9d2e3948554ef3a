"""How long the rest of a benchmark will take, from what has been measured."""

from __future__ import annotations

from collections.abc import Sequence

Key = tuple[str, str]
"""Kind of work (``train``, ``evaluate``) and what does it."""


class Pace:
    """Seconds per environment step, by kind of work and who does it."""

    def __init__(self) -> None:
        self._measured: dict[Key, tuple[float, float]] = {}

    def add(self, key: Key, work: float, seconds: float) -> None:
        """Take in a finished piece of work; the latest one of a key counts."""
        if work > 0 and seconds > 0:
            self._measured[key] = (work, seconds)

    def left(self, jobs: Sequence[tuple[Key, float]]) -> float | None:
        """Return the seconds that jobs will take, or ``None`` where nothing like one of them has been measured.

        Work whose doer is unknown is taken to be as slow as the slowest of its kind.
        """
        total = 0.0
        for key, work in jobs:
            rate = self._rate(key)
            if rate is None:
                return None
            total += rate * work
        return total

    def _rate(self, key: Key) -> float | None:
        known = [self._measured[key]] if key in self._measured else []
        known = known or [value for other, value in self._measured.items() if other[0] == key[0]]
        return max((seconds / work for work, seconds in known), default=None)
