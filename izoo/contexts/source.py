"""Sets and distributions of contexts (CMDPs), and the order in which episodes visit them.

Episodes are numbered. Which context and seed episode ``e`` gets depends on the base seed and ``e`` alone, so any
number of workers (worker ``k`` of ``N`` takes episodes ``k``, ``k + N``, ...) visits the same episodes.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from izoo.contexts.context import Context
from izoo.errors import IzooError

T = TypeVar("T")


@runtime_checkable
class ContextSource(Protocol):
    """A CMDP: something that contexts can be drawn from."""

    def sample(self, generator: np.random.Generator) -> Context:
        """Draw one context."""
        ...


class ContextList(Sequence[Context]):
    """A finite CMDP with a stable order.

    Args:
        contexts: the contexts; at least one.
    """

    def __init__(self, contexts: Sequence[Context]) -> None:
        if len(contexts) == 0:
            raise IzooError("a set of contexts cannot be empty; check the filter or the path that selected them.")
        self._contexts = contexts

    def __len__(self) -> int:
        return len(self._contexts)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return self._contexts[index]

    def sample(self, generator: np.random.Generator) -> Context:
        """Draw one context, uniformly."""
        return self[int(generator.integers(len(self)))]


class Lazy(Sequence[T]):
    """A sequence whose entries are made when they are asked for.

    Args:
        count: how many there are.
        make: returns the entry number ``0 <= index < count``; it must be picklable.
    """

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        if isinstance(index, slice):
            return [self[position] for position in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"entry {index} of {len(self)} does not exist.")
        return self._make(int(index) % len(self))


class MixedSource:
    """Several CMDPs at once: a draw chooses one of them, each as likely, and draws from it.

    Args:
        sources: the CMDPs.
    """

    def __init__(self, sources: Sequence[ContextSource]) -> None:
        self.sources = tuple(sources)

    def sample(self, generator: np.random.Generator) -> Context:
        """Draw one context."""
        return self.sources[int(generator.integers(len(self.sources)))].sample(generator)


class _Changed:
    """A source whose contexts have some fields changed."""

    def __init__(self, source: ContextSource, changes: Mapping[str, Any]) -> None:
        self.source, self.changes = source, changes

    def sample(self, generator: np.random.Generator) -> Context:
        """Draw one context."""
        return self.source.sample(generator).replace(**self.changes)


def _changed(contexts: Sequence[Context], changes: Mapping[str, Any], index: int) -> Context:
    return contexts[index].replace(**changes)


def with_changes(source: ContextSource, changes: Mapping[str, Any]) -> ContextSource:
    """Return the source with fields of every context changed, such as its drivers.

    A finite source stays one, in the same order, and is gone through as lazily as before.
    """
    if isinstance(source, Sequence):
        return ContextList(Lazy(len(source), functools.partial(_changed, source, changes)))
    return _Changed(source, changes)


class Schedule(Protocol):
    """Says which context and seed each numbered episode has."""

    def __call__(self, episode: int) -> tuple[Context, int]:
        """Return ``(context, episode seed)`` of episode number ``episode``."""
        ...


def episode_seed(seed: int, episode: int) -> int:
    """Derive the 63-bit seed of a numbered episode from a base seed."""
    state = np.random.SeedSequence([seed, episode]).generate_state(1, np.uint64)
    return int(state[0] >> np.uint64(1))


class RandomSchedule:
    """Each episode draws its context from ``source``, independently."""

    def __init__(self, source: ContextSource, seed: int = 0) -> None:
        self.source, self.seed = source, seed

    def __call__(self, episode: int) -> tuple[Context, int]:
        seed = episode_seed(self.seed, episode)
        return self.source.sample(np.random.default_rng([seed, 1])), seed


class RoundRobinSchedule:
    """Episodes walk through a finite set in its own order, again and again; each visit has a new seed."""

    def __init__(self, contexts: Sequence[Context], seed: int = 0) -> None:
        self.contexts, self.seed = contexts, seed

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.contexts[episode % len(self.contexts)], episode_seed(self.seed, episode)


class CurriculumSchedule:
    """The caller chooses: ``choose(episode, generator)`` returns the context of each episode.

    The callback runs in the worker processes, so it must be picklable and must decide from its arguments alone for
    a run to be reproducible.
    """

    def __init__(self, choose: Callable[[int, np.random.Generator], Context], seed: int = 0) -> None:
        self.choose, self.seed = choose, seed

    def __call__(self, episode: int) -> tuple[Context, int]:
        seed = episode_seed(self.seed, episode)
        return self.choose(episode, np.random.default_rng([seed, 1])), seed


def as_schedule(contexts: Context | Sequence[Context] | ContextSource | Schedule, seed: int) -> Schedule:
    """Return the schedule that ``contexts`` stands for.

    A schedule stays itself; one context is played again and again; from a source or a sequence, each episode draws
    anew. ``seed`` is the base seed of the episodes.
    """
    if isinstance(contexts, Context):
        return RoundRobinSchedule([contexts], seed)
    if isinstance(contexts, ContextSource):
        return RandomSchedule(contexts, seed)
    # Sequences may be long and make their entries when asked, so the first stands for all.
    if isinstance(contexts, Sequence) and (not contexts or isinstance(contexts[0], Context)):
        return RandomSchedule(ContextList(contexts), seed)
    if callable(contexts):
        return contexts
    raise IzooError(
        f"contexts is a {type(contexts).__name__}"
        + (
            f" of {type(contexts[0]).__name__}"
            if isinstance(contexts, Sequence) and not isinstance(contexts, str)
            else ""
        )
        + "; give a Context, a sequence of them, a source with sample(generator), or a schedule that maps an episode "
        "number to (context, seed)."
    )


def reseed(schedule: Schedule, seed: int) -> Schedule:
    """Return the schedule with another base seed; a fixed schedule, which has none, stays as it is."""
    if not hasattr(schedule, "seed"):
        return schedule
    schedule = copy.copy(schedule)
    schedule.seed = seed  # type: ignore[attr-defined]
    return schedule
