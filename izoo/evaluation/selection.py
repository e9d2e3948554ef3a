"""Which contexts and episode seeds an evaluation plays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

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


def episode_seeds(base: int, count: int) -> list[int]:
    """Return the seeds of ``count`` paired episodes per context."""
    return [episode_seed(base, number) for number in range(count)]


def describe(contexts: Sequence[Context], seeds: Sequence[int], env: EnvConfig) -> str:
    """Return in words what an evaluation plays."""
    number = f"{len(contexts)} context{'' if len(contexts) == 1 else 's'}"
    each = f"{len(seeds)} seed{'' if len(seeds) == 1 else 's'} each"
    return f"{number}, {each}, episodes of {env.horizon_s:g} s of which the first {env.warmup_s:g} s are not measured"
