"""Observations of a batch that is being collected, each written once, to its place in the batch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from izoo.compiling import compiled


class Tape:
    """Observations of a batch ``[N, T]``: neither copied whole in every step nor copied again to make the batch.

    Only slots that hold an agent, or did when their place was written last, are written. The next batch is written over
    this one from its first step on.

    Args:
        steps: ``T``.
        observation: ``[N, A, F]`` float32 of the frames.
        mask: ``[N, A]`` uint8 of the frames; slots without an agent observe 0.
    """

    def __init__(self, steps: int, observation: np.ndarray, mask: np.ndarray) -> None:
        self.steps = steps
        self._observation, self._mask = observation, mask
        # One more than steps: what the next batch begins with.
        self._acted_on = np.zeros((steps + 1, *observation.shape), observation.dtype)
        self._led_to = np.zeros((steps, *observation.shape), observation.dtype)
        self._acted_on_held = np.zeros((steps + 1, len(mask)), np.int64)
        self._led_to_held = np.zeros((steps, len(mask)), np.int64)
        self._at = 0
        self._taken: list[slice] = []

    def begin(self) -> None:
        """Begin a step; behind the last one of a batch, begin the next."""
        self._taken = []
        if self._at == self.steps:
            self._at = 0
            write(self._acted_on[-1], self._mask, self._acted_on[0], self._acted_on_held[0])

    def take(self, rows: slice) -> None:
        """Write the observations of some environments: what a step led to, and what is acted on next."""
        at, taken = self._at, self._taken
        observation, mask = self._observation[rows], self._mask[rows]
        write(observation, mask, self._led_to[at, rows], self._led_to_held[at, rows])
        write(observation, mask, self._acted_on[at + 1, rows], self._acted_on_held[at + 1, rows])
        taken.append(rows)

    def read(self, stepped: bool) -> tuple[Tensor, Tensor]:
        """Return ``[N, A, F]`` what the step led to, and what to act on next, which differ where episodes have begun.

        Args:
            stepped: a step has just ended, and no frame changed since: what was taken is not taken again.
        """
        if stepped:
            if sum(rows.stop - rows.start for rows in self._taken) < len(self._mask):
                self.take(slice(0, len(self._mask)))
            self._at += 1
        else:
            write(self._observation, self._mask, self._acted_on[self._at], self._acted_on_held[self._at])
        acted_on = torch.from_numpy(self._acted_on[self._at])
        return torch.from_numpy(self._led_to[self._at - 1]) if stepped else acted_on, acted_on

    def batch(self) -> tuple[Tensor, Tensor]:
        """Return ``[N, T, A, F]`` what the steps acted on and what they led to, without a copy.

        Raises:
            RuntimeError: the batch is not complete.
        """
        if self._at != self.steps:
            raise RuntimeError(f"{self._at} of {self.steps} steps have been taken")
        acted_on, led_to = torch.from_numpy(self._acted_on[:-1]), torch.from_numpy(self._led_to)
        return acted_on.transpose(0, 1), led_to.transpose(0, 1)


@compiled(nogil=True)
def write(source, mask, place, held):  # type: ignore[no-untyped-def]
    """Write observations to a place, but for slots that hold nothing now, and hold nothing there.

    Args:
        source: ``[n, A, F]`` what is written, 0 in slots without an agent.
        mask: ``[n, A]`` uint8 of the slots that hold one.
        place: ``[n, A, F]``, 0 from slot number ``held`` ``[n]`` on; both are written.
    """
    for n in range(source.shape[0]):
        count = mask.shape[1]
        while count > 0 and mask[n, count - 1] == 0:
            count -= 1
        most = max(count, held[n])
        place[n, :most] = source[n, :most]
        held[n] = count
