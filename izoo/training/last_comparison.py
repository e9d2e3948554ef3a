"""What ends a run: its policy beside human driving and uncommanded CVs, on a few contexts, in SUMO."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import ContextSource, Schedule
from izoo.evaluation.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe

MOST_LOOKED_UP = 20_000
"""Of runs with more episodes it is not said that these contexts are unseen."""


def compare(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    run_dir: Path,
    source: ContextSource,
    schedule: Schedule,
    played: int,
) -> str:
    """Compare, in episodes as long as those of training; keep that in the run folder.

    Args:
        config: options of the run.
        policy: what it has learned.
        run_dir: its folder.
        source: its contexts.
        schedule: its episodes.
        played: how many of these have been begun.

    Returns:
        In words what was found.
    """
    from izoo.evaluation import evaluate_policy, print_summary, summarise
    from izoo.evaluation.words import in_words

    options = config.evaluation
    contexts = choose_contexts(source, options.contexts, config.seed)
    seeds = EpisodeSeeds(config.seed + EVALUATION_STREAM, options.seeds)
    print(f"Comparing with human driving: {describe(contexts, seeds, config.env)}.", flush=True)
    workers = config.num_workers
    summary = summarise(evaluate_policy(policy, contexts, seeds, config.env, num_workers=workers, out_dir=run_dir))
    print_summary(summary)
    endless = not hasattr(source, "__len__")
    return in_words(summary, unseen=endless and _unseen(contexts, schedule, played))


def _unseen(contexts: Sequence[Context], schedule: Schedule, played: int) -> bool:
    """Return whether none of the contexts is among the first episodes; of very many that is not looked up."""
    if played > MOST_LOOKED_UP:
        return False
    seen = {schedule(number)[0].content_hash for number in range(played)}
    return seen.isdisjoint(context.content_hash for context in contexts)
