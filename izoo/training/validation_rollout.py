"""What a validation plays: a checkpoint's policy and the baselines on held-out contexts."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from izoo.conf.context_choices import ContextsConfig, MixedContexts
from izoo.contexts.source import ContextSource, MixedSource
from izoo.errors import IzooError
from izoo.files import write_json
from izoo.metrics.figures import FIGURES, HEADLINE
from izoo.metrics.pairing import HUMAN, UNCOMMANDED, pair
from izoo.metrics.summary import summarise
from izoo.processes import end_with_parent
from izoo.results.rollout import evaluate_policy
from izoo.results.selection import EpisodeSeeds, choose_contexts
from izoo.training import run_folder

VALIDATION_SEED = 7_561
"""Seed of the validation contexts and episodes, whatever the run's own: runs are compared on the same episodes."""
NICENESS = 10
POLICY, CONTEXTS = "policy", "contexts_saved"


def main(parent: int, checkpoint_file: str, result_file: str) -> None:
    """Validate a checkpoint in a process of low priority, and write the row as JSON, whole or not at all."""
    end_with_parent(parent)
    os.nice(NICENESS)
    torch.set_num_threads(1)
    write_json(Path(result_file), validate(Path(checkpoint_file)), durable=False)


def held_out(config: ContextsConfig) -> ContextSource:
    """Return what to validate on: the validation split, or, of contexts without splits, the same distribution."""
    if isinstance(config, MixedContexts):
        return MixedSource([held_out(source) for source in config.sources])
    if getattr(config, "split", None) in ("train", "all"):
        held: Any = config
        with contextlib.suppress(IzooError):  # sets of a few intersections are for training alone
            return dataclasses.replace(held, split="validation").build()
    return config.build()


def validate(path: Path) -> dict[str, Any]:
    """Play a checkpoint's policy and the baselines in the validation contexts; return a row of the table.

    Figures of :data:`~izoo.metrics.figures.HEADLINE`, of the unsaturated contexts if there are any: those that compare
    do so with uncommanded CVs, and ``NAME_low`` and ``NAME_high`` are the ends of their intervals over intersections
    (``None`` where there are too few for one). ``co2_saved_over_human`` compares with human driving. ``slower``: 1
    where the delay is shown to be higher than that of uncommanded CVs. Under :data:`CONTEXTS`: the intersection and the
    CO2 saved of every context.
    """
    started = time.perf_counter()
    algorithm, config, state = run_folder.load_algorithm(path)
    options = config.validation
    table = evaluate_policy(
        algorithm.policy.eval(),
        choose_contexts(held_out(config.contexts), options.contexts, VALIDATION_SEED),
        EpisodeSeeds(VALIDATION_SEED, options.seeds),
        config.env,
        name=POLICY,
        simulator=options.simulator,
        workers=0,
        progress=False,
    )
    summary = summarise(table)
    entry, block = summary["entries"][POLICY], summary["block"]
    uncommanded, human = (entry["against"][baseline][block] for baseline in (UNCOMMANDED, HUMAN))
    figures = {**uncommanded["figures"], "co2_saved_over_human": human["figures"]["co2_saved"]}
    ends = {"": "value", "_low": "low", "_high": "high"}
    compared = {f"{name}{end}": found[part] for name, found in figures.items() for end, part in ends.items()}
    return {
        "frames": state["frames"],
        **compared,
        **{name: entry["levels"][block][name] for name in HEADLINE if name not in figures},
        "slower": float(entry["slower"]),
        "nan_share": entry["levels"]["all"]["nan_share"],
        "intersections": uncommanded["intersections"],
        "seconds": time.perf_counter() - started,
        CONTEXTS: saved_by_context(table, block),
    }


def saved_by_context(table: pd.DataFrame, block: str) -> dict[str, list[Any]]:
    """Return intersection and CO2 saved over uncommanded CVs (per cent) by context, of a block of contexts."""
    contexts, own, baseline = pair(table, POLICY, UNCOMMANDED)
    values = FIGURES["co2_saved"].value(own, baseline)
    return {
        row.context_hash: [row.intersection, float(value)]
        for row, value in zip(contexts.itertuples(), values, strict=True)
        if block == "all" or row.saturated == (block == "saturated")
    }
