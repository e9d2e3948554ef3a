"""From a list of plays (policy, context, seed) to rows of the table, and :func:`evaluate_policy`, the door to it."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import itertools
import os
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from izoo.algos.drivers.by_name import make_driver
from izoo.algos.drivers.random import RandomDriver
from izoo.conf.evaluate_options import DRAIN_S
from izoo.console import Progress
from izoo.contexts.context import Context
from izoo.envs import simulator_of
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_choice, check_range
from izoo.files import expanded
from izoo.metrics.pairing import BASELINES, HUMAN
from izoo.results.cache import EpisodeCache, baseline_context
from izoo.results.playing import (
    RECORDS,
    SIDE_BY_SIDE,
    VEHICLE_REWARD,
    VEHICLE_SPANS,
    Measured,
    Play,
    Policy,
    Series,
    Setup,
)
from izoo.results.policies import as_policy, pack
from izoo.results.schema import Row, identity
from izoo.results.selection import EpisodeSeeds
from izoo.results.store import Key, PolicyRecord, Store
from izoo.zoo.catalog import WEIGHTS

EXECUTORS = {
    "processes": "izoo.results.process_executor:Processes",
    "batch": "izoo.results.batch_executor:Batch",
    "ray": "izoo.results.ray_executor:OnRay",
}
"""What plays episodes: worker processes; side by side on the twin, in this process; processes of a Ray cluster."""


class Played(NamedTuple):
    """An episode that was played: a row per scored approach, and what was recorded, by name."""

    play: Play
    rows: list[Row]
    series: Series


def rollout(
    plays: Iterable[Play],
    policies: Mapping[Key, Policy],
    config: EnvConfig,
    *,
    task: str = "",
    simulator: str = "sumo",
    executor: str | None = None,
    workers: int = 2,
    record: Sequence[str] = (),
    cache: Path | str | None = None,
    progress: bool = True,
    side_by_side: int | None = None,
    surrogate: str = "compiled",
) -> Generator[Played, None, None]:
    """Play episodes and yield them as they end; those of baselines come from the cache where it has them.

    Args:
        plays: what to play; ``batch`` takes from an iterator no more than it plays, and one block ahead.
        policies: by name, or by name and training seed; baselines need not be given. Each episode (``batch``: each
            block) is played by a fresh copy, a module in evaluation mode.
        config: the environment; what it emits is chosen here.
        task: column ``task`` of the rows.
        simulator: a name of :data:`izoo.envs.SIMULATORS`.
        executor: one of :data:`EXECUTORS`; ``None``: ``batch`` where the simulator steps environments side by side, for
            policies that draw no random numbers, and otherwise ``processes``.
        workers: processes (0: this one plays), or threads of ``batch``.
        record: what to record of each episode (:data:`~izoo.results.playing.RECORDS`).
        cache: folder of the baselines' episodes; ``None``: in the user's cache.
        progress: show a bar with the time left.
        side_by_side: episodes of a block of ``batch``; ``None``: :data:`SIDE_BY_SIDE`.
        surrogate: what computes CO2 in a batch (:class:`~izoo.envs.TwinEnv`).

    Raises:
        IzooError: bad input.
        EpisodeFailed: an episode raised or lost its process.
    """
    simulator_of(simulator)
    check_range("num_workers", workers, 0, 1024)
    for name in record:
        check_choice("record", name, RECORDS)
    executor = executor_for(simulator, policies, executor)
    named: dict[Key, Policy] = {**{name: make_driver(name, config) for name in BASELINES}, **policies}
    packed = {key: pack(key if isinstance(key, str) else key[0], policy) for key, policy in named.items()}
    emits = {"number" if name in (VEHICLE_SPANS, VEHICLE_REWARD) else name: None for name in record}
    emitting = dataclasses.replace(config, emit=tuple(emits))
    setup = Setup(packed, emitting, simulator, workers, tuple(record), side_by_side or SIDE_BY_SIDE, surrogate)
    if executor == "batch" and isinstance(plays, Sequence):
        plays = sorted(plays, key=lambda play: (play.policy, play.train_seed))
    module, _, name = EXECUTORS[executor].partition(":")
    player = getattr(importlib.import_module(module), name)(setup)
    total = len(plays) if isinstance(plays, Sized) else 0
    bar = Progress(total, unit="episodes", shown=progress)
    return _stream(plays, setup, task, EpisodeCache(cache, setup), player, bar)


def executor_for(simulator: str, policies: Mapping[Key, Policy], executor: str | None = None) -> str:
    """Return what plays the episodes of policies.

    Raises:
        IzooError: ``executor`` is unknown, or cannot play them.
    """
    draws = any(isinstance(policy, RandomDriver) for policy in policies.values())
    if executor is None:
        return "batch" if simulator_of(simulator).batched and not draws else "processes"
    check_choice("executor", executor, EXECUTORS)
    if executor == "batch" and not simulator_of(simulator).batched:
        raise IzooError(f"executor=batch plays side by side, and simulator={simulator} cannot; choose simulator=twin.")
    if executor == "batch" and draws:
        raise IzooError("executor=batch cannot play a policy that draws random numbers; choose executor=processes.")
    return executor


def evaluate_policy(
    policy: str | Policy,
    contexts: Sequence[Context],
    seeds: Sequence[int] | EpisodeSeeds,
    config: EnvConfig | None = None,
    *,
    name: str | None = None,
    task: str = "",
    train_seed: int = 0,
    simulator: str = "sumo",
    workers: int = 2,
    executor: str | None = None,
    out: Path | str | None = None,
    baselines: Sequence[str] = BASELINES,
    record: PolicyRecord | None = None,
    cache: Path | str | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Play a policy and its baselines in every context with every seed.

    Args:
        policy: a scripted driver's name, ``zoo:NAME``, the path of an exported policy, ``module:function``, a
            TensorDict module, or a callable of TensorDicts.
        contexts: the contexts; repeated ones are played once.
        seeds: episode seeds, the same in all contexts or each intersection's own.
        config: the environment. Where its ``drain_s`` is 0, episodes are played out for :data:`DRAIN_S`.
        name: the policy's name in the table.
        task: what is tested, such as ``salt_lake_city test``.
        train_seed: which training seed the policy is of.
        simulator, workers, executor, cache, progress: as for :func:`rollout`.
        out: results folder (:class:`~izoo.results.store.Store`). Episodes that are already there are not played again;
            those of other weights under the same name are replaced. ``None`` writes nothing.
        baselines: what to play beside the policy.
        record: what the manifest says of the policy, where it is more than can be seen of it.

    Returns:
        The table, including what earlier evaluations left in ``out`` (:mod:`izoo.results.schema`).

    Raises:
        IzooError: bad input, or a folder written with other settings.
        EpisodeFailed: an episode raised or lost its process; finished ones are kept in ``out``.
    """
    config = evaluated(config or EnvConfig())
    if not contexts or not len(seeds):
        raise IzooError("an evaluation needs one or more contexts and one or more seeds.")
    chosen = as_policy(policy, config, name)
    drivers = list(dict.fromkeys([*baselines, *([chosen.name] if chosen.name in BASELINES else [])]))
    records: dict[Key, PolicyRecord] = {driver: PolicyRecord(source=driver) for driver in drivers}
    own: Key = (chosen.name, train_seed)
    policies = {own: chosen.policy} if chosen.name not in BASELINES else {}
    if policies:
        records[own] = _record(chosen.record, record, out)
    executor = executor_for(simulator, policies, executor)
    check_range("num_workers", workers, 0, 1024)
    simulator_of(simulator).check_settings(config)
    every = list({context.content_hash: context for context in contexts}.values())
    keys = [key if isinstance(key, tuple) else (key, 0) for key in records]
    store = Store(out, task=task, config=config)
    with store.open(records):
        store.keep_contexts(every)
        plays = [Play(*key, context, seed) for context in every for seed in seeds_of(seeds, context) for key in keys]
        options: dict[str, Any] = {"executor": executor, "workers": workers, "cache": cache, "progress": progress}
        play_missing(store, plays, policies, config, simulator, task=task, **options)
    return store.table


