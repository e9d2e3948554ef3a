"""Memory for what a step emits, written by the threads that have the frames in their caches."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from izoo.compiling import compiled
from izoo.envs.mdp.columns import VEHICLE_FLAGS

Tensors = dict[str, Tensor]
"""Arrays of frames by name, ``[*B, ...]``; those of bytes are flags."""
Memories = tuple[np.ndarray, ...]
"""Bytes of each array that is emitted, uint8, one behind the other for all environments."""
KEPT = 4
"""How many steps' memory is searched for some that is free again; a caller that keeps every step leaves none."""
ROW_KINDS = {"mask": 0, "vehicle_flags": VEHICLE_FLAGS.index("present")}
"""Arrays that say which rows of others hold something, and the column where they do so."""
IN_ROWS = {"observation": 0, "vehicle_floats": 1, "vehicle_ints": 1, "vehicle_flags": 1}
"""Arrays that are 0 in rows which hold nothing, and whether that is said by the first or the second of these."""


class Layout:
    """Where the arrays that are emitted lie in the frames, and what they look like.

    Args:
        frames: arrays ``[N, ...]`` that share a buffer (:func:`izoo.envs.mdp.frame.map_frames`).
        batch: batch size of the environment, ``[N]`` or, with one, ``[]``.
        names: of those that are emitted.

    Attributes:
        names: of those that are emitted, each once.
        sizes: bytes of each for all environments.
    """

    def __init__(self, frames: Mapping[str, np.ndarray], batch: torch.Size, names: Sequence[str]) -> None:
        self._source = np.frombuffer(frames["mask"].base, np.uint8)  # type: ignore[arg-type]
        self.num_envs, self.names = len(frames["mask"]), tuple(dict.fromkeys(names))
        arrays = [frames[name] for name in self.names]
        self._shapes = [(array.dtype, (*batch, *array.shape[1:])) for array in arrays]
        self.sizes = [array.nbytes for array in arrays]
        # Of each array: first byte in the frames, bytes per environment, bytes per row (0: all is always written), and
        # which kind of rows.
        self._parts = np.array(
            [
                (*self._place(array), self._place(array)[1] // array.shape[1] * (name in IN_ROWS), IN_ROWS.get(name, 0))
                for name, array in zip(self.names, arrays, strict=True)
            ],
            np.int64,
        )
        # Of each kind: first byte of its flags, bytes per environment, bytes per row, and how many rows.
        flags = [(frames[name], column) for name, column in ROW_KINDS.items()]
        self._kinds = np.array(
            [
                (at + column, size, size // array.shape[1], array.shape[1])
                for array, column in flags
                for at, size in (self._place(array),)
            ],
            np.int64,
        )

    def _place(self, array: np.ndarray) -> tuple[int, int]:
        return array.ctypes.data - self._source.ctypes.data, array.nbytes // self.num_envs

    def array(self, number: int, memory: np.ndarray) -> np.ndarray:
        """Return an array from its bytes: ``[*B, ...]`` of ``[size]``, ``[T, *B, ...]`` of ``[T, size]``."""
        dtype, shape = self._shapes[number]
        array = memory.view(dtype).reshape(*memory.shape[:-1], *shape)
        return array.view(bool) if dtype == np.uint8 else array

    def copy(self, memories: Memories, held: np.ndarray, rows: slice) -> None:
        """Copy rows that hold something, and clear those which did when this memory was written last.

        Args:
            memories: whose other rows are 0.
            held: ``[N, 2]`` int64 rows of agents and vehicles that they hold of each environment; is updated.
            rows: the environments.
        """
        copy_held(self._source, memories, self._parts, self._kinds, held, rows.start, rows.stop)

    def all_held(self) -> np.ndarray:
        """Return what to say of memory that may hold anything: ``[N, 2]``."""
        return np.tile(self._kinds[:, 3], (self.num_envs, 1))


class Copies:
    """What steps emit, in memory that is written again once nobody holds the tensor that it was handed out as.

    Memory from the system would have to be cleared for every step, page by page.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._pools: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in layout.names]
        self._memories: Memories = ()
        self._held = layout.all_held()
        self._arrays: list[np.ndarray] = []

    def begin(self, stepping: bool) -> None:
        """Begin a step, or another look at the frames."""
        self._arrays = []
        places = [_unheld(pool) for pool in self._pools]
        for number, place in enumerate(places):
            if place is None:
                memory = np.empty(self.layout.sizes[number], np.uint8)
                self._pools[number] = [(memory, self.layout.array(number, memory)), *self._pools[number]][:KEPT]
        chosen = [pool[place or 0] for pool, place in zip(self._pools, places, strict=True)]
        self._memories = tuple(memory for memory, _ in chosen)
        self._held = self.layout.all_held()  # those who had it may have written into it
        self._arrays = [array for _, array in chosen]

    def take(self, rows: slice) -> None:
        """Copy the frames of some environments; threads do so side by side, each for its own."""
        self.layout.copy(self._memories, self._held, rows)

    def tensors(self) -> tuple[Tensors, Tensors]:
        """Return what the step led to, and what to act on next: the same tensors."""
        found = _as_tensors(self.layout.names, self._arrays)
        return found, found


def _unheld(pool: Sequence[tuple[np.ndarray, np.ndarray]]) -> int | None:
    """Return the place of the first array of a pool that only the pool holds, if there is one."""
    for place, (_, array) in enumerate(pool):
        if sys.getrefcount(array) == _HELD_BY_POOL:
            return place
    return None


def _references(pool: Sequence[tuple[np.ndarray, np.ndarray]]) -> int:
    return next(sys.getrefcount(array) for _, array in pool)


_HELD_BY_POOL = _references([(np.empty(0), np.empty(0))])
"""References to an array that nobody else holds, as counted in a loop over its pool."""


class BatchBuffer:
    """A batch ``[N, T]`` of steps that is written in place: nothing is stacked when it is complete.

    What a step leads to and what is acted on next differ where episodes begin, so both are kept. The next batch is
    written over this one from its first step on.

    Args:
        layout: of what is kept.
        steps: ``T``.
    """

    def __init__(self, layout: Layout, steps: int) -> None:
        self.layout, self.steps = layout, steps
        # One more than steps: what the next batch begins with.
        self._acted_on = [np.zeros((steps + 1, size), np.uint8) for size in layout.sizes]
        self._led_to = [np.zeros((steps, size), np.uint8) for size in layout.sizes]
        self._acted_on_held = np.zeros((steps + 1, layout.num_envs, len(ROW_KINDS)), np.int64)
        self._led_to_held = np.zeros((steps, layout.num_envs, len(ROW_KINDS)), np.int64)
        self._at, self._stepping = 0, False
        self._written: list[tuple[Memories, np.ndarray]] = []

    def begin(self, stepping: bool) -> None:
        """Begin a step, the first one of the next batch behind the last of this one; or another look at the frames."""
        self._stepping = stepping
        if stepping and self._at == self.steps:
            self._at, self._written = 0, [_entry(self._acted_on, self._acted_on_held, 0)]
            self.take(slice(0, self.layout.num_envs))
        self._at += stepping
        self._written = [_entry(self._acted_on, self._acted_on_held, self._at)]
        if stepping:
            self._written.append(_entry(self._led_to, self._led_to_held, self._at - 1))

    def take(self, rows: slice) -> None:
        """Write the frames of some environments to where they belong in the batch."""
        for memories, held in self._written:
            self.layout.copy(memories, held, rows)

    def tensors(self) -> tuple[Tensors, Tensors]:
        """Return what the step led to, and what to act on next; valid until the batch after this one."""
        state = self._tensors([memory[self._at] for memory in self._acted_on])
        return self._tensors([memory[self._at - 1] for memory in self._led_to]) if self._stepping else state, state

    def batch(self) -> tuple[Tensors, Tensors]:
        """Return ``[T, N, ...]`` what the steps led to and what they acted on, without a copy.

        Raises:
            RuntimeError: the batch is not complete.
        """
        if self._at != self.steps:
            raise RuntimeError(f"{self._at} of {self.steps} steps have been taken")
        return self._tensors(self._led_to), self._tensors([memory[:-1] for memory in self._acted_on])

    def _tensors(self, memories: Sequence[np.ndarray]) -> Tensors:
        return _as_tensors(self.layout.names, (self.layout.array(k, memory) for k, memory in enumerate(memories)))


def _entry(memories: Sequence[np.ndarray], held: np.ndarray, at: int) -> tuple[Memories, np.ndarray]:
    return tuple(memory[at] for memory in memories), held[at]


def _as_tensors(names: Iterable[str], arrays: Iterable[np.ndarray]) -> Tensors:
    return dict(zip(names, map(torch.from_numpy, arrays), strict=True))


@compiled(nogil=True)
def copy_held(source, memories, parts, kinds, held, first, last):  # type: ignore[no-untyped-def]
    """Copy rows that hold something, and clear those which held something; see :meth:`Layout.copy`."""
    before, now = np.empty(kinds.shape[0], np.int64), np.empty(kinds.shape[0], np.int64)
    for n in range(first, last):
        for kind in range(kinds.shape[0]):
            flags, count = kinds[kind, 0] + n * kinds[kind, 1], kinds[kind, 3]
            while count > 0 and source[flags + (count - 1) * kinds[kind, 2]] == 0:
                count -= 1
            before[kind], now[kind] = held[n, kind], count
            held[n, kind] = count
        for k in range(len(memories)):
            at, size, row, kind = parts[k, 0] + n * parts[k, 1], parts[k, 1], parts[k, 2], parts[k, 3]
            written = row * now[kind] if row > 0 else size
            _copy(source, at, memories[k], n * size, written)
            if row > 0:
                memories[k][n * size + written : n * size + row * max(before[kind], now[kind])] = 0


@compiled(borrows=True)
def _copy(source, at, target, to, size):  # type: ignore[no-untyped-def]
    # Indices without a sign, which cannot count from the end, let the compiler move many bytes at once.
    at, to = np.uint64(at), np.uint64(to)
    for i in range(np.uint64(size)):
        target[to + i] = source[at + i]
