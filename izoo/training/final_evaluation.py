"""The final evaluation of a run: its policy against human driving and uncommanded CVs, on a few contexts, in SUMO."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import ContextSource
from izoo.metrics.summary import summarise
from izoo.results.rollout import evaluate_policy
from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe
from izoo.results.store import PolicyRecord
from izoo.training import checkpoint

EVALUATIONS = "evaluations"
"""Folder of a run with its results folders."""
LAST = "last"
"""That of the final evaluation."""


def compare(
    config: TrainConfig, policy: TensorDictModuleBase, run_dir: Path, source: ContextSource, frames: int
) -> dict[str, Any]:
    """Compare, in episodes as long as those of training; keep that in the run folder, in place of an earlier one.

    Args:
        config: options of the run.
        policy: what it has learned.
        run_dir: its folder.
        source: its contexts.
        frames: how many environment steps it has learned from.

    Returns:
        :func:`izoo.metrics.summary.summarise`.
    """
    options, folder = config.evaluation, run_dir / EVALUATIONS / LAST
    contexts = choose_contexts(source, options.contexts, config.seed)
    seeds = EpisodeSeeds(config.seed + EVALUATION_STREAM, options.seeds)
    print(f"Comparing with human driving: {describe(contexts, seeds, config.env)}.", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    table = evaluate_policy(
        policy,
        contexts,
        seeds,
        config.env,
        name=config.algo.name,
        train_seed=config.seed,
        workers=config.num_workers,
        out=folder,
        record=PolicyRecord("trained", None, str(checkpoint.find(run_dir)), config.algo.name, frames),
    )
    return summarise(table)
