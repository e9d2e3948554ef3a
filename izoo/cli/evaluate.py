"""What ``python -m izoo.evaluate`` does once its options are known."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence, Sized
from pathlib import Path

from izoo import tasks
from izoo.conf.evaluate_options import EvaluateConfig
from izoo.console import counted
from izoo.contexts.context import Context
from izoo.envs import REFERENCE, simulator_of
from izoo.errors import IzooError
from izoo.metrics.summary import summarise
from izoo.options import to_mapping, written
from izoo.report.leaderboard import write_entries
from izoo.report.tables import print_summary
from izoo.results.policies import NamedPolicy
from izoo.results.rollout import evaluate_policy
from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe
from izoo.results.store import read_table
from izoo.training import checkpoint, run_folder


def evaluate(config: EvaluateConfig) -> Path:
    """Evaluate as ``config`` says, print the summary, and return the results folder."""
    subject, folder = resolve(config)
    source = config.contexts.build()
    if config.task is None:
        contexts = choose_contexts(source, config.num_contexts, config.seed)
        seeds = EpisodeSeeds(EVALUATION_STREAM + config.seed, config.seeds)
    else:
        contexts = tasks.limited(source, config.num_contexts)
        seeds = EpisodeSeeds(tasks.TEST_SEED + config.seed, config.seeds)
    out = Path(config.out) if config.out else folder / run_folder.EVALUATIONS / _label(config, contexts)
    where = f" on {simulator_of(config.simulator).label}"
    what = f"{_task(config)}, {describe(contexts, seeds, config.env)}"
    print(f"Evaluating {subject.name}{where}: {what}. Results: {out}", flush=True)
    size = len(source) if isinstance(source, Sized) else len(contexts)
    if size > len(contexts):
        print(f"These are {len(contexts)} of {size:,} contexts; num_contexts=null plays all of them.", flush=True)
    with contextlib.suppress(IzooError):  # nothing is there yet, or what is there will be refused
        there = read_table(out)
        episodes = there[there["policy"] == subject.name].groupby(["context_hash", "seed"]).ngroups
        print(f"Episodes of {subject.name} that are there already, and not played again: {episodes}.", flush=True)
    table = evaluate_policy(
        subject.policy,
        contexts,
        seeds,
        config.env,
        name=subject.name,
        task=_task(config),
        train_seed=subject.train_seed,
        simulator=config.simulator,
        workers=config.num_workers,
        executor=config.executor,
        out=out,
        record=subject.record,
        cache=config.cache,
    )
    others = len(set(table["context_hash"]) - {context.content_hash for context in contexts})
    if others:
        print(f"{counted(others, 'other context')} of earlier evaluations in {out}: they are in the summary as well.")
    print(f"Results: {out}", flush=True)
    for path in write_entries(out):
        print(f"Leaderboard file: {path}", flush=True)
    print_summary(summarise(table), verbose=config.verbose)
    return out


def resolve(config: EvaluateConfig) -> tuple[NamedPolicy, Path]:
    """Return what to evaluate, and the folder that its evaluations lie in.

    Raises:
        IzooError: neither or both of ``run`` and ``policy``, or a run that observes something else than ``env`` says.
    """
    if not config.env.drain_s:
        raise IzooError("env.drain_s is 0, but evaluated episodes are played out; give a time, such as 600.")
    if (config.run is None) == (config.policy is None):
        raise IzooError("give one of run=RUN_DIR and policy=NAME; --help lists the policies.")
    if config.policy is not None:
        return run_folder.any_policy(config.policy, config.env, config.name), Path.cwd()
    path = checkpoint.find(Path(config.run or ""), config.checkpoint)
    folder = checkpoint.run_of(path)
    label = folder.name if [path] == checkpoint.listed(folder)[-1:] else f"{folder.name}-{path.stem}"
    return run_folder.any_policy(str(path), config.env, config.name or label), folder


def _task(config: EvaluateConfig) -> str:
    """Name what is tested: a task, and in what it was changed; or the contexts, their place and split."""
    contexts = config.contexts
    if config.task is None:
        cities = getattr(contexts, "city", "")
        place = cities if isinstance(cities, str) else "+".join(cities or ())
        parts = ["all ten cities" if cities is None else contexts.name, place, getattr(contexts, "split", None)]
        return " ".join(str(part) for part in parts if part)
    task = tasks.make(config.task)
    whole = to_mapping(task.test)
    changed = {key: value for key, value in to_mapping(contexts).items() if key != "path" and whole.get(key) != value}
    return ", ".join([task.name, *(f"{key}={written(value)}" for key, value in changed.items())])


def _label(config: EvaluateConfig, contexts: Sequence[Context]) -> str:
    """Name a folder after what decides its content, so that the same command goes on where it stopped."""
    played = [context.content_hash for context in contexts]  # what lies in a folder of contexts may change
    parts = [to_mapping(config.contexts), to_mapping(config.env), config.num_contexts, config.seed, played]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]
    return f"{config.contexts.name}-{digest}" + ("" if config.simulator == REFERENCE else f"-{config.simulator}")