def missing(store: Store, plays: Iterable[Play], simulator: str) -> list[Play]:
    """Return the plays whose rows a store lacks."""
    return [p for p in plays if (p.policy, p.train_seed, simulator, p.context.content_hash, p.seed) not in store.done]


def play_missing(
    store: Store,
    plays: Iterable[Play],
    policies: Mapping[Key, Policy],
    config: EnvConfig,
    simulator: str,
    **options: Any,
) -> None:
    """Play what a store lacks, and keep it; ``options`` as :func:`rollout` takes them."""
    todo = missing(store, plays, simulator)
    with contextlib.closing(rollout(todo, policies, config, simulator=simulator, **options)) as playing:
        for played in playing:
            store.add(played.rows)


def evaluated(config: EnvConfig) -> EnvConfig:
    """Return the environment of evaluated episodes: played out after their horizon."""
    return config if config.drain_s else dataclasses.replace(config, drain_s=DRAIN_S)


def seeds_of(seeds: Sequence[int] | EpisodeSeeds, context: Context) -> list[int]:
    """Return the seeds of a context, each once."""
    return list(dict.fromkeys(seeds.of(context) if isinstance(seeds, EpisodeSeeds) else map(int, seeds)))


def _record(seen: PolicyRecord, given: PolicyRecord | None, out: Path | str | None) -> PolicyRecord:
    """Return what is known of a policy; the path of a file is given relative to the results folder."""
    record = dataclasses.replace(given or seen, weights=seen.weights, env=seen.env)
    if out is None or record.source is None or Path(record.source).suffix != WEIGHTS:
        return record
    path = expanded(record.source)
    # A link as the last part stays: it may come to mean another file, and then that one is asked for.
    source = os.path.relpath(path.parent.resolve() / path.name, Path(out).resolve())
    return dataclasses.replace(record, source=source)


