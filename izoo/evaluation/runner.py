"""Evaluate a policy: paired with human driving, over worker processes, resumable."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pandas as pd

from izoo.algos.scripted import RandomDriver
from izoo.console import Progress
from izoo.contexts.context import Context
from izoo.envs.config import SIMULATORS, EnvConfig
from izoo.errors import IzooError, check_choice, check_range
from izoo.evaluation.baselines import EpisodeCache, baseline_context, default_folder
from izoo.evaluation.folder import ResultFolder
from izoo.evaluation.playing import Policy
from izoo.evaluation.policies import HUMAN, POLICY_FREE, UNCOMMANDED, Candidate, as_candidate
from izoo.evaluation.processes import Rows, Task, play_all
from izoo.evaluation.provenance import settings
from izoo.evaluation.remote import play_on_ray
from izoo.evaluation.selection import EpisodeSeeds
from izoo.evaluation.sources import add_sources
from izoo.evaluation.table import identity
from izoo.evaluation.together import play_together

EXECUTORS: dict[str, Callable[..., Iterator[tuple[Task, Rows]]]] = {
    "processes": play_all,
    "ray": play_on_ray,
    "together": play_together,
}
"""What plays episodes, by the option ``executor``."""
Key = tuple[str, str, int]
"""Policy name, content hash of the context it is evaluated in, seed."""


def evaluate_policy(
    policy: str | Policy,
    contexts: Sequence[Context],
    seeds: Sequence[int] | EpisodeSeeds,
    env_config: EnvConfig | None = None,
    num_workers: int = 2,
    out_dir: Path | str | None = None,
    progress: bool = True,
    *,
    name: str | None = None,
    uncommanded: bool = True,
    cache: Path | str | None = None,
    source: str | Path | None = None,
    executor: str = "processes",
    simulator: str = "sumo",
) -> pd.DataFrame:
    """Play a policy and its baselines in every context with every seed.

    Args:
        policy: a scripted driver's name, ``module:function``, a TensorDict module, or a callable of TensorDicts. Each
            episode (``together``: each block of 64) is played by a fresh copy of it, a module in evaluation mode.
        contexts: the contexts; repeated ones are played once.
        seeds: episode seeds, the same in all contexts or each intersection's own; three or more for the tested gate to
            mean something.
        env_config: the environment; what it emits is chosen here.
        num_workers: worker processes, each with one simulator; 0 plays in this process.
        out_dir: where ``evaluation.csv`` and ``summary.json`` go. Episodes that are already there are not played
            again; those of another policy under the same name are replaced
            (:func:`izoo.evaluation.fingerprint.fingerprint`). ``None`` writes nothing.
        progress: show a bar with the time left.
        name: the policy's name in the table.
        uncommanded: also play the CVs that nobody commands, which separates what the policy did from what the CV's
            vehicle parameters did.
        cache: folder of the cached baselines; ``None``: :func:`izoo.evaluation.baselines.default_folder`.
        source: what a policy that is given as an object can be made from again, so that a report can replay it: a
            driver's name, ``module:function``, or the path of a checkpoint.
        executor: where the workers are, one of :data:`EXECUTORS`: ``processes`` of this machine, or those of a ``ray``
            cluster; ``together``: the episodes side by side in ``num_workers`` threads, on the twin, for policies that
            act on a batch ``[N]`` as on each of its rows, and draw no random numbers.
        simulator: what plays the episodes: ``sumo``, or ``twin``, its compiled copy.

    Returns:
        The content of ``evaluation.csv``: one row per (policy, context, seed, approach), including what earlier
        evaluations left in ``out_dir``. See :mod:`izoo.evaluation.table`.

    Raises:
        IzooError: bad input, or a folder written with other settings.
        EpisodeFailed: an episode raised or lost its process; finished ones are kept in ``out_dir``.
    """
    config = dataclasses.replace(env_config or EnvConfig(), emit=())
    check_range("num_workers", num_workers, 0, 1024)
    check_choice("executor", executor, EXECUTORS)
    if not contexts or not len(seeds):
        raise IzooError("an evaluation needs one or more contexts and one or more seeds.")
    candidate = as_candidate(policy, config, name)
    names = list(dict.fromkeys([HUMAN, *([UNCOMMANDED] if uncommanded else []), candidate.name]))
    candidates = {driver: as_candidate(driver, config) for driver in POLICY_FREE} | {candidate.name: candidate}
    check_choice("simulator", simulator, SIMULATORS)
    if executor == "together" and isinstance(candidate.policy, RandomDriver):
        raise IzooError("executor=together cannot play a policy that draws random numbers; choose executor=processes.")
    if simulator == "twin":
        from izoo.envs.twin.twin_backend import check_settings  # it compiles, and most evaluations need none

        check_settings(config)
    folder = ResultFolder(None if out_dir is None else Path(out_dir), settings(config, simulator))
    cached = EpisodeCache(Path(cache) if cache else default_folder(), config, simulator)
    with folder.open(candidate.name, candidate.fingerprint):
        unique = list({context.content_hash: context for context in contexts}.values())
        wanted = [(driver, c, int(s)) for c in unique for s in seeds_of(seeds, c) for driver in names]
        if out_dir is not None:
            add_sources(Path(out_dir), unique, candidate.name, policy if isinstance(policy, str) else source)
        todo = [entry for entry in wanted if _key(*entry) not in folder.done]
        _play(
            todo,
            candidates,
            config,
            functools.partial(EXECUTORS[executor], num_workers=num_workers, simulator=simulator),
            folder,
            cached,
            progress,
        )
    return folder.table


def seeds_of(seeds: Sequence[int] | EpisodeSeeds, context: Context) -> Sequence[int]:
    """Return the seeds of a context, each once."""
    return list(dict.fromkeys(seeds.of(context) if isinstance(seeds, EpisodeSeeds) else seeds))


def _key(name: str, context: Context, seed: int) -> Key:
    return name, context.content_hash, seed


def _play(
    entries: Sequence[tuple[str, Context, int]],
    candidates: dict[str, Candidate],
    config: EnvConfig,
    play: Callable[..., Iterator[tuple[Task, Rows]]],
    folder: ResultFolder,
    cached: EpisodeCache,
    progress: bool,
) -> None:
    """Take policy-free episodes from the cache where it has them, and play the rest.

    Contexts that differ only in what concerns CVs share their human episodes, so an episode may answer several
    entries.
    """
    waiting: dict[Key, list[tuple[str, Context, int]]] = {}
    tasks: list[Task] = []
    for name, context, seed in entries:
        played = baseline_context(context) if name == HUMAN else context
        rows = cached.get(name, played, seed) if name in POLICY_FREE else None
        if rows is not None:
            folder.add(_relabel(rows, name, context, seed))
            continue
        key = _key(name, played, seed)
        if key not in waiting:
            tasks.append(Task(candidates[name].name, name, played, seed))
        waiting.setdefault(key, []).append((name, context, seed))
    policies = {name: candidates[name].pack() for name in {task.policy for task in tasks}}
    with Progress(len(tasks), unit="episodes", shown=progress) as bar:
        for number, (task, rows) in enumerate(play(tasks, policies, config), 1):
            if task.name in POLICY_FREE:
                cached.put(task.name, task.context, task.seed, rows)
            for name, context, seed in waiting[_key(task.name, task.context, task.seed)]:
                folder.add(_relabel(rows, name, context, seed))
            bar.update(number)


def _relabel(rows: Rows, name: str, context: Context, seed: int) -> Rows:
    """Give rows the identity of the context that is evaluated, which for human driving is not the one played."""
    return [{**row, **identity(name, context, seed, row["approach"])} for row in rows]
