"""Offline data: what a policy experiences, as memory-mapped TensorDicts in shards, with a manifest."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from izoo import __version__
from izoo.algos.scripted import RandomDriver, UncommandedDriver
from izoo.conf.build import to_mapping
from izoo.conf.options import CollectConfig
from izoo.contexts.source import RandomSchedule
from izoo.envs import SumoParallelEnv
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2
from izoo.envs.layout import observation_names
from izoo.errors import IzooError, unknown_choice
from izoo.training import runs
from izoo.training.interrupt import graceful_interrupt, workers_ignore_interrupts
from izoo.training.progress import ProgressBar

MANIFEST = "manifest.json"
FORMAT = "izoo-dataset-1"
SCRIPTED = ("random", "uncommanded")
FRAMES_PER_BATCH = 1000


def collect(config: CollectConfig, given: frozenset[str] = frozenset()) -> Path:
    """Step environments with a policy and store every step.

    The folder holds ``shard-00000``, ... and ``manifest.json``, which lists the finished shards and is replaced whole
    after each of them: what it names is complete, whenever the command is stopped. Shards are written beside and renamed.

    Args:
        config: the options.
        given: unused; commands share one signature.

    Returns:
        The folder.

    Raises:
        IzooError: ``out`` is missing or not empty, or the policy or the contexts cannot be used.
    """
    if config.out is None:
        raise IzooError("out is missing; name a new folder for the data: out=DIR.")
    policy = make_policy(config)
    source = config.contexts.build()
    out = Path(config.out)
    runs.ensure_empty(out, "out")
    with workers_ignore_interrupts():
        env = SumoParallelEnv(
            config.num_workers, contexts=RandomSchedule(source, config.seed), config=config.env, seed=config.seed
        )
        torch.manual_seed(config.seed)
        collector = Collector(
            env,
            policy,
            frames_per_batch=-(-FRAMES_PER_BATCH // config.num_workers) * config.num_workers,
            total_frames=-1,
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
    try:
        with graceful_interrupt() as interrupt, ProgressBar(config.frames) as bar:
            _store(config, collector, out, interrupt, bar)
    finally:
        collector.shutdown()
    print(f"Data: {out}", flush=True)
    return out


def make_policy(config: CollectConfig) -> TensorDictModuleBase:
    """Return the policy that ``config.policy`` names: a scripted driver, or the policy of a training run."""
    if config.policy == "random":
        return RandomDriver(ACTION_LOW_MPS2, ACTION_HIGH_MPS2, config.seed)
    if config.policy == "uncommanded":
        return UncommandedDriver()
    if not Path(config.policy).expanduser().exists():
        error = unknown_choice("policy", config.policy, SCRIPTED)
        raise IzooError(f"{error} Or name the folder of a training run; there is none at that path.")
    algorithm, trained, _ = runs.load_algorithm(config.policy)
    if observation_names(trained.env) != observation_names(config.env):
        raise IzooError(
            f"the policy of {config.policy} was trained on other observations than env describes; "
            "set env.observed and env.neighbours as in its config.yaml."
        )
    return algorithm.policy


def load(folder: Path | str) -> TensorDictBase:
    """Open a collected data set without reading it into memory.

    Returns:
        Steps ``[frames]``, memory-mapped: a TensorDict for one shard, a lazy concatenation of them for several. Steps of
        one episode share ``("collector", "traj_ids")``.

    Raises:
        IzooError: the folder is not a data set of izoo, or a shard is missing.
    """
    folder = Path(folder).expanduser()
    path = folder / MANIFEST
    if not path.is_file():
        raise IzooError(f"{folder} has no {MANIFEST}; give a folder that python -m izoo.collect has written.")
    try:
        manifest = json.loads(path.read_text())
        shards = [folder / shard["name"] for shard in manifest["shards"]]
    except (ValueError, KeyError, TypeError) as error:
        raise IzooError(f"{path} is damaged; collect the data again.") from error
    if manifest.get("format") != FORMAT:
        raise IzooError(f"{path} is of format {manifest.get('format')!r}; this version of izoo reads {FORMAT}.")
    missing = [shard.name for shard in shards if not shard.is_dir()]
    if missing or not shards:
        raise IzooError(f"{folder} lacks {', '.join(missing) or 'any finished shard'}; copy it whole, or collect again.")
    parts = [TensorDict.load_memmap(shard) for shard in shards]
    return parts[0] if len(parts) == 1 else torch.cat([*parts])


def _store(config: CollectConfig, collector: Collector, out: Path, interrupt: Any, bar: ProgressBar) -> None:
    """Write shards until all frames are stored, or Ctrl-C ends the collection early."""
    shards: list[dict[str, Any]] = []
    pending: list[TensorDictBase] = []
    stored = waiting = 0
    for batch in collector:
        take = min(batch.numel(), config.frames - stored - waiting)
        pending.append(batch.transpose(0, 1).reshape(-1)[:take].clone())
        waiting += take
        last = stored + waiting >= config.frames or interrupt.requested
        if waiting >= config.shard_frames or last:
            shards.append({"name": _write_shard(out, len(shards), torch.cat(pending)), "frames": waiting})
            stored, waiting, pending = stored + waiting, 0, []
            _write_manifest(out, config, shards)
        bar.update(stored + waiting, {})
        if last:
            return


def _write_shard(out: Path, index: int, steps: TensorDictBase) -> str:
    name = f"shard-{index:05d}"
    partial = out / f".{name}.partial"
    try:
        steps.memmap(str(partial))
        partial.rename(out / name)
    except (OSError, RuntimeError) as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise IzooError(f"could not write {out / name}: {error}; the shards before it are complete.") from error
    return name


def _write_manifest(out: Path, config: CollectConfig, shards: list[dict[str, Any]]) -> None:
    manifest = {
        "format": FORMAT,
        "izoo": __version__,
        "frames": sum(shard["frames"] for shard in shards),
        "num_workers": config.num_workers,
        "observation_names": list(observation_names(config.env)),
        "shards": shards,
        "options": to_mapping(config),
    }
    partial = out / f".{MANIFEST}.partial"
    with partial.open("w") as file:
        json.dump(manifest, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(out / MANIFEST)