def _stream(
    plays: Iterable[Play], setup: Setup, task: str, cache: EpisodeCache, player: Any, bar: Progress
) -> Generator[Played, None, None]:
    """Play block after block, and yield what was played; the next block is looked up before one is played."""

    def complete(play: Play, found: Measured) -> Played:
        whose = play.policy, play.train_seed, setup.simulator
        rows = [{**identity(*whose, play.context, play.seed, row["approach"], task), **row} for row in found.rows]
        return Played(play, rows, found.series)

    def look_up(part: Sequence[Play]) -> tuple[list[Played], dict[tuple[Any, ...], tuple[Play, list[Play]]]]:
        """Return what the cache has of a block, and by episode what is to be played and for which plays."""
        kept: list[Played] = []
        waiting: dict[tuple[Any, ...], tuple[Play, list[Play]]] = {}
        for play in part:
            context = baseline_context(play.context) if play.policy == HUMAN else play.context
            found = cache.get(play.policy, context, play.seed, setup.record) if play.policy in BASELINES else None
            if found is not None:
                kept.append(complete(play, found))
            else:  # contexts that differ only in what concerns CVs share their human episodes
                played = dataclasses.replace(play, context=context)
                waiting.setdefault(played.episode, (played, []))[1].append(play)
        return kept, waiting

    with bar, contextlib.closing(player):
        blocks = map(look_up, _parts(plays, player.size))
        block, done = next(blocks, None), 0
        while block is not None:
            following = next(blocks, None)
            (kept, waiting), ahead = block, following[1] if following else {}
            for each in kept:
                yield each
                bar.update(done := done + 1)
            todo, then = ([played for played, _ in part.values()] for part in (waiting, ahead))
            for played, found in player.play(todo, then) if todo else ():
                if played.policy in BASELINES:
                    cache.put(played.policy, played.context, played.seed, found)
                for play in waiting[played.episode][1]:
                    yield complete(play, found)
                    bar.update(done := done + 1)
            block = following


def _parts(plays: Iterable[Play], size: int | None) -> Iterator[list[Play]]:
    """Yield the plays in blocks of one policy, or all at once."""
    if size is None:
        yield list(plays)
        return
    for _, own in itertools.groupby(plays, key=lambda play: (play.policy, play.train_seed)):
        while part := list(itertools.islice(own, size)):
            yield part
