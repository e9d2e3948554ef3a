"""Which contexts and episode seeds an evaluation plays."""

from __future__ import annotations

import zlib
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import cast

import numpy as np

from izoo.console import counted
from izoo.contexts.context import Context
from izoo.contexts.source import ContextSource, episode_seed
from izoo.envs.config import EnvConfig

EVALUATION_STREAM = 7919
"""Separates episode seeds and drawn contexts of evaluations from those of training."""
DRAWN_CONTEXTS = 16


def choose_contexts(source: ContextSource, count: int | None, seed: int) -> list[Context]:
    """Return all contexts of a finite source, or ``count`` drawn ones (without repetition where it is finite).

    Those with the same content are returned once.
    """
    generator = np.random.default_rng([seed, EVALUATION_STREAM])
    if not hasattr(source, "__len__"):
        drawn = [source.sample(generator) for _ in range(count or DRAWN_CONTEXTS)]
    else:
        listed = cast(Sequence[Context], source)
        size = len(listed)
        chosen = (
            range(size) if count is None or count >= size else np.sort(generator.choice(size, count, replace=False))
        )
        drawn = [listed[int(k)] for k in chosen]
    return list({context.content_hash: context for context in drawn}.values())


@dataclass(frozen=True)
class EpisodeSeeds:
    """Seeds of paired episodes: every intersection has its own, so that a busy draw of one is not busy in all.

    What drives there, adoption, fleet and weather do not change an intersection's seeds.

    Attributes:
        base: other bases have other seeds.
        count: episodes per context.
    """

    base: int
    count: int

    def __len__(self) -> int:
        return self.count

    def of(self, context: Context) -> list[int]:
        """Return the seeds of a context."""
        own = zlib.crc32(context.intersection.name.encode())
        return [episode_seed(episode_seed(self.base, own), number) for number in range(self.count)]


def describe(contexts: Sequence[Context], seeds: Sized, env: EnvConfig) -> str:
    """Return in words what an evaluation plays."""
    number, each = counted(len(contexts), "context"), f"{counted(len(seeds), 'seed')} each"
    return f"{number}, {each}, episodes of {env.horizon_s:g} s of which the first {env.warmup_s:g} s are not measured"
