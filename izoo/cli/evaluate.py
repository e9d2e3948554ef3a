"""What ``python -m izoo.evaluate`` does once its options are known."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from pathlib import Path

from izoo import zoo
from izoo.conf.context_choices import ContextsConfig
from izoo.conf.evaluate_options import EvaluateConfig
from izoo.conf.mapping import to_mapping, with_given
from izoo.console import counted
from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.metrics.summary import summarise
from izoo.report.tables import print_summary
from izoo.results.playing import Policy
from izoo.results.policies import as_policy
from izoo.results.rollout import evaluate_policy, evaluated
from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe
from izoo.results.store import PolicyRecord, read_table
from izoo.training import checkpoint, run_folder
from izoo.training.final_evaluation import EVALUATIONS


@dataclass(frozen=True)
class Subject:
    """What is evaluated, and on what: resolved options."""

    name: str
    policy: Policy
    contexts: ContextsConfig
    env: EnvConfig
    folder: Path
    record: PolicyRecord
    train_seed: int = 0


def evaluate(config: EvaluateConfig, given: frozenset[str] = frozenset()) -> Path:
    """Evaluate as ``config`` says, print the summary, and return the results folder.

    Args:
        config: the options.
        given: names of the options that were written on the command line; matters where a run is given.
    """
    subject = resolve(config, given)
    source = subject.contexts.build()
    contexts = choose_contexts(source, config.num_contexts, config.seed)
    seeds = EpisodeSeeds(EVALUATION_STREAM + config.seed, config.seeds)
    out = Path(config.out) if config.out else subject.folder / EVALUATIONS / _label(subject, config, contexts)
    where = "" if config.simulator == "sumo" else " on the twin"
    what = f"contexts={subject.contexts.name}, {describe(contexts, seeds, subject.env)}"
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
        subject.env,
        name=subject.name,
        task=_task(subject.contexts),
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
    print_summary(summarise(table), verbose=config.verbose)
    return out


def resolve(config: EvaluateConfig, given: frozenset[str]) -> Subject:
    """Return what to evaluate.

    Raises:
        IzooError: neither or both of ``run`` and ``policy``, or a run that observes something else than ``env`` says.
    """
    if "env.drain_s" in given and not config.env.drain_s:
        raise IzooError("env.drain_s is 0, but evaluated episodes are played out; give a time, such as 600.")
    if (config.run is None) == (config.policy is None):
        raise IzooError("give one of run=RUN_DIR and policy=NAME; --help lists the policies.")
    if config.policy is not None:
        name, env = config.policy.rpartition(":")[2], config.env
        shipped = zoo.named(config.policy)
        if shipped:
            found = zoo.load(shipped)
            name, env = found.name, evaluated(with_given(found.env, env, given, "env"))
        found_policy = as_policy(config.policy, env, name)
        return Subject(name, found_policy.policy, config.contexts, env, Path.cwd(), found_policy.record)
    path = checkpoint.find(Path(config.run or ""), config.checkpoint)
    folder = checkpoint.run_of(path)
    algorithm, trained, state = run_folder.load_algorithm(path)
    env = evaluated(with_given(zoo.full_episodes(trained.env), config.env, given, "env"))
    there, given_names = observation_names(trained.env), observation_names(env)
    if there != given_names:
        changed = [f"+{name}" for name in given_names if name not in there]
        changed += [f"-{name}" for name in there if name not in given_names]
        raise IzooError(
            f"the run {folder} was trained on other observations than the env options describe "
            f"({', '.join(changed) or 'another order'}); leave env.observed and env.neighbours out."
        )
    zoo.check_actions(f"the policy of {folder}", trained.env, env)
    changed = [option for option in sorted(given) if option.startswith("contexts.")]
    if changed and "contexts" not in given:  # as in a sweep over runs
        raise IzooError(f"{changed[0]} is given, and it is not known of which contexts; give contexts=NAME as well.")
    contexts = config.contexts if changed or "contexts" in given else trained.contexts
    run_folder.check_drivers(folder, trained, contexts)
    name = folder.name if [path] == checkpoint.listed(folder)[-1:] else f"{folder.name}-{path.stem}"
    record = PolicyRecord("trained", None, str(path), trained.algo.name, state["frames"])
    return Subject(name, algorithm.policy.eval(), contexts, env, folder, record, trained.seed)


def _task(contexts: ContextsConfig) -> str:
    """Name what is tested: the contexts, their place and split."""
    parts = [contexts.name, getattr(contexts, "city", None), getattr(contexts, "split", None)]
    return " ".join(str(part) for part in parts if part)


def _label(subject: Subject, config: EvaluateConfig, contexts: Sequence[Context]) -> str:
    """Name a folder after what decides its content, so that the same command goes on where it stopped."""
    played = [context.content_hash for context in contexts]  # what lies in a folder of contexts may change
    parts = [to_mapping(subject.contexts), to_mapping(subject.env), config.num_contexts, config.seed, played]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]
    return f"{subject.contexts.name}-{digest}" + ("" if config.simulator == "sumo" else f"-{config.simulator}")
